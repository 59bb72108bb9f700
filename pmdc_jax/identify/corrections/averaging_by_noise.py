"""Which mean of an angle's differences a recorded speed is, by its noise alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...recordings.recording import OVER_BOTH, OVER_LAST, Averaging
from ...recordings.resolution import quantum
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN

# Most lines of an encoder
MAX_LINES = 2e4
# By how much a computed number of lines may differ from a whole one
LINES_TOLERANCE = 0.02
# Least noise power in counts squared next to the Nyquist frequency of a mean over the last sample, which has 1/3 there;
# a speed rounded to counts has 1/12
COUNTED_AT_NYQUIST = 1 / 6
# The same averaged over all high frequencies, where they have 1/4 and 1/12
COUNTED_IN_ALL = 1 / 7
# Power next to the Nyquist frequency over that near it, at most, for a mean over two samples: in theory 1/40
MAX_NYQUIST_RATIO = 1 / 8
# Frequency bands as shares of the Nyquist frequency: around half of it, near it, next to it, and all that are high
MIDDLE, NEAR, NEXT, HIGH = (0.4, 0.6), (0.9, 0.95), (0.98, 1.0), (0.4, 1.0)
# The upper end of the spectrum, and by how many standard errors and by how many counts squared its typical power must
# exceed that of the middle for a certain mean over the last sample, which has 1/6 more there
UPPER, RISE_ERRORS, MIN_RISE = (0.85, 1.0), 4.0, 0.06


def averaging_of_counts(counts: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The mean that speeds in counts per sample are, None if none, and the gain in log-likelihood that it must bring;
    if negative, the loss that is accepted.

    Angles rounded to counts have white noise of 1/12 count squared. In differences over one sample its power is four
    times that at the Nyquist frequency and twice that at half of it; in differences over two samples, in half counts,
    zero and four times. While the rotor turns steadily the rounding error is not noise but a beat at some frequency:
    only its total power is known then, and the fit must decide.
    """
    spectra = [_noise_spectrum(signal) for signal in counts]
    near, highest, in_all = (_mean_power(spectra, band) for band in (NEAR, NEXT, HIGH))
    if highest > COUNTED_AT_NYQUIST:
        return OVER_LAST, -np.inf if _rises(spectra) else -MIN_LOG_LIKELIHOOD_GAIN
    if in_all > COUNTED_IN_ALL and not highest < MAX_NYQUIST_RATIO * near:
        return OVER_LAST, MIN_LOG_LIKELIHOOD_GAIN
    return OVER_BOTH if highest < MAX_NYQUIST_RATIO * near else None, -MIN_LOG_LIKELIHOOD_GAIN


def averaging_of_differences(speeds: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The same for speeds that are no counts: differences over two samples have no power at the Nyquist frequency, any
    other signal with noise or steps has as much there as near it."""
    spectra = [_noise_spectrum(signal) for signal in speeds]
    near, highest = (_mean_power(spectra, band) if spectra else 0.0 for band in (NEAR, NEXT))
    return OVER_BOTH if highest < MAX_NYQUIST_RATIO * near else None, MIN_LOG_LIKELIHOOD_GAIN


class _Spectrum(NamedTuple):
    """The power of a signal, scaled as the variance of white noise with that power."""

    share: Float[np.ndarray, " frequencies"]  # of the Nyquist frequency
    power: Float[np.ndarray, " frequencies"]

    def within(self, band: tuple[float, float]) -> Float[np.ndarray, " _"]:
        """The powers at the frequencies of a band."""
        low, high = band
        return self.power[(low < self.share) & (self.share < high)]


def _noise_spectrum(signal: Float[np.ndarray, " samples"]) -> _Spectrum:
    """The spectrum of a signal, from its second differences: the much stronger low frequencies would leak into the high
    ones."""
    bends = np.diff(signal, 2)
    window = np.hanning(len(bends) + 1)[:-1]
    power = np.abs(np.fft.rfft((bends - bends.mean()) * window)) ** 2 / (window @ window)
    share = np.fft.rfftfreq(len(bends), 0.5)[1:]
    return _Spectrum(share, power[1:] / (2 * np.sin(np.pi * share / 2)) ** 4)


def _mean_power(spectra: Sequence[_Spectrum], band: tuple[float, float]) -> float:
    """The mean power of some signals in a band."""
    return float(np.mean([spectrum.within(band).mean() for spectrum in spectra]))


def _rises(spectra: Sequence[_Spectrum]) -> bool:
    """Whether the typical power is clearly larger at the upper end than in the middle of the spectra.

    That of a difference is; that of what a motor does falls, and that of any sensor's noise is even. By the medians,
    which a beat or a resonance leaves as they are.
    """
    powers = [np.concatenate([spectrum.within(band) for spectrum in spectra]) for band in (MIDDLE, UPPER)]
    middle, upper = (np.median(power) / np.log(2) for power in powers)
    # a median has 1.44 times the error of a mean, and the window makes neighbouring frequencies depend on each other
    errors = [2 * level / np.sqrt(len(power)) for level, power in zip((middle, upper), powers, strict=True)]
    return bool(upper > COUNTED_AT_NYQUIST and upper - middle > max(RISE_ERRORS * np.hypot(*errors), MIN_RISE))


def in_counts(speeds: Sequence[tuple[np.ndarray, float]]) -> list[np.ndarray]:
    """The speeds in counts per sample of an encoder with a whole number of lines; empty if they are no such counts."""
    counts = []
    for speed, sample_time in speeds:
        # a speed may jump by many counts from sample to sample, but its sorted values lie closer together
        step = quantum(np.diff(speed)) or quantum(np.diff(np.unique(speed)))
        lines = 2 * np.pi / step / sample_time if step else np.inf
        if lines > MAX_LINES:
            return []
        in_counts = speed / step
        # the tolerance grows with the error of a count where speeds were written with few digits
        rounded = np.quantile(np.abs(in_counts - np.round(in_counts)), 0.95)
        whole = LINES_TOLERANCE + lines * rounded / np.max(np.abs(in_counts))
        if abs(lines - round(lines)) > whole:
            return []
        counts.append(in_counts)
    return counts
