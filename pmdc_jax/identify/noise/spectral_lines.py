"""Lines in the spectra of residuals: steady oscillations at a frequency of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

# Frequencies (bins) whose median power is the level around a line
LEVEL_BINS = 41
# Below this bin, where noise rises steeply, the level is taken from bins `NEAREST` to `FARTHEST` away
SLOW_BINS = 12
NEAREST = 3  # bins up to this one are not searched
FARTHEST = 6
# Least height of a line, power over the level around it. Measured on six runs each of motors that lack nothing: in
# single runs with quantised speed up to 180, but at one frequency of three runs no more than 7 in any noise; a periodic
# torque 200 and more in every run.
MIN_HEIGHT = 50.0
# With fewer than three runs, the geometric mean of the heights must be so many times as large
FEW_RUNS_FACTOR = 10.0
# Height from which a line of the drive counts
MIN_DRIVE_HEIGHT = 10.0
# A line that the drive has as well must be so many times as high as the drive's: a controller reacts to an external
# torque
MIN_HEIGHT_OVER_DRIVE = 10.0
# A drive whose autocorrelation reaches this is periodic: any misfit then has lines at its harmonics
PERIODIC_CORRELATION = 0.95
# Highest lines of each run that are looked for in the other runs
PEAKS_PER_RUN = 5


class Line(NamedTuple):
    """A steady oscillation in most runs."""

    low: float  # Hz
    high: float  # Hz
    height: float  # power over the level around it: median of the runs, geometric mean of fewer than three


class Spectrum(NamedTuple):
    """Power at each frequency over the level around it, of a run's residuals and drives: the largest of the signals."""

    residual: Float[np.ndarray, " frequencies"]
    driving: Float[np.ndarray, " frequencies"]
    duration: float  # s


def spectrum(
    residuals: Float[np.ndarray, "readings outputs"], driving: Float[np.ndarray, "samples inputs"], step: float
) -> Spectrum:
    """The spectra of one run, whose residuals are read every `step` seconds while it is driven, at this or a shorter
    interval; that of the residuals is zero if a drive is periodic."""
    residual = _power_over_level(residuals)
    if any(_is_periodic(drive) for drive in driving.T):
        residual = np.zeros_like(residual)
    return Spectrum(residual, _power_over_level(driving), len(residuals) * step)


def common_line(spectra: Sequence[Spectrum]) -> Line | None:
    """The highest line that stands out at one frequency in more than half of the runs, if there is one."""
    longest = max(spectra, key=lambda s: s.duration * s.residual.any())  # of runs without a periodic drive
    few = len(spectra) < 3
    least = MIN_HEIGHT * (FEW_RUNS_FACTOR if few else 1.0)
    best = None
    for run in spectra:
        for peak in np.argsort(run.residual)[-PEAKS_PER_RUN:]:
            frequency = peak / run.duration
            heights = [height for s in spectra if (height := _height(frequency, s)) > 0]
            if 2 * sum(height > MIN_HEIGHT for height in heights) <= len(spectra):
                continue
            height = float(np.exp(np.mean(np.log(heights))) if few else np.median(heights))
            if height < least:
                continue
            if best is None or height > best.height:
                near = _near(frequency, longest, 1 / run.duration)
                sharpest = near.start + int(np.argmax(longest.residual[near]))
                low, high = (sharpest - 1) / longest.duration, (sharpest + 1) / longest.duration
                best = Line(low, high, height)
    return best


def _height(frequency: float, run: Spectrum) -> float:
    """The height of a line in the residuals of a run; zero if the line is due to the drive."""
    near = _near(frequency, run)
    height, driving = (float(x[near].max(initial=0.0)) for x in (run.residual, run.driving))
    return height if driving < max(MIN_DRIVE_HEIGHT, height / MIN_HEIGHT_OVER_DRIVE) else 0.0


def _near(frequency: float, run: Spectrum, width: float = 0.0) -> slice:
    """The bins of a run's spectrum nearest to a frequency in Hz, or within `width` of it."""
    low, high = (frequency - width) * run.duration, (frequency + width) * run.duration
    return slice(max(int(low) - 1, 0), int(high) + 3)


def _power_over_level(signals: Float[np.ndarray, "samples signals"]) -> Float[np.ndarray, " frequencies"]:
    """Power at every frequency over the level of its neighbours, the largest of all signals."""
    centred = signals - signals.mean(0)
    power = np.abs(np.fft.rfft(centred, axis=0)) ** 2
    level = ndimage.median_filter(power, (LEVEL_BINS, 1), mode="reflect") / np.log(2)
    floor = 1e-9 * power.sum(0) + 1e-300
    ratio = (power / np.maximum(level, floor)).max(1)
    ratio[:SLOW_BINS] = 0.0
    if len(ratio) > SLOW_BINS + FARTHEST:
        ratio[NEAREST + 1 : SLOW_BINS] = _slow_power_over_level(centred, floor)
    return ratio


def _slow_power_over_level(
    centred: Float[np.ndarray, "samples signals"], floor: Float[np.ndarray, " signals"]
) -> Float[np.ndarray, " slow"]:
    """The same for the bins from NEAREST + 1 to SLOW_BINS - 1, tapered so that a line does not leak into its
    neighbours."""
    taper = np.hanning(len(centred))[:, None]
    power = np.abs(np.fft.rfft(centred * taper, axis=0)[: SLOW_BINS + FARTHEST]) ** 2
    ratios = []
    for k in range(NEAREST + 1, SLOW_BINS):
        below, above = (range(max(k - FARTHEST, 1), k - NEAREST + 1), range(k + NEAREST, k + FARTHEST + 1))
        level = np.median(power[[*below, *above]], axis=0) / np.log(2)
        ratios.append(np.max(power[k] / np.maximum(level, floor)))
    return np.array(ratios)


def _is_periodic(driving: Float[np.ndarray, " samples"]) -> bool:
    """Whether a signal repeats itself after a lag of 5 to 50 % of its length."""
    x, n = driving - driving.mean(), len(driving)
    if not np.any(x):
        return False
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    products = np.fft.irfft(power)[:n]
    squares = np.append(0.0, np.cumsum(x**2))
    lags = np.arange(n // 20, n // 2)
    both = squares[n - lags] * (squares[n] - squares[lags])
    correlation = products[lags] / np.sqrt(np.maximum(both, 1e-300))
    # a slow signal resembles itself at short lags without being periodic: look beyond where it first differs
    different = np.flatnonzero(correlation < 0.5)
    return bool(len(different) and np.any(correlation[different[0] :] > PERIODIC_CORRELATION))
