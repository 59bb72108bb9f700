"""Timing rows side by side: interleaved repeats, so that a busy machine is unfair to all alike."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from statistics import median
from typing import Any, NamedTuple


class Row(NamedTuple):
    """One way of computing the same thing; `work` is what one call does, in the table's unit."""

    name: str
    run: Callable[[], Any]
    work: float = 1.0
    repeats: int = 9


class Timed(NamedTuple):
    """Median seconds a call, seconds of the first call (compilation included), and its result."""

    row: Row
    seconds: float
    first: float
    result: Any

    @property
    def microseconds_a_unit(self) -> float:
        """Median microseconds for one unit of work."""
        return 1e6 * self.seconds / self.row.work


def _clocked(run: Callable[[], Any], calls: int = 1) -> tuple[float, Any]:
    """Seconds a call, and the last result."""
    begin = time.perf_counter()
    for _ in range(calls):
        result = run()
    return (time.perf_counter() - begin) / calls, result


def _calls_a_turn(run: Callable[[], Any]) -> int:
    """Calls to fill 30 ms: in a single short call, waking the threads up would be all one sees."""
    return max(1, int(0.03 / _clocked(run)[0]))


def interleaved(rows: Sequence[Row]) -> list[Timed]:
    """Warm every row up, then take turns until each has had its repeats."""
    firsts = [_clocked(row.run) for row in rows]
    calls = [_calls_a_turn(row.run) for row in rows]
    seconds: list[list[float]] = [[] for _ in rows]
    for turn in range(max(row.repeats for row in rows)):
        for row, count, taken in zip(rows, calls, seconds, strict=True):
            if turn < row.repeats:
                taken.append(_clocked(row.run, count)[0])
    return [
        Timed(row, median(taken), *first)
        for row, taken, first in zip(rows, seconds, firsts, strict=True)
    ]


def machine() -> str:
    """Where and with what the numbers were measured."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "diffrax", "numba", "scipy"))
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    return f"{os.cpu_count()} cores of {platform.machine()}, {load}; {packages}"
