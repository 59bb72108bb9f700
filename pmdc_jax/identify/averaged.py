"""A speed that is a difference of angles, and so a mean over one sample or two: taken for what it is.

Where the motor speeds up or slows down within some samples such a mean is late, or rounds its motion as a soft shaft
might. Which one was recorded the fits to all of them tell, and it is undone: the derivative of a cubic spline through
the same angles is the speed that has this mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_banded

from .likelihood import Samples, unlikely
from .noise import quantum
from .prepare import Prepared
from .refine import Polished, polish

# A mean must be this much likelier than the speed itself, by the logarithm; or be no less likely by more, where the
# speed moves by steps as counts of an encoder do
LIKELIER = 30.0
# An encoder has fewer lines, and a whole number of them
LINES, WHOLE = 2e4, 0.02


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

    A mean over the last sample is told from a delay only if the speed is clearly counted, and from an inductance only
    beside a current; and a speed that comes later than a mean would is late for another reason.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if no mean was found.
    """
    counted = _is_counted(given)
    means = [TWO, LAST] if given.problem.samples[0] > 0 else [TWO]
    tried = [_without(given, fit, mean) for mean in means]
    left = [unlikely(given, after, mean.of) for mean, (_, after) in zip(means, tried, strict=True)]
    least = int(np.argmin(left))
    mean, (undone, better) = means[least], tried[least]
    if unlikely(given, fit) - left[least] < (-LIKELIER if counted else LIKELIER):
        return given, fit
    if mean is LAST and not counted:
        return given, fit
    # a mean over two samples is in time as it is; undone, it has another noise
    in_time = fit if mean is TWO else better
    if _without(given, fit, LATE)[1].refined.fitness < in_time.refined.fitness:
        return given, fit
    return undone, better


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


def _is_counted(given: Prepared) -> bool:
    """Whether the speeds of all runs are multiples of what a line of an encoder makes in a sample."""
    speeds = [(run, run.speed) for run in given.training if run.speed is not None]
    for run, speed in speeds:
        step = quantum(np.diff(speed[~np.isnan(speed)]))
        lines = 2 * np.pi / step / np.median(np.diff(run.time)) if step else np.inf
        if lines > LINES or abs(lines - round(lines)) > WHOLE:
            return False
    return bool(speeds)
