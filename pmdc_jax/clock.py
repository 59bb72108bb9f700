"""Whether samples came when their time stamps say, or evenly, and only the stamps are uneven.

A computer that stamps what a sampling clock sends it does so early and late. Samples that truly came late show it: a
speed that rises has risen further by then.
"""

from __future__ import annotations

import attrs
import numpy as np
from jaxtyping import Float

from .recording import Recording

Samples = Float[np.ndarray, " samples"]

# Stamps that are more than so many typical steps apart leave a gap, in which outputs are missing; exactly so
# many, but for rounding, leave none
GAP = 3.0 * (1 + 1e-9)
# Largest distance of a time stamp from an even clock, in steps, that is taken for rounding of the stamps
ROUNDING = 0.02
# ... and beyond which it is none that a sampling clock gave
MAX_LATENESS = 3.0
# Samples on either side over which a slope is taken
SLOPE_SAMPLES = 5
# Samples that came evenly follow the lateness of their stamps by less than this share of it ...
MAX_FOLLOWED_SHARE = 0.5
# ... and stay so many standard errors below
STANDARD_ERRORS = 4.0
# Squares of what is but rounding, as a share of all
ROUNDED_SQUARES = 1e-18


def is_even(time: Samples) -> bool:
    """Whether time stamps are even but for rounding."""
    evenly = np.linspace(time[0], time[-1], len(time))
    return bool(np.max(np.abs(time - evenly)) <= ROUNDING * (evenly[1] - evenly[0]))


def evenly_stamped(recording: Recording) -> Recording:
    """A record with even time stamps where its own are not, but its samples came evenly; as it is otherwise."""
    if is_even(recording.time) or not is_evenly_sampled(recording):
        return recording
    even, _ = _even_clock(recording.time)
    return attrs.evolve(recording, time=even)


def is_evenly_sampled(recording: Recording) -> bool:
    """Whether samples came evenly: as their time stamps say, or, where these are uneven, by how the motion goes on."""
    if is_even(recording.time):
        return True
    even, step = _even_clock(recording.time)
    late = recording.time - even
    motion = recording.angle if recording.speed is None else recording.speed
    if motion is None or np.max(np.abs(late)) > MAX_LATENESS * step:
        return False
    share, error = _followed_share(motion, late, step)
    return bool(share + STANDARD_ERRORS * error < MAX_FOLLOWED_SHARE)


def _even_clock(time: Samples) -> tuple[Samples, float]:
    """The even time stamps nearest to some, by least squares, and their step."""
    ticks = np.arange(len(time))
    step, begin = np.polyfit(ticks, time, 1)
    return begin + ticks * step, float(step)


def _followed_share(signal: Samples, late: Samples, step: float) -> tuple[float, float]:
    """By what share of how late its stamps are a signal is further on, and the standard error of that.

    By regression of what straight lines from neighbour to neighbour miss of the signal on what its slope makes of the
    stamps; infinitely uncertain where nothing moves.
    """
    lags = np.arange(-SLOPE_SAMPLES, SLOPE_SAMPLES + 1)
    slope = np.correlate(signal, lags / (lags @ lags) / step, "same")
    missed, expected = _half_second_difference(signal), slope[1:-1] * _half_second_difference(late)
    known = np.isfinite(missed) & np.isfinite(expected)
    known[:SLOPE_SAMPLES] = known[-SLOPE_SAMPLES:] = False
    missed, expected = missed[known], expected[known]
    power = expected @ expected
    if not power > ROUNDED_SQUARES * np.nansum(signal**2):
        return 1.0, np.inf
    share = float(missed @ expected / power)
    return share, float(np.sqrt(np.sum((expected * (missed - share * expected)) ** 2)) / power)


def _half_second_difference(signal: Samples) -> Float[np.ndarray, " inner"]:
    """Minus half the second difference: each sample less the mean of its neighbours."""
    return signal[1:-1] - (signal[:-2] + signal[2:]) / 2
