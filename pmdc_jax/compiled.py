"""Room for what JAX compiles, in programs that treat one set of recordings after another."""

from __future__ import annotations

from pathlib import Path

import jax

# Where Linux lists a process's memory maps, and says how many it may have
MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of them that must be free before new recordings are begun with: a diagnosis takes up to a quarter
FREE = 0.5


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
