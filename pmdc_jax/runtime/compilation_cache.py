"""Compiled programs are kept on disk from one run of the command to the next; used as a library, nothing is kept."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings
from pathlib import Path

# Environment variable with the folder of this package's own programs, for this process and those that it starts
PROGRAMS = "PMDC_PROGRAMS"
# JAX reads these variables when it is first imported, so a command that computes nothing need not import it. All
# programs are kept, however quick to compile, because there are many.
SETTINGS = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0"}


def keep_compiled() -> None:
    """Have JAX and `compiled` keep the programs of this process. To be called before JAX is imported.

    The folder is that of the environment variable PMDC_CACHE, by default one in the user's cache folder.
    Nothing is kept if the variable is empty or the folder cannot be written. JAX's own variables keep
    values that are already set.
    """
    folder = _folder()
    if folder is None:
        return
    os.environ[PROGRAMS] = str(folder / "programs")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    # on a full disk or with a damaged file JAX simply compiles, so its warning helps nobody
    warnings.filterwarnings("ignore", r"Error (reading|writing) persistent compilation cache")


def programs() -> Path | None:
    """The folder of the programs that `compiled` keeps; None if it keeps none."""
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
    """A name for this kind of processor: machines share home folders, and programs compiled on another may crash."""
    features = hashlib.sha256(_features().encode()).hexdigest()[:12]
    return f"{platform.machine()}-{features}"


def _features() -> str:
    """The processor's instruction set flags on Linux; its name elsewhere."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as lines:
            return next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        return platform.processor()
