"""Resolution of a signal: the step of a converter or counter, of which all values are multiples."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Steps below this share of the largest one are rounding errors
ROUNDING_ERROR = 1e-9
# A quantum is the smallest step, or this quantile of the steps, where the smallest is an outlier
SMALLEST_QUANTILE = 0.01
# of which this share of the steps are multiples, to within this share of it
MIN_MULTIPLES, MULTIPLE_TOLERANCE = 0.95, 0.02
# Largest multiples by which a quantum is refined, pass after pass: a rough one counts only small multiples right
REACHES = (10, 100, np.inf)
# Euclid's algorithm: a remainder below this share of the largest number is zero,
ZERO_REMAINDER = 1e-8
# and a common divisor below this share, 20 bits, is none
MIN_DIVISOR = 1e-6


def common_divisor(values: Float[np.ndarray, " values"]) -> float:
    """The largest number of which all values are multiples, zero if there is none: by Euclid's algorithm, with
    remainders of either sign."""
    sizes = np.unique(np.abs(values))
    least, divisor = ZERO_REMAINDER * sizes[-1], 0.0
    for size in sizes[sizes > least]:
        rest = float(size)
        while rest > least:
            divisor, rest = rest, abs(divisor - rest * np.round(divisor / rest))
        if divisor < MIN_DIVISOR * sizes[-1]:
            return 0.0
    return divisor


def quantum(steps: Float[np.ndarray, " steps"]) -> float:
    """The step of which (nearly) all steps are multiples, zero if there is none; NaN are ignored."""
    sizes = np.abs(steps[~np.isnan(steps)])
    # differences of equal values that were computed by division may be a rounding error instead of zero
    sizes = sizes[sizes > ROUNDING_ERROR * np.max(sizes, initial=0.0)]
    if not len(sizes):
        return 0.0
    # the smallest step may be an outlier, a quantile may be a multiple of the quantum
    for smallest in (np.quantile(sizes, SMALLEST_QUANTILE), np.min(sizes)):
        step = _refined_quantum(sizes, float(smallest))
        off = np.abs(sizes / step - np.round(sizes / step))
        if np.mean(off < MULTIPLE_TOLERANCE) > MIN_MULTIPLES:
            return step
    return 0.0


def _refined_quantum(sizes: Float[np.ndarray, " steps"], step: float) -> float:
    """The step of which the sizes are multiples, refined from a rough one: larger multiples determine it better."""
    for reach in REACHES:
        near = sizes[sizes < reach * step]
        counts = np.round(near / step)
        step = float(near @ counts / (counts @ counts))
    return step
