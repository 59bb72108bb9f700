"""What JAX compiles is kept from one run of the command to the next; the library keeps nothing."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings
from pathlib import Path

# Where this package keeps programs of its own, for this process and those that it starts
PROGRAMS = "PMDC_PROGRAMS"
# JAX reads these when it is first imported, so a command that computes nothing pays nothing. All is
# kept, however quickly compiled, for there is much of it.
SETTINGS = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
}


def keep_compiled() -> None:
    """Have JAX, and `compiled`, keep what is compiled in this process, where JAX must not have been imported yet.

    The folder is that of the environment variable PMDC_CACHE, else one in the user's cache folder.
    Nothing is kept where the variable is empty or the folder cannot be written; what is set of
    JAX's own variables stays.
    """
    folder = _folder()
    if folder is None:
        return
    os.environ[PROGRAMS] = str(folder / "programs")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    # a full disk, a damaged file: JAX then compiles, and that is all that anyone needs
    warnings.filterwarnings("ignore", r"Error (reading|writing) persistent compilation cache")


def programs() -> Path | None:
    """The folder of the programs that `compiled` keeps, None where it keeps none."""
    named = os.environ.get(PROGRAMS)
    return Path(named) if named else None


def _folder() -> Path | None:
    named = os.environ.get("PMDC_CACHE")
    if named == "":
        return None
    if named is None:
        from platformdirs import user_cache_path

        root = user_cache_path("pmdc_jax", appauthor=False)
    else:
        root = Path(named).absolute()
    try:  # JAX makes the folder when it first keeps something
        there = next(path for path in (root, *root.parents) if path.exists())
        writable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    except OSError:
        writable = False
    return root / _processor() if writable else None


def _processor() -> str:
    """A name for this kind of processor: homes are shared, and code for another may crash here."""
    features = hashlib.sha256(_features().encode()).hexdigest()[:12]
    return f"{platform.machine()}-{features}"


def _features() -> str:
    """What the processor can do, on Linux; its name elsewhere."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as lines:
            return next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        return platform.processor()
