"""Where simulation and measurement disagree, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...diagnose.diagnosis import Region
from ...identify.identification import RunFit
from ...words import enumerate_words
from ..notation import percent, significant

VARIABLE_UNITS = {"speed": "rad/s", "current": "A", "voltage": "V", "angle": "rad", "frequency": "Hz"}
# the regions of both directions are described as one if their far ends differ by no more than this factor
MAX_END_RATIO = 2.0
Interval = tuple[float, float]


def disagreement(regions: Sequence[Region], fits: Mapping[str, RunFit]) -> str:
    """Which equation disagrees, and where, in words: by the clearest region and those of the same variable."""
    if not regions:
        return "by more than noise"
    clearest = regions[0]
    kind = _equation_and_variable(clearest)
    alike = [region.region for region in regions if _equation_and_variable(region) == kind]
    largest = _largest_size(clearest.variable, fits)
    where = intervals_in_words(clearest.variable, alike, largest)
    return f"in the {clearest.equation} equation, {where}"


def _equation_and_variable(region: Region) -> tuple[str, str]:
    return region.equation, region.variable


def _largest_size(variable: str, fits: Mapping[str, RunFit]) -> float | None:
    values = [getattr(fit, variable, None) for fit in fits.values()]
    # the knots of the curves end at this quantile
    sizes = [np.nanquantile(np.abs(one), 0.999) for one in values if one is not None and len(one)]
    return float(max(sizes)) if sizes else None


def intervals_in_words(variable: str, intervals: Sequence[Interval], largest: float | None = None) -> str:
    """Intervals of one variable in words; `largest` is its largest magnitude in the runs, a few outliers excluded."""
    joined = _merged(intervals)
    if variable == "time":
        parts = [f"{percent(100 * low)} to {percent(100 * high)}" for low, high in joined]
        return f"from {enumerate_words(parts)} of the run"
    unit = VARIABLE_UNITS[variable]
    named = "" if variable == "speed" else f"at a {variable} "
    ends = _symmetric(joined)
    if ends is None:
        parts = [f"from {significant(low)} to {significant(high)} {unit}" for low, high in joined]
        return named + enumerate_words(parts)
    low, high = ends
    if low > 0:
        size = f"from {significant(low)} to {significant(high)} {unit}"
    elif largest is not None and high > 0.95 * largest:
        return f"at every {variable}, in both directions"
    else:
        size = f"below {significant(high)} {unit}"
    return f"{named}{size}, in both directions"


def _merged(intervals: Sequence[Interval]) -> list[Interval]:
    """The intervals in order, with those that touch merged."""
    joined: list[Interval] = []
    for low, high in sorted(intervals):
        if joined and low <= joined[-1][1]:
            begin, end = joined.pop()
            low, high = begin, max(high, end)
        joined.append((low, high))
    return joined


def _symmetric(intervals: Sequence[Interval]) -> Interval | None:
    """The range of magnitudes that describes both directions; None if they differ, or there is only one."""
    forward = [(max(low, 0.0), high) for low, high in intervals if high > 0]
    backward = [(max(-high, 0.0), -low) for low, high in intervals if low < 0]
    if not (forward and backward):
        return None
    (nearest, farthest) = zip(*(_ends(side) for side in (forward, backward)), strict=True)
    if max(farthest) > MAX_END_RATIO * min(farthest):
        return None
    return min(nearest), max(farthest)


def _ends(intervals: Sequence[Interval]) -> Interval:
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)


def place_in_words(variable: str, value: float) -> str:
    """Where on the axis of a variable."""
    if variable == "time":
        return f"at {percent(100 * float(value))} of the run"
    return f"at {significant(float(value))} {VARIABLE_UNITS[variable]}"
