"""Benchmarks of speed and naming: the package beside peers, and the virtual bench that makes the data."""

import os

import llvmlite.binding as _llvm

# LLVM avoids 512-bit vectors by default, with which the roofline is 1.6 times as fast. Numba reads this setting once,
# when it is imported, and has one cache for each, so it is made here for all benchmarks.
_features = _llvm.get_host_cpu_features()
if _features.get("avx512f"):
    _features["prefer-256-bit"] = False
    os.environ.setdefault("NUMBA_CPU_FEATURES", _features.flatten())

# Numba's OpenMP threads spin at barriers: beside other work on the machine the roofline was 5 to 50 times slower with
# them than with numba's own pool, which is as fast on an idle machine.
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")
