"""For all tests: the package's annotations are checked while it runs, and compilations are kept."""

from __future__ import annotations

import os
from importlib.metadata import version

# Most of the tests' time is compilation, and this takes a quarter of it away; see pmdc_jax/compiled.py. Later versions
# do not have it, and end the process where they find it.
if version("jaxlib").startswith("0.10."):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false"

# First, so that the change to jaxtyping below is seen by nobody but the package under test.
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
    """Keep compilations between runs, and between the workers of one run: they are most of the time."""
    if cache := getattr(config, "cache", None):
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.fixture
def x64():
    """64-bit JAX arrays inside a test; the package's public functions need nothing of the kind."""
    with jax.enable_x64(True):
        yield
