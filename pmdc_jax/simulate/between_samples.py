"""What drives a motor between its samples: held, straight or smooth, or, with uneven time stamps, in several pieces.

The solver takes a straight line over each sample, with the mean of the drive and the rise that has the same effect.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int
from scipy.interpolate import CubicSpline

from ..recordings.recording import jumps_of
from .timing import Timing

if TYPE_CHECKING:
    from ..recordings.recording import Recording

# A drive jumps where it changes by this many times what it does in the samples beside, and by this share of its range
MIN_JUMP_RATIO, MIN_JUMP_SHARE = 3.0, 0.05
# Decays of a current over a sample, as exponents, beyond which nothing changes
DECAYS = 1e-3, 200.0

Values = Float[Array | np.ndarray, "*#shape"]
# Mean of the drive over each sample, V, A or N m, and the change over it of the straight line in its place
MeanAndRise = tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]


def mean_and_rise(run: Recording, timing: Timing) -> MeanAndRise:
    """Mean of the drive of a run over each of its samples, and the rise of the straight line in its place."""
    if not run.has_even_clock:
        return mean_and_rise_of_pieces(run, pieces_of(run, timing.first_order_hold))
    value = np.asarray(getattr(run, run.drive))
    if timing.smooth is not None:
        return smooth_mean_and_rise(value, timing.smooth * run.sample_time)
    linear = timing.first_order_hold or varies_linearly(run)
    rise = np.diff(value, append=value[-1]) if linear else np.zeros(len(run))
    return value + rise / 2, rise


def value_on_line(mean: Values, rise: Values | None, share: Values | float) -> Values:
    """The value after a share of a sample of a straight line with this mean and rise; held if the rise is None."""
    return mean if rise is None else mean + (share - 0.5) * rise


class Pieces(NamedTuple):
    """The intervals between neighbouring instants at which a sample begins, of the record or of the even clock."""

    time: Float[np.ndarray, " pieces"]  # start, s
    begins: Float[np.ndarray, " pieces"]  # start after that of the even sample, s
    length: Float[np.ndarray, " pieces"]  # s
    even: Int[np.ndarray, " pieces"]  # index of the even sample that it is a part of
    value: Float[np.ndarray, " pieces"]  # driving value at the start, V, A or N m
    slope: Float[np.ndarray, " pieces"]  # of the driving value, per second
    load: Float[np.ndarray, " pieces"]  # N m, zero where unknown


def varies_linearly(run: Recording) -> bool:
    """Whether the drive always varies linearly from sample to sample, as a measured current does."""
    return run.drive == "current"


def pieces_of(run: Recording, first_order_hold: bool) -> Pieces:
    """The pieces of a run on an even clock, with a zero-order hold of the recorded drive, or a first-order one."""
    record, step = run.recorded, run.sample_time
    drive = np.asarray(getattr(record, record.drive))
    edges = np.union1d(np.append(run.time, run.time[-1] + step), record.time)
    begins, length = edges[:-1], np.diff(edges)
    even = np.searchsorted(run.time, begins, "right") - 1
    recorded = np.searchsorted(record.time, begins, "right") - 1
    linear = first_order_hold or varies_linearly(run)
    slopes = np.append(np.diff(drive) / np.diff(record.time), 0.0) * linear
    slope = slopes[recorded]
    value = drive[recorded] + slope * (begins - record.time[recorded])
    load = np.zeros(len(record)) if record.load is None else record.load
    return Pieces(begins, begins - run.time[even], length, even, value, slope, load[recorded])


def mean_and_rise_of_pieces(run: Recording, pieces: Pieces) -> MeanAndRise:
    """Mean of the drive over each even sample of a run, and the rise over it of the straight line that also has the
    drive's first moment."""
    _, begins, length, even, value, slope, _ = pieces
    step, rise = run.sample_time, slope * length
    middle = begins + length / 2 - step / 2
    integral = length * (value + rise / 2)
    moment = integral * middle + length**2 * rise / 12
    mean, first = (np.bincount(even, x, len(run)) / step for x in (integral, moment))
    return mean, 12 * first / step


def smooth_mean_and_rise(value: Float[np.ndarray, " samples"], decay: float) -> MeanAndRise:
    """Mean over each sample of a cubic spline through all samples between two jumps, and the rise of the straight line
    that has the same mean and the same effect on the current at the end of the sample.

    In the sample before a jump, the straight line before it goes on.

    **Arguments**: `value` of the drive at each sample; `decay`, R / L times the sample time.
    """
    of_square, of_cubic = _equivalent_rises(decay)
    mean, rise = value.copy(), np.zeros(len(value))
    jumps = jumps_of(value, MIN_JUMP_RATIO, MIN_JUMP_SHARE)
    for first, end in pairwise([0, *jumps, len(value)]):
        part = value[first:end]
        if len(part) < 2 or not np.ptp(part):
            continue
        cubic, square, linear, constant = CubicSpline(np.arange(len(part)), part).c
        mean[first : end - 1] = constant + linear / 2 + square / 3 + cubic / 4
        rise[first : end - 1] = linear + of_square * square + of_cubic * cubic
        rise[end - 1] = part[-1] - part[-2]
        mean[end - 1] += rise[end - 1] / 2
    return mean, rise


def _equivalent_rises(decay: float) -> tuple[float, float]:
    """The rises of the straight lines that have the same mean over a sample, and the same effect on the current at its
    end, as the square and the cube of the share of the sample that has passed."""
    share, weight = np.polynomial.legendre.leggauss(32)
    share, weight = (share + 1) / 2, weight / 2
    felt = np.exp(-np.clip(decay, *DECAYS) * (1 - share))
    felt = weight * (felt - weight @ felt)
    square, cubic = (float(felt @ share**k / (felt @ share)) for k in (2, 3))
    return square, cubic


def rise_like_step(share: Float[np.ndarray, " steps"], decay: float) -> Float[np.ndarray, " steps"]:
    """The rise of the straight line that has the same mean over a sample, and the same effect on the current at its
    end, as a unit step with this `share` of the sample still to pass.

    6 `share` (1 - `share`), the rise with the same first moment, where the current decays slowly.

    **Arguments**: `decay`, R / L times the sample time.
    """
    decay = float(np.clip(decay, *DECAYS))
    kept = -np.expm1(-decay)
    return (-np.expm1(-decay * share) - kept * share) / (1 - kept / decay - kept / 2)
