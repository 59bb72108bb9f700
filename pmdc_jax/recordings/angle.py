"""Shaft angles: unwrapping those that were recorded modulo one turn, and the speeds that they give."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

Samples = Float[np.ndarray, " samples"]

# Largest span of a wrapped angle, turns
ONE_TURN = 1.01


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
