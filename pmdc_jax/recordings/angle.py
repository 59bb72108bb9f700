"""Shaft angles: unwrapping those that were recorded modulo one turn, and the speeds that they give."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from .resolution import quantum

Samples = Float[np.ndarray, " samples"]

# Largest span of a wrapped angle, turns
ONE_TURN = 1.01
# Counts are recognised by at least so many intervals with few of them: the more there are in one, the more the rounding
# of its time stamps blurs their number
MIN_COUNTED, FEW_COUNTS = 50, 8


def unwrapped(angle: Samples) -> tuple[Samples, Int[np.ndarray, " wraps"]]:
    """Unwrap an angle that was recorded modulo one turn.

    **Arguments**: `angle`, rad, (samples,), NaN where it is missing.

    **Returns**: the continuous angle, rad, (samples,), which is `angle` itself if it is not wrapped; and the indices of
    the samples that follow a wrap.
    """
    known = np.flatnonzero(~np.isnan(angle))
    # only a wrapped angle jumps by more than half a turn between samples; a travel in metres or turns does not
    wraps = known[1:][np.abs(np.diff(angle[known])) > np.pi]
    # encoders count either 0 ... 2 pi or -pi ... pi: only the span is the same
    if not len(wraps) or np.ptp(angle[known]) > 2 * np.pi * ONE_TURN:
        return angle, wraps[:0]
    going_on = np.full_like(angle, np.nan)
    going_on[known] = np.unwrap(angle[known])
    return going_on, wraps


def mean_speeds(time: Samples, angle: Samples) -> Samples:
    """The mean speed, rad/s, from the last known angle in rad to each one; NaN at the first and where none is known."""
    known = np.flatnonzero(~np.isnan(angle))
    speed = np.full_like(angle, np.nan)
    speed[known[1:]] = np.diff(angle[known]) / np.diff(time[known])
    return speed


def angle_of_counts(time: Samples, speed: Samples) -> Samples | None:
    """The angle, rad, of which a speed is the mean over each interval of an uneven clock, in counts of an encoder; None
    if it is no such mean. It begins at zero, and the first speed is lost."""
    intervals = np.diff(time)
    turned = speed[1:] * intervals
    sizes = np.abs(turned[turned != 0])
    few = sizes[sizes < FEW_COUNTS * np.min(sizes, initial=np.inf)]
    if np.isnan(turned).any() or len(few) < MIN_COUNTED:
        return None
    count = quantum(few)
    # a converter of the speed has steps of the speed itself
    if not count or quantum(np.diff(np.unique(speed))) * np.median(intervals) > count / 2:
        return None
    return np.append(0.0, np.cumsum(turned))
