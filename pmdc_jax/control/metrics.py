"""Figures of merit of a response: exact ones, and smooth ones for gradients."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .controllers import Number

BAND = 0.02  # within which a response has settled, either side, over the step
TAIL_PARTS = 20  # the steady error is the mean over the last of so many equal parts
Samples = Float[Array | np.ndarray, " instants"]
One = Float[Array | np.ndarray, ""]


class StepMetrics(NamedTuple):
    """Of a step response; named as python-control's `step_info` names them. NaN where it never happens.

    `RiseTime`, s, from 10 to 90 %; `SettlingTime`, s, of the last exit from the 2 % band; `Overshoot` and
    `Undershoot`, % of the step, never negative; `Peak`, rad/s, and `PeakTime`, s; `SteadyStateError`, rad/s.
    """

    RiseTime: One
    SettlingTime: One
    Overshoot: One
    Undershoot: One
    Peak: One
    PeakTime: One
    SteadyStateError: One


def step_metrics(
    time: Samples, speed: Samples, final: Number, initial: Number = 0.0
) -> StepMetrics:
    """Exact metrics of a step from `initial` to `final`, rad/s, between samples by interpolation.

    Crossings are interpolated linearly and peaks by a parabola, so that the error falls with the square of the
    distance of the samples, or faster. The steady error is the mean of the last twentieth.

    **Arguments**: `time`, s, evenly spaced, the step at its first instant; `speed`, rad/s.
    """
    share = (speed - initial) / (final - initial)
    rise = _first_reached(time, share, 0.9) - _first_reached(time, share, 0.1)
    peak_time, peak = _peak(time, share)
    _, trough = _peak(time, -share)
    tail = max(1, speed.size // TAIL_PARTS)
    return StepMetrics(
        RiseTime=rise,
        SettlingTime=_last_inside(time, jnp.abs(share - 1) - BAND),
        Overshoot=100 * jnp.maximum(peak - 1, 0),
        Undershoot=100 * jnp.maximum(trough, 0),
        Peak=initial + peak * (final - initial),
        PeakTime=peak_time,
        SteadyStateError=final - jnp.mean(speed[-tail:]),
    )


class LoadMetrics(NamedTuple):
    """Of a load step: `Deviation`, rad/s, the largest; `RecoveryTime`, s, back into the 2 % band of the set point
    for good; `SteadyStateError`, rad/s."""

    Deviation: One
    RecoveryTime: One
    SteadyStateError: One


def load_metrics(time: Samples, speed: Samples, reference: Number) -> LoadMetrics:
    """Exact metrics of a response to a load that sets in at the first instant."""
    error = jnp.abs(speed - reference)
    tail = max(1, speed.size // TAIL_PARTS)
    return LoadMetrics(
        Deviation=_peak(time, error)[1],
        RecoveryTime=_last_inside(time, error - BAND * jnp.abs(reference)),
        SteadyStateError=reference - jnp.mean(speed[-tail:]),
    )


def smooth_settling(
    time: Samples, speed: Samples, final: Number, initial: Number, width: Number
) -> One:
    """Settling time with a derivative everywhere, s.

    The time during which the largest |error| still to come exceeds the band, with a logistic edge. Maximum and
    edge soften by `width`, in bands; as it goes to zero, and the samples draw together, this becomes the exact
    settling time. A loop that does not settle counts its whole duration.
    """
    outside = jnp.abs((speed - final) / (final - initial)) / BAND - 1
    # jax.lax.cumlogsumexp is the same, but unrolls into a tree that takes the compiler seconds
    _, to_come = jax.lax.scan(_largest, jnp.asarray(-jnp.inf), outside / width, reverse=True)
    step = time[1] - time[0]
    return step * jnp.sum(jax.nn.sigmoid(to_come))


def _largest(so_far: Number, value: Number) -> tuple[Number, Number]:
    largest = jnp.logaddexp(so_far, value)
    return largest, largest


def smooth_overshoot(speed: Samples, final: Number, initial: Number, width: Number) -> One:
    """Overshoot in %, maximum and corner at zero softened by `width`, in %; the limit is the exact one."""
    above = 100 * (speed - final) / (final - initial) / width
    return width * jax.nn.softplus(jax.nn.logsumexp(above))


def _first_reached(time: Samples, share: Samples, level: float) -> One:
    """When `share` first reaches `level`."""
    reached = share >= level
    k = jnp.argmax(reached)
    before = jnp.maximum(k - 1, 0)
    rise = jnp.where(k > 0, share[k] - share[before], 1.0)
    crossing = time[k] - (time[k] - time[before]) * (share[k] - level) / rise
    return jnp.where(jnp.any(reached), jnp.where(k > 0, crossing, time[0]) - time[0], jnp.nan)


def _last_inside(time: Samples, outside: Samples) -> One:
    """Time from the start until `outside` is negative for good."""
    count = outside.size
    out = outside > 0
    last = count - 1 - jnp.argmax(out[::-1])
    after = jnp.minimum(last + 1, count - 1)
    fall = jnp.where(last < count - 1, outside[last] - outside[after], 1.0)
    crossing = time[last] + (time[after] - time[last]) * outside[last] / fall - time[0]
    last_exit = jnp.where(last < count - 1, crossing, jnp.nan)
    return jnp.where(jnp.any(out), last_exit, 0.0)


def _peak(time: Samples, values: Samples) -> tuple[One, One]:
    """Time and height of the largest value, by the parabola through it and its neighbours."""
    k = jnp.argmax(values)
    inside = (k > 0) & (k < values.size - 1)
    middle = jnp.clip(k, 1, values.size - 2)
    left, top, right = values[middle - 1], values[middle], values[middle + 1]
    bend = left - 2 * top + right
    usable = inside & (bend < 0)
    shift = jnp.where(usable, (left - right) / (2 * jnp.where(usable, bend, -1.0)), 0.0)
    height = jnp.where(usable, top - (left - right) * shift / 4, values[k])
    return time[k] + shift * (time[1] - time[0]) - time[0], height
