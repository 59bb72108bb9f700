"""What JAX compiles: in less time what runs but a few times, and room for it in programs that go on and on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax

P = ParamSpec("P")
T = TypeVar("T")

# Without its newer emitter of kernels XLA compiles in two thirds of the time. What it makes is as fast but for dry
# friction and teeth, which take a quarter longer.
QUICKLY = {"xla_cpu_use_fusion_emitters": False}

# Where Linux lists a process's memory maps, and says how many it may have
MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of them that must be free before new recordings are begun with: a diagnosis takes up to a quarter
FREE = 0.5


def quickly_compiled(function: Callable[P, T]) -> Callable[P, T]:
    """`equinox.filter_jit` for what takes longer to compile than it ever runs; not to be called from compiled code."""
    return eqx.filter_jit(function, compiler_options=QUICKLY)  # pyright: ignore[reportCallIssue]


def make_room() -> None:
    """Forget what was compiled for earlier recordings, if it leaves little room for more.

    Each shape of recordings is compiled for, each program takes some memory maps, and a process that has as many as
    Linux allows is killed: after some twelve diagnoses. Elsewhere nothing is done.
    """
    if not (MAPS.exists() and LIMIT.exists()):
        return
    with MAPS.open("rb") as lines:
        used = sum(1 for _ in lines)
    if used > (1 - FREE) * int(LIMIT.read_text()):
        jax.clear_caches()
