"""A speed that is a difference of angles, and so a mean over one sample or two: taken for what it is.

Where the motor speeds up or slows down within some samples such a mean is late, or rounds its motion as a soft shaft
might. The noise of the angles shows which one it is, and in case of doubt the fits to the one and to the other. It is
undone: the derivative of a cubic spline through the same angles is the speed that has this mean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_banded

from ...motor import Motor
from ...simulate import Tape
from ..likelihood import LIKELIER, Samples, negative_log_likelihood
from ..noise import quantum
from ..polish import Fit, polish
from ..prepare import Prepared

# An encoder has fewer lines, and a whole number of them
LINES, WHOLE = 2e4, 0.02
# Power in counts squared, between that of a speed that was rounded to counts, 1/12, and that of such a mean, 1/3
COUNTED = 1 / 6
# ... and the same of the mean over all high frequencies, between 1/12 and 1/4
COUNTED_IN_ALL = 1 / 7
# ... known of a run of so many samples
ENOUGH = 200
# Shares of the highest frequency about half of it, near it, and next to it; and all that are high
BANDS = ((0.4, 0.6), (0.9, 0.95), (0.98, 1.0), (0.4, 1.0))
# A mean is undone where the mechanical time constant is so many samples long
SMOOTH = 2.0
# A mean over two samples has no more than this share of the power near the highest frequency next to it: in theory 1/40
NONE = 1 / 8


class Averaging(NamedTuple):
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


def two_undone(mean: Samples) -> Samples:
    bands = np.repeat([[1 / 6], [4 / 6], [1 / 6]], len(mean), axis=1)
    bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
    return solve_banded((1, 1), bands, mean)


def _over_last(speed: Samples) -> Samples:
    around = np.concatenate([speed[:1], speed[:1], speed, speed[-1:]])
    return np.convolve(around, [-1 / 24, 13 / 24, 13 / 24, -1 / 24], "valid")


def _last_undone(mean: Samples) -> Samples:
    """Two means over one sample are one over two; the last sample goes on as straight as the one before it."""
    ahead = np.append(mean[1:], 2 * mean[-1] - mean[-2:-1].sum())
    return two_undone((mean + ahead) / 2)


TWO = Averaging("the last and the next sample", _over_two, two_undone)
LAST = Averaging("the last sample", _over_last, _last_undone)
LATE = Averaging("", lambda x: np.append(x[:1], x[:-1]), lambda x: np.append(x[1:], x[-1:]))


def of_averaged(given: Prepared) -> Callable[[Samples], Samples]:
    """What the sensors of runs made of their speeds, as far as it was undone."""
    return given.averaging.of if given.averaging else lambda speed: speed


def as_recorded(given: Prepared) -> Prepared:
    """The runs with their outputs as recorded, whatever was undone."""
    measured = jnp.asarray(Tape.from_recordings(given.runs).measured)
    return given.with_tape(measured=measured)._replace(averaging=None)


def seems_averaged(given: Prepared) -> bool:
    """Whether the speeds are counts of an encoder whose noise is that of means."""
    counts = _in_counts(_speeds(given))
    return bool(counts) and counted_over(counts)[0] is not None


def may_be_averaged(given: Prepared, motor: Motor) -> bool:
    """Whether the noise is that of means, but the motor settles too fast for the fits to tell, or for the mean to be
    undone: it is no smooth curve from sample to sample."""
    time_constant = float(motor.R * motor.J / (motor.Kt * motor.Kb))
    finest = float(np.min(np.asarray(given.problem.tape.sample_time)))
    return given.averaging is None and time_constant < SMOOTH * finest and seems_averaged(given)


def without_averaging(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with the speed itself where a mean was recorded, and the fit to them.

    A mean over the last sample is told from a delay only if the speed is counted, and from an inductance only beside
    a current; and a speed that comes later than a mean would is late for another reason.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if no mean was found.
    """
    speeds = _speeds(given)
    counts = _in_counts(speeds)
    mean, enough = counted_over(counts) if counts else differenced_over([s for s, _ in speeds])
    if mean is None or (mean is LAST and not given.problem.samples[0] > 0):
        return given, fit
    undone, better = _without(given, fit, mean)
    left = negative_log_likelihood(given, better, mean.of)
    if not negative_log_likelihood(given, fit) - left > enough:
        return given, fit
    if not counts:
        # a mean over two samples is in time as it is; undone, it has another noise than what is but late
        last, late = (_without(given, fit, other)[1] for other in (LAST, LATE))
        if negative_log_likelihood(given, last, LAST.of) < left or late.fitness < fit.fitness:
            return given, fit
    return undone, better


