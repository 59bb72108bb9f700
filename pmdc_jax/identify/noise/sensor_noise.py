"""Standard deviation of the noise of measured signals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ...recordings.noise import noise_by_differences
from ...recordings.resolution import quantum

# Least noise of an output, as a share of its root mean square: a simulation without noise needs some scale, too
MIN_RELATIVE_NOISE = 1e-5
# Least noise of an output that is zero throughout, in its unit
MIN_NOISE = 1e-12


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
    Where they are exactly zero, as of a rotor that rests in measurement and simulation, they say nothing.
    """
    white = white_noise([residual[residual != 0]])
    return max(white, resolution_noise([measured])) if white else 0.0


def ratio_to_noise(measured_and_left: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Root mean square of the residuals of an output over the white noise of its sensor in each run, which is taken to
    be at least `MIN_RELATIVE_NOISE` of what was measured: a simulation leaves smaller errors of any kind.

    **Arguments**: what was measured and the residuals in every run, NaN where missing; runs too short to show their
    noise do not count.
    """
    scaled = [
        residual / max(noise, MIN_RELATIVE_NOISE * rms(measured))
        for measured, residual in measured_and_left
        if (noise := noise_of_sensor(measured, residual))
    ]
    return float(np.sqrt(np.nanmean(np.square(np.concatenate(scaled))))) if scaled else 0.0


def is_coarse(signal: np.ndarray) -> bool:
    """Whether a signal is quantised in steps that its noise does not blur: errors then last while it is constant."""
    known = signal[~np.isnan(signal)]
    return bool(np.std(np.diff(known, 2)) / np.sqrt(6.0) < 2 * resolution_noise([known]))


def resolution_noise(signals: Sequence[np.ndarray]) -> float:
    """Standard deviation of the rounding error due to the resolution of the sensor: quantum / sqrt(12)."""
    return quantum(np.concatenate([np.diff(s) for s in signals])) / np.sqrt(12.0)
