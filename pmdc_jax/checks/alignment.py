"""Time shifts between channels, and too slow sampling, judged by the response to edges of the voltage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ..recordings.recording import Finding, Recording, jumps_of
from .plausibility import regress, speed_of

MAX_SHIFT = 20  # samples, between channels
SHIFTS = sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs)
MAX_MISFIT_RATIO = 0.3  # a shift must leave less than this share of the misfit without one
# The mechanical equation tells whether a current was shifted alone or with the speed, where its misfit for one of both
# is less than this share of that for the other
CLEARLY_BETTER = 0.5
MIN_MISFIT = 0.01  # relative, below which no shift is needed
ABOUT_THE_LEAST = 1.5  # the smallest shift is taken whose misfit is within this factor of the least
# Share of its largest change within the window that a current may make in its first sample
MAX_FIRST_CHANGE = 0.9
MAX_EDGES = 2000  # that are averaged: more would take long and add nothing
MAX_GAP = 1.1  # length of a window over that of as many even samples, beyond which samples are missing in it
# Change of the voltage at an edge, over those in the samples beside it, and over its range
MIN_EDGE_RATIO, MIN_EDGE_SHARE = 2.0, 0.1
BEFORE_EDGE = 40  # samples
AFTER_EDGE = 100  # samples, including that of the voltage edge
# The effects that make a late speed harmless
LATE_SPEED = ("speed_sensor_delay", "speed_sensor_lag")


def shifted_channels(run: Recording) -> Iterator[Finding]:
    """Current or speed recorded later or earlier than the rest."""
    edge = _average_edge(run)
    if edge is None:
        return
    electrical = {shift: _electrical_misfit(edge, shift) for shift in SHIFTS}
    mechanical = {shift: _mechanical_misfit(edge, shift) for shift in SHIFTS}
    late, behind_speed = _best_shift(electrical), _best_shift(mechanical)
    if late and mechanical[0] < CLEARLY_BETTER * mechanical[late]:
        column, what, shift = "voltage", "current and speed are", late
    elif late and mechanical[late] < CLEARLY_BETTER * mechanical[0]:
        column, what, shift = "current", "the current is", late
    elif late:
        column, what, shift = "current", "the current, and perhaps the speed, is", late
    elif behind_speed:
        column, what, shift = "speed", "the speed is", -behind_speed
    else:
        return
    when = "late" if shift > 0 else "early"
    what += f" about {abs(shift)} samples ({abs(shift) * run.sample_time:.3g} s) {when}"
    mend = "Shift the data back, or record all channels with the same clock and filter"
    effects = LATE_SPEED if column == "speed" and shift > 0 else ()
    yield Finding(run.name, column, "warning", what, "at voltage edges", mend, effects)


def slow_sampling(run: Recording) -> Iterator[Finding]:
    """Sampling too slow to see the current rise."""
    edge = _average_edge(run)
    if edge is None:
        return
    current = edge.current[BEFORE_EDGE:] - edge.current[BEFORE_EDGE]
    if abs(current[1]) > MAX_FIRST_CHANGE * np.max(np.abs(current)):
        what = f"the current settles within one sample ({run.sample_time:.3g} s): L may be poorly determined"
        mend = "Sample faster than L / R if the standard error of L is too large"
        yield Finding(run.name, "current", "note", what, "at voltage edges", mend)


class _Edge(NamedTuple):
    """Channels around a voltage edge, each (BEFORE_EDGE + AFTER_EDGE,); the new voltage starts at BEFORE_EDGE."""

    voltage: np.ndarray
    current: np.ndarray
    speed: np.ndarray
    direction: np.ndarray


def _average_edge(run: Recording) -> _Edge | None:
    """The average over edges, per volt, or None if there is none or a channel is absent.

    The motor's equations are linear in these channels, so the average obeys them, with less noise.
    """
    speed = speed_of(run)
    if run.voltage is None or run.current is None or speed is None:
        return None
    jumps = np.diff(run.voltage)
    rows = jumps_of(run.voltage, MIN_EDGE_RATIO, MIN_EDGE_SHARE)
    rows = rows[(rows >= BEFORE_EDGE) & (rows <= len(run) - AFTER_EDGE)]
    rows = rows[:: len(rows) // MAX_EDGES + 1]
    about = rows[:, None] + np.arange(-BEFORE_EDGE, AFTER_EDGE)
    channels = [run.voltage[about], run.current[about], speed[about], np.sign(speed[about])]
    spans = run.time[rows + AFTER_EDGE - 1] - run.time[rows - BEFORE_EDGE]
    steady = spans < MAX_GAP * (BEFORE_EDGE + AFTER_EDGE - 1) * run.sample_time
    good = np.isfinite(channels).all((0, 2)) & steady
    if not good.any():
        return None
    weight = jumps[rows[good] - 1] / np.sum(jumps[rows[good] - 1] ** 2)
    return _Edge(*(weight @ values[good] for values in channels))


def _electrical_misfit(edge: _Edge, shift: int) -> float:
    """Relative residual of v = R i + Kb w + L di/dt with current and speed taken `shift` samples later."""
    rows = np.arange(MAX_SHIFT, BEFORE_EDGE + AFTER_EDGE - MAX_SHIFT - 1)
    later = rows + shift
    # two neighbouring currents span R i + L di/dt for any ratio of L / R to the step
    return _misfit(edge.voltage[rows], edge.current[later], edge.current[later + 1], edge.speed[later])


def _mechanical_misfit(edge: _Edge, shift: int) -> float:
    """Relative residual of J dw/dt = Kt i - f w - T sign(w) with the current taken `shift` samples later."""
    rows = np.arange(MAX_SHIFT, BEFORE_EDGE + AFTER_EDGE - MAX_SHIFT - 1)
    later = rows + shift
    # integrated once, so that the noise of the speed is not differentiated
    rates = (edge.current[later], edge.current[later + 1], edge.speed[rows], edge.direction[rows])
    return _misfit(edge.speed[rows], *map(np.cumsum, rates), rows.astype(float))


def _misfit(y: np.ndarray, *regressors: np.ndarray) -> float:
    _, explained = regress(y, {str(k): x for k, x in enumerate(regressors)})
    return float(np.sqrt(max(1 - explained, 0.0)))


def _best_shift(misfit: Mapping[int, float]) -> int:
    """The smallest shift with about the least misfit, if clearly better than no shift; otherwise 0."""
    unshifted, least = min(misfit[-1], misfit[0], misfit[1]), min(misfit.values())
    if unshifted < MIN_MISFIT or least > MAX_MISFIT_RATIO * unshifted:
        return 0
    return next(shift for shift in SHIFTS if misfit[shift] <= ABOUT_THE_LEAST * least)
