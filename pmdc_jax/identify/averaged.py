"""A speed that is a difference of angles, and so a mean over one sample or two: taken for what it is.

Where the motor speeds up or slows down within some samples such a mean is late, or rounds its motion as a soft shaft
might. Counts of an encoder show by their noise which one it is; of other speeds the fits to the one and to the other
tell. It is undone: the derivative of a cubic spline through the same angles is the speed that has this mean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_banded
from scipy.signal import periodogram

from .likelihood import Samples, unlikely
from .noise import quantum
from .prepare import Prepared
from .refine import Polished, polish

# A mean must be this much likelier than the speed itself, by the logarithm; or be no less likely by more, where the
# speed is counted like one but other noise would show alike
LIKELIER = 30.0
# An encoder has fewer lines, and a whole number of them
LINES, WHOLE = 2e4, 0.02
# Power in counts squared, between that of a speed that was rounded to counts, 1/12, and that of such a mean, 1/3
COUNTED = 1 / 6
# ... known of a run of so many samples
ENOUGH = 100
# ... and the share of it that a mean over two samples has at the highest frequencies, at most: 1/40 and what leaks
NONE = 1 / 8


class Sensed(NamedTuple):
    """What a sensor may make of a speed, to third order in the sample time, and how to undo it.

    The samples at both ends are as given, or nearly so.
    """

    over: str  # of what it is a mean, if of anything
    of: Callable[[Samples], Samples]
    undone: Callable[[Samples], Samples]


def _over_two(speed: Samples) -> Samples:
    mean = np.convolve(speed, [1 / 6, 4 / 6, 1 / 6], "same")
    mean[[0, -1]] = speed[[0, -1]]
    return mean


def _two_undone(mean: Samples) -> Samples:
    bands = np.repeat([[1 / 6], [4 / 6], [1 / 6]], len(mean), axis=1)
    bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
    return solve_banded((1, 1), bands, mean)


def _over_last(speed: Samples) -> Samples:
    around = np.concatenate([speed[:1], speed[:1], speed, speed[-1:]])
    return np.convolve(around, [-1 / 24, 13 / 24, 13 / 24, -1 / 24], "valid")


def _last_undone(mean: Samples) -> Samples:
    """Two means over one sample are one over two; the last sample goes on as straight as the one before it."""
    ahead = np.append(mean[1:], 2 * mean[-1] - mean[-2:-1].sum())
    return _two_undone((mean + ahead) / 2)


TWO = Sensed("the last and the next sample", _over_two, _two_undone)
LAST = Sensed("the last sample", _over_last, _last_undone)
LATE = Sensed("", lambda x: np.append(x[:1], x[:-1]), lambda x: np.append(x[1:], x[-1:]))


def without_averaging(given: Prepared, fit: Polished) -> tuple[Prepared, Polished]:
    """The runs with the speed itself where a mean was recorded, and the fit to them.

    A mean over the last sample is told from a delay only if the speed is counted, and from an inductance only beside
    a current; and a speed that comes later than a mean would is late for another reason.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if no mean was found.
    """
    counts = _counts(given)
    mean, enough = counted_over(counts) if counts else (TWO, LIKELIER)
    if mean is None or (mean is LAST and not given.problem.samples[0] > 0):
        return given, fit
    undone, better = _without(given, fit, mean)
    left = unlikely(given, better, mean.of)
    if not unlikely(given, fit) - left > enough:
        return given, fit
    if not counts:
        # a mean over two samples is in time as it is; undone, it has another noise than what is but late
        last, late = (_without(given, fit, sensed)[1] for sensed in (LAST, LATE))
        if unlikely(given, last, LAST.of) < left or late.refined.fitness < fit.refined.fitness:
            return given, fit
    return undone, better


def counted_over(counts: Sequence[Samples]) -> tuple[Sensed | None, float]:
    """Of what speeds are the mean that are multiples of a count a sample, if of anything; and how much likelier that
    must make them, by the logarithm.

    Angles that are rounded to counts have a white noise of 1/12 count squared. Of differences over one sample it is
    four times as strong at the highest frequency, and twice at half of that; of differences over two samples, counted
    by halves, it is none at all, and four times.
    """
    middle, highest = np.mean([_powers(one) for one in counts], axis=0)
    if highest > COUNTED:
        clearly = highest > np.sqrt(2.0) * max(middle, COUNTED)
        return LAST, -np.inf if clearly else -LIKELIER
    over_two = middle > COUNTED and highest < NONE * middle
    return TWO if over_two else None, -LIKELIER


def _powers(signal: Samples) -> tuple[float, float]:
    """The power of a signal about half of its highest frequency, and near the highest, if it were the same at all.

    By second differences: what is slow is so much stronger that it would leak.
    """
    share, power = periodogram(np.diff(signal, 2), fs=2.0, window="hann", detrend="constant")
    white = power[1:] / (2 * np.sin(np.pi * share[1:] / 2)) ** 4
    bands = ((share[1:] > low) & (share[1:] < high) for low, high in ((0.4, 0.6), (0.9, 1.0)))
    middle, highest = (float(white[band].mean()) for band in bands)
    return middle, highest


def _without(given: Prepared, fit: Polished, sensed: Sensed) -> tuple[Prepared, Polished]:
    """The runs with the speed of which a mean was recorded, and the fit to them."""
    tape = given.problem.tape
    measured = np.array(tape.measured)
    for run in range(tape.runs):
        mine = np.asarray(tape.run) == run
        known = np.asarray(tape.weight)[mine, 1].ravel() > 0
        if known.sum() > 2:
            speed = measured[mine, 1].ravel()
            speed[known] = sensed.undone(speed[known])
            measured[mine, 1] = speed.reshape(-1, measured.shape[2])
    problem = replace(given.problem, tape=replace(tape, measured=jnp.asarray(measured)))
    return given._replace(problem=problem, averaged=sensed.over), polish(problem, fit.refined)


def _counts(given: Prepared) -> list[Samples]:
    """The speeds of all runs in counts a sample, of an encoder with as many lines; none, if they are no such counts."""
    counts = []
    for run in given.training:
        if run.speed is None:
            continue
        speed = run.speed[~np.isnan(run.speed)]
        step = quantum(np.diff(speed))
        lines = 2 * np.pi / step / np.median(np.diff(run.time)) if step else np.inf
        if lines > LINES or abs(lines - round(lines)) > WHOLE or len(speed) < ENOUGH:
            return []
        counts.append(speed / step)
    return counts