def counted_over(counts: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """Of what speeds are the mean that are multiples of a count a sample, if of anything; and how much likelier that
    must make them, by the logarithm; if less than nothing, no less likely by more.

    Angles that are rounded to counts have a white noise of 1/12 count squared. Of differences over one sample it is
    four times as strong at the highest frequency, and twice at half of that; of differences over two samples, counted
    by halves, it is none at all, and four times. While a rotor turns steadily the noise is no noise but a beat, which
    may be anywhere: then it is as strong in all, and the fit must tell.
    """
    middle, high, highest, in_all = _powers(counts)
    if highest > COUNTED:
        clearly = highest > np.sqrt(2.0) * max(middle, COUNTED)
        return LAST, -np.inf if clearly else -LIKELIER
    if in_all > COUNTED_IN_ALL and not highest < NONE * high:
        return LAST, LIKELIER
    return TWO if highest < NONE * high else None, -LIKELIER


def differenced_over(speeds: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The same of other speeds: nothing of differences over two samples is at the highest frequency, but of any other
    signal with noise or steps there is as much as near it."""
    _, high, highest, _ = _powers(speeds) if speeds else (0.0, 0.0, 0.0, 0.0)
    return TWO if highest < NONE * high else None, LIKELIER


def _powers(signals: Sequence[np.ndarray]) -> Float[np.ndarray, "bands"]:
    """The power of some signals within each of the `BANDS`, if it were the same at all frequencies.

    By second differences: what is slow is so much stronger that it would leak.
    """
    powers = []
    for signal in signals:
        bends = np.diff(signal, 2)
        window = np.hanning(len(bends) + 1)[:-1]
        power = np.abs(np.fft.rfft((bends - bends.mean()) * window)) ** 2 / (window @ window)
        share = np.fft.rfftfreq(len(bends), 0.5)[1:]
        white = power[1:] / (2 * np.sin(np.pi * share / 2)) ** 4
        powers.append([white[(low < share) & (share < high)].mean() for low, high in BANDS])
    return np.mean(powers, axis=0)


def _without(given: Prepared, fit: Fit, averaging: Averaging) -> tuple[Prepared, Fit]:
    """The runs with the speed of which a mean was recorded, and the fit to them."""
    tape = given.problem.tape
    measured = np.array(tape.measured)
    for run in range(tape.runs):
        mine = tape.blocks_of(run)
        known = np.asarray(tape.weight)[mine, 1].ravel() > 0
        if known.sum() > 2 and not given.differentiated[run]:
            speed = measured[mine, 1].ravel()
            speed[known] = averaging.undone(speed[known])
            measured[mine, 1] = speed.reshape(-1, measured.shape[2])
    undone = given.with_tape(measured=jnp.asarray(measured))._replace(averaging=averaging)
    return undone, polish(undone.problem, fit.optimum)


def _speeds(given: Prepared) -> list[tuple[np.ndarray, float]]:
    """The speeds of all runs that are long enough to show their noise, rad/s, and the time between samples, s."""
    recorded = [
        (run.speed, np.diff(run.time))
        for run, ours in zip(given.training, given.differentiated, strict=False)
        if run.speed is not None and not ours
    ]
    known = [(speed[~np.isnan(speed)], float(np.median(steps))) for speed, steps in recorded]
    return [(speed, step) for speed, step in known if len(speed) >= ENOUGH]


def _in_counts(speeds: Sequence[tuple[np.ndarray, float]]) -> list[np.ndarray]:
    """The speeds in counts a sample, of an encoder with as many lines; none, if they are no such counts."""
    counts = []
    for speed, sample_time in speeds:
        # from sample to sample a speed may leap by many counts, its values lie closer
        step = quantum(np.diff(speed)) or quantum(np.diff(np.unique(speed)))
        lines = 2 * np.pi / step / sample_time if step else np.inf
        if lines > LINES or abs(lines - round(lines)) > WHOLE:
            return []
        counts.append(speed / step)
    return counts
