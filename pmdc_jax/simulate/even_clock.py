"""A recording as the solver needs it: with one sample time, and with a speed if only the angle was measured."""

from __future__ import annotations

import attrs
import numpy as np

from ..recordings.angle import mean_speeds, unwrapped
from ..recordings.clock import GAP, is_even
from ..recordings.recording import OVER_LAST, Recording

# An even clock is good enough if this share of the samples has ticks of their own, relative to the best clock
MIN_TICK_SHARE = 0.98


def on_even_clock(recording: Recording) -> Recording:
    """The recording on an even clock, with speed in place of angle.

    Evenly sampled recordings keep their samples; if only the angle was measured, their speed is its mean over every
    sample. Otherwise voltage, torque and load, which hold between samples, are averaged over each of its intervals, so
    that no volt-second is lost. Current and speed are interpolated linearly; inside gaps, and past the end, they are
    missing (NaN). The record is kept as `resampled_from`, where speeds from angles are means. A rotor that stands still
    throughout is taken as held, because its speed tells nothing.
    """
    if recording.stands_still:
        recording = attrs.evolve(recording, speed=None, angle=None, held=True)
    time, even, instantaneous = recording.time, is_even(recording.time), recording.speed
    if recording.angle is not None and (recording.speed is None or recording.averaging):
        angle, _ = unwrapped(recording.angle)
        recording = attrs.evolve(recording, speed=mean_speeds(time, angle), averaging=OVER_LAST)
        instantaneous = None if even else _spline_derivative(angle, time)
    if even:
        return attrs.evolve(recording, time=np.linspace(time[0], time[-1], len(time)))
    clock = _resampling_clock(time)
    driving = {"voltage": recording.voltage, "load": recording.load, "torque": recording.torque}
    simulated = {"current": recording.current, "speed": instantaneous}
    return attrs.evolve(
        recording,
        time=clock,
        angle=None,
        averaging=None,
        temperature=None,
        resampled_from=recording,
        **{k: _interval_means(time, x, clock) for k, x in driving.items() if x is not None},
        **{k: _interpolate(time, x, clock) for k, x in simulated.items() if x is not None},
    )


def _resampling_clock(time: np.ndarray) -> np.ndarray:
    """An even clock that starts at the first sample. Its step is the mean step of time without gaps, or the median,
    whichever gives more samples a tick of their own. The mean is rounded to two digits where that hardly matters, and
    otherwise to three like the median, so that runs of one logger share a clock."""
    steps, elapsed = np.diff(time), time - time[0]
    typical = np.median(steps)
    mean = np.mean(steps[steps <= GAP * typical])
    candidates = [float(x) for x in (f"{mean:.2g}", f"{mean:.3g}", f"{typical:.3g}")]
    distinct = [len(np.unique(np.rint(elapsed / step))) for step in candidates]
    step = next(x for x, ticks in zip(candidates, distinct, strict=True) if ticks >= MIN_TICK_SHARE * max(distinct))
    return time[0] + step * np.arange(np.ceil(elapsed[-1] / step - 1e-9) + 1)


def _interval_means(time: np.ndarray, driving: np.ndarray, clock: np.ndarray) -> np.ndarray:
    integral = np.concatenate([[0.0], np.cumsum(driving[:-1] * np.diff(time))])
    ends = np.append(clock, 2 * clock[-1] - clock[-2])
    total = np.interp(ends, time, integral) + driving[-1] * np.maximum(ends - time[-1], 0.0)
    return np.diff(total) / np.diff(ends)


def _interpolate(time: np.ndarray, samples: np.ndarray, clock: np.ndarray) -> np.ndarray:
    known = ~np.isnan(samples)
    values = np.interp(clock, time[known], samples[known])
    # the known samples on either side of each tick must not be too far apart
    right = np.clip(np.searchsorted(time[known], clock), 1, known.sum() - 1)
    interval = time[known][right] - time[known][right - 1]
    step = clock[1] - clock[0]
    values[(interval > GAP * step) | (clock > time[-1] + 1e-9 * step)] = np.nan
    return values


def _spline_derivative(angle: np.ndarray, time: np.ndarray) -> np.ndarray:
    """The derivative of a cubic spline, rad/s: a difference would be a mean over two steps, which looks like a lag."""
    from scipy.interpolate import CubicSpline  # here, because it is slow to import

    known = ~np.isnan(angle)
    speed = np.full_like(angle, np.nan)
    speed[known] = CubicSpline(time[known], angle[known])(time[known], 1)
    return speed
