"""An external torque that is periodic in time: one line in the spectra of the residuals of most runs.

No effect of the library has a frequency of its own, and the whitening filter would take a steady oscillation for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from .model import Model, series_of_runs

# Frequencies (bins) whose median power is the level around a line
NEIGHBOURS = 41
# Below the bin SLOWEST, where noise rises steeply, the level is taken from bins NEAR to FAR away; the bins up to NEAR
# are not searched
SLOWEST, NEAR, FAR = 12, 3, 6
# Least height of a line, power over the level around it. Measured on six runs each of motors that lack nothing: in
# single runs with quantised speed up to 180, but at one frequency of three runs no more than 7 in any noise; a periodic
# torque 200 and more in every run.
STANDS_OUT = 50.0
# ... and so many times that, on the geometric mean, with fewer than three runs
ALONE = 10.0
# A line that the drive has as well (higher than DRIVEN) counts only if it is ANSWERED times as high as the drive's: a
# controller reacts to an external torque
DRIVEN, ANSWERED = 10.0, 10.0
# A drive whose autocorrelation reaches this repeats itself: any misfit then has lines at its harmonics
REPEATED = 0.95
# Highest lines of each run that are looked for in the other runs
PEAKS = 5


class Line(NamedTuple):
    """A steady oscillation that most runs have."""

    low: float  # Hz
    high: float  # Hz
    height: float  # power over the level around it: median of the runs, geometric mean of fewer than three


class Spectrum(NamedTuple):
    """Power at each frequency over the level around it, of a run's residuals and drives: the largest of the signals."""

    residual: Float[np.ndarray, " frequencies"]
    driving: Float[np.ndarray, " frequencies"]
    duration: float  # s


def line_of(model: Model) -> Line | None:
    """The steady oscillation that a model leaves in most of the runs, if it leaves one."""
    spectra = []
    for run, fit in zip(model.given.training, series_of_runs(model), strict=True):
        drives = (run.voltage, run.torque, run.load, run.current)
        # a current drives only where there is no voltage
        there = [x for x in drives[: 3 + (run.voltage is None)] if x is not None]
        residuals = np.where(fit.residual.known[:, None], fit.residual.values, 0.0)
        driving = np.nan_to_num(np.stack(there, axis=1))
        spectra.append(spectrum(residuals[: len(driving)], driving, fit.residual.kind[0]))
    return common_line(spectra)


def spectrum(
    residuals: Float[np.ndarray, "samples outputs"],
    driving: Float[np.ndarray, "samples inputs"],
    step: float,
) -> Spectrum:
    """The spectra of one run, sampled every `step` seconds; that of the residuals is zero if a drive repeats itself."""
    shown = _over_level(residuals)
    if any(_repeats(one) for one in driving.T):
        shown = np.zeros_like(shown)
    return Spectrum(shown, _over_level(driving), len(residuals) * step)


def common_line(spectra: Sequence[Spectrum]) -> Line | None:
    """The highest line that stands out at one frequency in more than half of the runs, if there is one."""
    longest = max(spectra, key=lambda s: s.duration)
    enough = STANDS_OUT * (ALONE if len(spectra) < 3 else 1.0)
    best = None
    for one in spectra:
        for peak in np.argsort(one.residual)[-PEAKS:]:
            frequency = peak / one.duration
            mine = [height for s in spectra if (height := _own_height(frequency, s)) > 0]
            if 2 * sum(height > STANDS_OUT for height in mine) <= len(spectra):
                continue
            few = len(spectra) < 3
            height = float(np.exp(np.mean(np.log(mine))) if few else np.median(mine))
            if height < enough:
                continue
            if best is None or height > best.height:
                near = _near(frequency, longest, 1 / one.duration)
                sharp = near.start + int(np.argmax(longest.residual[near]))
                low, high = (sharp - 1) / longest.duration, (sharp + 1) / longest.duration
                best = Line(low, high, height)
    return best


def _own_height(frequency: float, one: Spectrum) -> float:
    """The height of a line in the residuals of a run; zero if the line is the drive's."""
    near = _near(frequency, one)
    height, driving = (float(x[near].max(initial=0.0)) for x in (one.residual, one.driving))
    return height if driving < max(DRIVEN, height / ANSWERED) else 0.0


def _near(frequency: float, one: Spectrum, width: float = 0.0) -> slice:
    """The bins of a run's spectrum nearest to a frequency in Hz, or within `width` of it."""
    low, high = (frequency - width) * one.duration, (frequency + width) * one.duration
    return slice(max(int(low) - 1, 0), int(high) + 3)


def _over_level(signals: Float[np.ndarray, "samples signals"]) -> Float[np.ndarray, " frequencies"]:
    """Power at every frequency over the level of its neighbours, the largest of all signals."""
    centred = signals - signals.mean(0)
    power = np.abs(np.fft.rfft(centred, axis=0)) ** 2
    level = ndimage.median_filter(power, (NEIGHBOURS, 1), mode="reflect") / np.log(2)
    floor = 1e-9 * power.sum(0) + 1e-300
    ratio = (power / np.maximum(level, floor)).max(1)
    slowest = ratio[:SLOWEST]
    slowest[:] = 0.0
    if len(ratio) > SLOWEST + FAR:
        slowest[NEAR + 1 :] = _over_neighbours(centred, floor)
    return ratio


def _over_neighbours(
    centred: Float[np.ndarray, "samples signals"], floor: Float[np.ndarray, " signals"]
) -> Float[np.ndarray, " slow"]:
    """The same for the bins from NEAR + 1 to SLOWEST - 1, tapered so that a line does not leak into its neighbours."""
    taper = np.hanning(len(centred))[:, None]
    power = np.abs(np.fft.rfft(centred * taper, axis=0)[: SLOWEST + FAR]) ** 2
    ratios = []
    for k in range(NEAR + 1, SLOWEST):
        neighbours = [*range(max(k - FAR, 1), k - NEAR + 1), *range(k + NEAR, k + FAR + 1)]
        level = np.median(power[neighbours], axis=0) / np.log(2)
        ratios.append(np.max(power[k] / np.maximum(level, floor)))
    return np.array(ratios)


def _repeats(driving: Float[np.ndarray, " samples"]) -> bool:
    """Whether a signal repeats itself after a lag of 5 to 50 % of its length."""
    x, n = driving - driving.mean(), len(driving)
    if not np.any(x):
        return False
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    products = np.fft.irfft(power)[:n]
    squares = np.append(0.0, np.cumsum(x**2))
    lags = np.arange(n // 20, n // 2)
    both = squares[n - lags] * (squares[n] - squares[lags])
    alike = products[lags] / np.sqrt(np.maximum(both, 1e-300))
    # a slow signal resembles itself at short lags without repeating itself: look beyond where it first differs
    apart = np.flatnonzero(alike < 0.5)
    return bool(len(apart) and np.any(alike[apart[0] :] > REPEATED))
