"""Timing with interleaved repeats, so that other work on the machine affects all rows alike."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from statistics import median
from typing import Any, NamedTuple


class Row(NamedTuple):
    """One method of computing the same result; `work` is that of one call, in the unit of the table."""

    name: str
    run: Callable[[], Any]
    work: float = 1.0
    repeats: int = 9


class Timed(NamedTuple):
    """Median seconds per call, seconds of the first call (compilation included), and its result."""

    row: Row
    seconds: float
    first: float
    result: Any

    @property
    def microseconds_per_unit(self) -> float:
        """Median microseconds for one unit of work."""
        return 1e6 * self.seconds / self.row.work


def _clocked(run: Callable[[], Any], calls: int = 1) -> tuple[float, Any]:
    """Seconds per call, and the last result."""
    begin = time.perf_counter()
    for _ in range(calls):
        result = run()
    return (time.perf_counter() - begin) / calls, result


def _calls_per_turn(run: Callable[[], Any]) -> int:
    """Number of calls that take 30 ms: a single short call would measure only the wake-up of threads."""
    return max(1, int(0.03 / _clocked(run)[0]))


def interleaved(rows: Sequence[Row]) -> list[Timed]:
    """Warm up every row, then call them in turn until all repeats are done."""
    firsts = [_clocked(row.run) for row in rows]
    calls = [_calls_per_turn(row.run) for row in rows]
    seconds: list[list[float]] = [[] for _ in rows]
    for turn in range(max(row.repeats for row in rows)):
        for row, count, taken in zip(rows, calls, seconds, strict=True):
            if turn < row.repeats:
                taken.append(_clocked(row.run, count)[0])
    return [Timed(row, median(taken), *first) for row, taken, first in zip(rows, seconds, firsts, strict=True)]


def machine() -> str:
    """The machine and the packages with which the numbers were measured."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "diffrax", "numba", "scipy"))
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    return f"{os.cpu_count()} cores of {platform.machine()}, {load}; {packages}"
