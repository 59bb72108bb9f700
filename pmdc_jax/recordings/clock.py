"""Whether samples were taken at their uneven time stamps, or evenly, with only the stamps uneven.

A computer that stamps the samples of a sampling clock stamps some early and some late. Samples that were truly taken
late show it: a rising speed has risen further by then.
"""

from __future__ import annotations

import attrs
import numpy as np
from jaxtyping import Float

from .recording import Recording

Samples = Float[np.ndarray, " samples"]

# Time stamps more than this many typical steps apart leave a gap, in which outputs are missing; exactly three steps,
# up to rounding, leave none
GAP = 3.0 * (1 + 1e-9)
# Largest distance of a time stamp from an even clock, in steps, that is taken for rounding of the stamps
ROUNDING = 0.02
# Largest distance, in steps, of the stamp of a sample that may have been taken evenly
MAX_LATENESS = 3.0
# Samples on either side over which a slope is taken
SLOPE_SAMPLES = 5
# Samples count as evenly taken if the signal follows less than this share of the lateness of their stamps ...
MAX_FOLLOWED_SHARE = 0.5
# ... by so many standard errors
STANDARD_ERRORS = 4.0
# Expected changes are rounding errors if their sum of squares is less than this share of the signal's
ROUNDED_SQUARES = 1e-18


def is_even(time: Samples) -> bool:
    """Whether time stamps are even up to rounding."""
    evenly = np.linspace(time[0], time[-1], len(time))
    return bool(np.max(np.abs(time - evenly)) <= ROUNDING * (evenly[1] - evenly[0]))


def evenly_stamped(recording: Recording) -> Recording:
    """The record with even time stamps if its own are uneven but its samples were taken evenly; otherwise unchanged."""
    if is_even(recording.time) or not is_evenly_sampled(recording):
        return recording
    even, _ = _fit_even_clock(recording.time)
    return attrs.evolve(recording, time=even)


def is_evenly_sampled(recording: Recording) -> bool:
    """Whether samples were taken evenly: by their time stamps, or, if these are uneven, judged by the motion."""
    if is_even(recording.time):
        return True
    even, step = _fit_even_clock(recording.time)
    late = recording.time - even
    motion = recording.angle if recording.speed is None else recording.speed
    if motion is None or np.max(np.abs(late)) > MAX_LATENESS * step:
        return False
    share, error = _followed_share(motion, late, step)
    return bool(share + STANDARD_ERRORS * error < MAX_FOLLOWED_SHARE)


def _fit_even_clock(time: Samples) -> tuple[Samples, float]:
    """The even time stamps nearest to the given ones, by least squares, and their step."""
    ticks = np.arange(len(time))
    step, begin = np.polyfit(ticks, time, 1)
    return begin + ticks * step, float(step)


def _followed_share(signal: Samples, late: Samples, step: float) -> tuple[float, float]:
    """Share of the lateness of its stamps that a signal follows, and the standard error of that share.

    1 for samples taken at their stamps, 0 for even ones: a regression of each sample's distance from the mean of its
    neighbours on that predicted from slope and stamps. The standard error is infinite where nothing moves.
    """
    lags = np.arange(-SLOPE_SAMPLES, SLOPE_SAMPLES + 1)
    slope = np.correlate(signal, lags / (lags @ lags) / step, "same")
    observed, expected = (_half_second_difference(signal), slope[1:-1] * _half_second_difference(late))
    known = np.isfinite(observed) & np.isfinite(expected)
    known[:SLOPE_SAMPLES] = known[-SLOPE_SAMPLES:] = False
    observed, expected = observed[known], expected[known]
    power = expected @ expected
    if not power > ROUNDED_SQUARES * np.nansum(signal**2):
        return 1.0, np.inf
    share = float(observed @ expected / power)
    return share, float(np.sqrt(np.sum((expected * (observed - share * expected)) ** 2)) / power)


def _half_second_difference(signal: Samples) -> Float[np.ndarray, " inner"]:
    """Minus half the second difference: each sample less the mean of its neighbours."""
    return signal[1:-1] - (signal[:-2] + signal[2:]) / 2
