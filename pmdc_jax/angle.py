"""Shaft angles that were recorded to start again after each turn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

Samples = Float[np.ndarray, " samples"]

# A wrapped angle spans no more than so many turns
ONE_TURN = 1.01


def unwrapped(angle: Samples) -> tuple[Samples, Int[np.ndarray, " wraps"]]:
    """An angle that goes on, where it was recorded to start again after each turn.

    **Arguments**: `angle`, rad, (samples,), NaN where it is missing.

    **Returns**: the angle, rad, (samples,), as it was if it wraps nowhere; and the samples that come after a wrap.
    """
    known = np.flatnonzero(~np.isnan(angle))
    # a wrapped angle jumps by most of a turn between samples; a travel in metres or turns never does
    wraps = known[1:][np.abs(np.diff(angle[known])) > np.pi]
    # of the encoders in use, one counts 0 ... 2 pi and the other -pi ... pi
    if not len(wraps) or np.ptp(angle[known]) > 2 * np.pi * ONE_TURN:
        return angle, wraps[:0]
    going_on = np.full_like(angle, np.nan)
    going_on[known] = np.unwrap(angle[known])
    return going_on, wraps
