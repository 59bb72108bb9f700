"""Shared by all tests: annotations of the whole package are checked while it runs, and 64-bit arrays."""

from __future__ import annotations

import jax
import pytest
from jaxtyping import install_import_hook

# Before anything imports the package: every function and class of it then checks shapes and types.
install_import_hook("pmdc_jax", "beartype.beartype")


@pytest.fixture
def x64():
    """64-bit JAX arrays inside a test; the package's public functions need nothing of the kind."""
    with jax.enable_x64(True):
        yield
