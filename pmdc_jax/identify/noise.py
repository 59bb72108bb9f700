"""How large the noise of the measurements is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..differences import noise_by_differences

# A channel without noise (a simulation) is still scaled by something: this share of its size.
FLOOR = 1e-5
# Steps that are this share of the largest one are none
ROUNDING = 1e-9
# Numbers that differ by this share of the largest one are equal, and of 20 bits nobody knows the last
MULTIPLE, RESOLVED = 1e-8, 1e-6


def white_noise(signals: Sequence[np.ndarray]) -> float | None:
    """Standard deviation of the white part of some signals of one kind, None without any.

    From second differences, which leave a smooth motion out; by their median, which leaves jumps out. No less
    than what rounding to the quanta of the sensor does, which most differences do not show.
    """
    known = [s[~np.isnan(s)] for s in signals]
    if not any(len(s) > 2 for s in known):
        return None
    size = np.sqrt(np.mean([np.nanmean(np.square(s)) for s in signals]))
    spread = noise_by_differences(2, *known)
    return float(max(spread, resolution_noise(known), FLOOR * size, 1e-12))


def noise_of_sensor(measured: np.ndarray, left: np.ndarray) -> float:
    """Standard deviation of the white noise of a sensor by what a model leaves of it, zero where too little is known.

    No less than its steps make: most of what is left of a motor at rest does not change, however coarse an encoder is.
    """
    white = white_noise([left])
    return max(white, resolution_noise([measured])) if white else 0.0


def is_coarse(signal: np.ndarray) -> bool:
    """Whether a signal moves in steps that its noise does not blur: errors then last as long as it stands still."""
    known = signal[~np.isnan(signal)]
    return bool(np.std(np.diff(known, 2)) / np.sqrt(6.0) < 2 * resolution_noise([known]))


def resolution_noise(signals: Sequence[np.ndarray]) -> float:
    """Standard deviation of what rounding to the quanta of the sensor does."""
    return quantum(np.concatenate([np.diff(s) for s in signals])) / np.sqrt(12.0)


def resolution(values: Float[np.ndarray, " values"]) -> float:
    """The largest number of which all values are multiples, zero if there is none: by Euclid, of both signs."""
    sizes = np.unique(np.abs(values))
    least, found = MULTIPLE * sizes[-1], 0.0
    for size in sizes[sizes > least]:
        rest = float(size)
        while rest > least:
            found, rest = rest, abs(found - rest * np.round(found / rest))
        if found < RESOLVED * sizes[-1]:
            return 0.0
    return found


def quantum(steps: Float[np.ndarray, " steps"]) -> float:
    """The step of which all steps are multiples, zero if there is none; those that are not known do not count."""
    sizes = np.abs(steps[~np.isnan(steps)])
    # a number divided by another one differs from itself by its last bits
    sizes = sizes[sizes > ROUNDING * np.max(sizes, initial=0.0)]
    if not len(sizes):
        return 0.0
    # the smallest one may be none, the next ones may be two or more
    for smallest in (np.quantile(sizes, 0.01), np.min(sizes)):
        step = _of_multiples(sizes, float(smallest))
        off = np.abs(sizes / step - np.round(sizes / step))
        if np.mean(off < 0.02) > 0.95:
            return step
    return 0.0


def _of_multiples(sizes: Float[np.ndarray, " steps"], step: float) -> float:
    """The step of which sizes are multiples, from one of a few digits: the larger the multiple the more it tells."""
    for reach in (10, 100, np.inf):
        near = sizes[sizes < reach * step]
        counts = np.round(near / step)
        step = float(near @ counts / (counts @ counts))
    return step
