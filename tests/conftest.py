"""For all tests: annotations of the package are checked at run time, and compiled programs are cached."""

from __future__ import annotations

import os
from importlib.metadata import version

# Most of the time of the tests is compilation, which this shortens by a quarter; see pmdc_jax/runtime/compiled.py.
# Later versions do not have this option, and end the process if it is set.
if version("jaxlib").startswith("0.10."):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false"

# Imported first, so that the change to jaxtyping below affects only the package under test.
import diffrax  # noqa: F401
import equinox  # noqa: F401
import evosax  # noqa: F401
import jax
import jaxtyping
import optimistix  # noqa: F401
import pytest

# Where the package says Array, a numpy array or a Python number will do: JAX takes both. Shapes and
# kinds of numbers are still checked, of every argument, field and result of every function.
jaxtyping.Array = jaxtyping.ArrayLike
jaxtyping.install_import_hook("pmdc_jax", "beartype.beartype")


def pytest_configure(config):
    """Cache compiled programs between runs, and between the workers of one run."""
    if cache := getattr(config, "cache", None):
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.fixture
def x64():
    """64-bit JAX arrays within a test; the public functions of the package do not need this."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def no_terminal(monkeypatch):
    """Removes the environment variables by which rich assumes a terminal."""
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(variable, raising=False)
