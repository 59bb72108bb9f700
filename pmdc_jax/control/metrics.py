"""Metrics of a response: exact ones, and smooth approximations for gradients."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .controllers import Number

BAND = 0.02  # half-width of the settling band, over the step
TAIL_PARTS = 20  # the steady error is averaged over the last of so many equal parts
Samples = Float[Array | np.ndarray, " instants"]
Scalar = Float[Array | np.ndarray, ""]


class StepMetrics(NamedTuple):
    """Metrics of a step response, named as in python-control's `step_info`. NaN where the event never happens.

    `RiseTime`, s, from 10 to 90 %; `SettlingTime`, s, after which the response stays in the 2 % band; `Overshoot` and
    `Undershoot`, % of the step, never negative; `Peak`, rad/s, and `PeakTime`, s; `SteadyStateError`, rad/s.
    """

    RiseTime: Scalar
    SettlingTime: Scalar
    Overshoot: Scalar
    Undershoot: Scalar
    Peak: Scalar
    PeakTime: Scalar
    SteadyStateError: Scalar


def step_metrics(time: Samples, speed: Samples, final: Number, initial: Number = 0.0) -> StepMetrics:
    """Exact metrics of a step from `initial` to `final`, rad/s, interpolated between samples.

    Crossings are interpolated linearly and peaks by a parabola, so that the error falls at least with the square of
    the sample spacing. The steady error is the mean over the last twentieth.

    **Arguments**: `time`, s, evenly spaced, with the step at the first instant; `speed`, rad/s.
    """
    normalised = (speed - initial) / (final - initial)
    rise = _time_to_reach(time, normalised, 0.9) - _time_to_reach(time, normalised, 0.1)
    peak_time, peak = _peak(time, normalised)
    _, trough = _peak(time, -normalised)
    tail = max(1, speed.size // TAIL_PARTS)
    return StepMetrics(
        RiseTime=rise,
        SettlingTime=_settling_time(time, jnp.abs(normalised - 1) - BAND),
        Overshoot=100 * jnp.maximum(peak - 1, 0),
        Undershoot=100 * jnp.maximum(trough, 0),
        Peak=initial + peak * (final - initial),
        PeakTime=peak_time,
        SteadyStateError=final - jnp.mean(speed[-tail:]),
    )


class LoadMetrics(NamedTuple):
    """Metrics of a load step: `Deviation`, rad/s, the largest; `RecoveryTime`, s, after which the speed stays within
    2 % of the set point; `SteadyStateError`, rad/s."""

    Deviation: Scalar
    RecoveryTime: Scalar
    SteadyStateError: Scalar


def load_metrics(time: Samples, speed: Samples, reference: Number) -> LoadMetrics:
    """Exact metrics of the response to a load step at the first instant; `reference`, rad/s."""
    error = jnp.abs(speed - reference)
    tail = max(1, speed.size // TAIL_PARTS)
    return LoadMetrics(
        Deviation=_peak(time, error)[1],
        RecoveryTime=_settling_time(time, error - BAND * jnp.abs(reference)),
        SteadyStateError=reference - jnp.mean(speed[-tail:]),
    )


def smooth_settling(time: Samples, speed: Samples, final: Number, initial: Number, width: Number) -> Scalar:
    """Differentiable settling time, s.

    The time during which the largest |error| still to come exceeds the band, with a soft maximum and a logistic edge
    of `width`, in bands. It tends to the exact settling time as the width and the sample spacing go to zero. A loop
    that does not settle gets its whole duration.
    """
    excess = jnp.abs((speed - final) / (final - initial)) / BAND - 1  # in bands
    # jax.lax.cumlogsumexp is equivalent, but unrolls into a tree that takes seconds to compile
    _, largest_to_come = jax.lax.scan(_soft_running_maximum, jnp.asarray(-jnp.inf), excess / width, reverse=True)
    step = time[1] - time[0]
    return step * jnp.sum(jax.nn.sigmoid(largest_to_come))


def _soft_running_maximum(so_far: Number, value: Number) -> tuple[Number, Number]:
    largest = jnp.logaddexp(so_far, value)
    return largest, largest


def smooth_overshoot(speed: Samples, final: Number, initial: Number, width: Number) -> Scalar:
    """Differentiable overshoot, %: maximum and corner at zero are smoothed by `width`, %; exact in the limit of 0."""
    overshoot = 100 * (speed - final) / (final - initial) / width
    return width * jax.nn.softplus(jax.nn.logsumexp(overshoot))


def _time_to_reach(time: Samples, values: Samples, level: float) -> Scalar:
    """Time until the values first reach `level`, or NaN."""
    reached = values >= level
    k = jnp.argmax(reached)
    before = jnp.maximum(k - 1, 0)
    rise = jnp.where(k > 0, values[k] - values[before], 1.0)
    crossing = time[k] - (time[k] - time[before]) * (values[k] - level) / rise
    return jnp.where(jnp.any(reached), jnp.where(k > 0, crossing, time[0]) - time[0], jnp.nan)


def _settling_time(time: Samples, excess: Samples) -> Scalar:
    """Time from the start after which `excess`, the error beyond the band, stays negative; NaN if it does not."""
    count = excess.size
    outside = excess > 0
    last = count - 1 - jnp.argmax(outside[::-1])
    after = jnp.minimum(last + 1, count - 1)
    fall = jnp.where(last < count - 1, excess[last] - excess[after], 1.0)
    crossing = time[last] + (time[after] - time[last]) * excess[last] / fall - time[0]
    last_exit = jnp.where(last < count - 1, crossing, jnp.nan)
    return jnp.where(jnp.any(outside), last_exit, 0.0)


def _peak(time: Samples, values: Samples) -> tuple[Scalar, Scalar]:
    """Time and height of the maximum, by a parabola through the largest value and its neighbours."""
    k = jnp.argmax(values)
    inside = (k > 0) & (k < values.size - 1)
    middle = jnp.clip(k, 1, values.size - 2)
    left, top, right = values[middle - 1], values[middle], values[middle + 1]
    curvature = left - 2 * top + right
    usable = inside & (curvature < 0)
    shift = jnp.where(usable, (left - right) / (2 * jnp.where(usable, curvature, -1.0)), 0.0)
    height = jnp.where(usable, top - (left - right) * shift / 4, values[k])
    return time[k] + shift * (time[1] - time[0]) - time[0], height
