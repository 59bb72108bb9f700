"""Standard deviation and resolution of measured signals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ...recordings.white_noise import noise_by_differences

# Least noise of an output, as a share of its root mean square: a simulation without noise needs some scale, too
MIN_RELATIVE_NOISE = 1e-5
# Least noise of an output that is zero throughout, in its unit
MIN_NOISE = 1e-12
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


def rms(signal: Float[np.ndarray, " samples"]) -> float:
    """Root mean square of a signal without its gaps, which are NaN."""
    return float(np.sqrt(np.nanmean(np.square(signal))))


def white_noise(signals: Sequence[np.ndarray]) -> float | None:
    """Standard deviation of the white noise in signals of one kind, None if none has more than two samples.

    Estimated from second differences, which remove smooth motion, by their median, which ignores jumps. It is at least
    the rounding noise of the sensor's resolution, which most differences do not show.
    """
    known = [s[~np.isnan(s)] for s in signals]
    if not any(len(s) > 2 for s in known):
        return None
    size = np.sqrt(np.mean([np.nanmean(np.square(s)) for s in signals]))
    spread = noise_by_differences(2, *known)
    return float(max(spread, resolution_noise(known), MIN_RELATIVE_NOISE * size, MIN_NOISE))


def noise_of_sensor(measured: np.ndarray, residual: np.ndarray) -> float:
    """Standard deviation of a sensor's white noise from the residuals `residual` by a model, zero with too few samples.

    It is at least the rounding noise of the sensor: at rest the residuals hardly change, however coarse an encoder is.
    """
    white = white_noise([residual])
    return max(white, resolution_noise([measured])) if white else 0.0


def ratio_to_noise(measured_and_left: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Root mean square of the residuals of an output over the white noise of its sensor in each run.

    **Arguments**: what was measured and the residuals in every run, NaN where missing; runs too short to show their
    noise do not count.
    """
    scaled = [
        residual / noise for measured, residual in measured_and_left if (noise := noise_of_sensor(measured, residual))
    ]
    return float(np.sqrt(np.nanmean(np.square(np.concatenate(scaled))))) if scaled else 0.0


def is_coarse(signal: np.ndarray) -> bool:
    """Whether a signal is quantised in steps that its noise does not blur: errors then last while it is constant."""
    known = signal[~np.isnan(signal)]
    return bool(np.std(np.diff(known, 2)) / np.sqrt(6.0) < 2 * resolution_noise([known]))


def resolution_noise(signals: Sequence[np.ndarray]) -> float:
    """Standard deviation of the rounding error due to the resolution of the sensor: quantum / sqrt(12)."""
    return quantum(np.concatenate([np.diff(s) for s in signals])) / np.sqrt(12.0)


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
