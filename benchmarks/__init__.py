"""Speed and naming benchmarks: ours beside peers, and the virtual bench that makes the data."""

import os

import llvmlite.binding as _llvm

# LLVM shies from 512-bit vectors, which here are worth a factor of 1.6 to the roofline. Numba reads
# this once, when it is imported, and keeps one cache for each setting: hence here and for all.
_features = _llvm.get_host_cpu_features()
if _features.get("avx512f"):
    _features["prefer-256-bit"] = False
    os.environ.setdefault("NUMBA_CPU_FEATURES", _features.flatten())

# Numba's OpenMP threads spin at their barriers: beside anything else on the machine the roofline
# came out 5 to 50 times slower with them than with numba's own pool, which alone is as fast.
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")
