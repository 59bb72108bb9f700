"""Cost that a tuning minimises: settling time over the fastest that the loop allows, plus penalties."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..motor import Motor
from .controllers import AbstractController, Number
from .hardware import Hardware
from .law import Law, SampledMotor
from .loop import Course, Response, closed_loop
from .margins import linear_loop, sensitivity_peak
from .metrics import BAND, Samples, Scalar, load_metrics, smooth_overshoot, smooth_settling, step_metrics

PART_COUNT = 3  # equally long parts of the task: the step, the load step, and the second step under load
SECOND_SETPOINT = 0.5  # set point of the second step, over that of the first
EXACT_SUBSTEPS = 4  # simulated instants per sample; exact metrics interpolate between them
# Width of the smooth overshoot (%) for an allowed overshoot of 1 %, over the width of the smooth settling (bands).
OVERSHOOT_WIDTH = 0.3
# Last share of each part, over which the steady error is averaged.
STEADY_SHARE = 0.25

# Weights in the cost. Two terms have weight 1: the settling time over the `settling_scale` of the task, and the mean
# change of voltage from sample to sample over the voltage limit.

# Weight of the recovery from the load, over that scale: less than that of the step, which comes first.
RECOVERY_WEIGHT = 0.1
# Weight of the relative steady error: an error as large as the 2 % band costs as much as half that scale.
STEADY_ERROR_WEIGHT = 25.0
# Weights of the second step's settling, over that scale, and of its overshoot beyond the band. That step has
# no specification of its own, so an overshoot within the band is free.
SECOND_SETTLING_WEIGHT = 0.05
SECOND_OVERSHOOT_WEIGHT = 0.15
# Excess overshoot costs its ratio to the allowed overshoot, up to RATIO_COST_LIMIT, plus COST_PER_PERCENT for each per
# cent: steep at the limit, but the gradient stays moderate for a loop that starts far beyond it.
RATIO_COST_LIMIT = 0.3
COST_PER_PERCENT = 0.3

# Excess of the sensitivity over its limit costs its ratio to that, and beyond EXCESS_TO_AVOID so many times as much:
# where nothing settles, as with strong cogging at low speed, that is no reason for a loop that nearly oscillates
EXCESS_TO_AVOID, AVOIDED_EXCESS_WEIGHT = 0.5, 10.0

# Settling time assigned to a loop that never settles, over that scale: longer than a part of the task.
UNSETTLED_TIME = 10.0
# Share of the motors, those of highest cost, whose mean makes half of the cost: covers the tail beyond the 95th
# percentile with some margin.
TAIL_SHARE = 0.1


class Strictness(NamedTuple):
    """Settings in which the cost of the descent differs from the cost that selects the best result.

    **Fields**: `overshoot`, weight of excess overshoot; `allowed_overshoot` and `allowed_sensitivity`, over the limits
    of the specification; `tracking_error`, weight of the tracking error.
    """

    overshoot: float
    allowed_overshoot: float
    allowed_sensitivity: float
    tracking_error: float


# The descent keeps a distance from the overshoot limit, which the smooth metrics blur. The tracking error, weight 1 for
# each part, gives it a gradient where nothing settles yet.
DESCENT = Strictness(overshoot=1.0, allowed_overshoot=0.8, allowed_sensitivity=1.0, tracking_error=3.0)
# The choice uses exact metrics. Nearly all the allowed overshoot may be used, but exceeding it costs more than it can
# gain. The tolerance on the sensitivity spares loops that the descent has left right at the limit.
SELECTION = Strictness(overshoot=3.0, allowed_overshoot=0.97, allowed_sensitivity=1.01, tracking_error=0.0)


class Task(eqx.Module):
    """Test sequence that the loop is simulated on, its hardware and its specification.

    The sequence has three parts: a step from rest to the set point; a load step; and, under load, a step to half the
    set point. Gains tuned on the first part alone may rely on an integrator windup that happens to suit that step.

    **Fields**: `setpoint`, rad/s; `load`, N m, applied in the second and third part; `fastest_settling`, s, of any
    controller within the limits; `settling_scale`, s, the same, or what the loop's dead time or a shaft's resonance
    allows if that is longer;
    `max_overshoot`, %; `max_sensitivity`, limit of the peak sensitivity, None for no
    limit; `noise`, rad/s, added to the measured speed at each sample; `part_samples`, samples of each part; `substeps`,
    simulation steps per sample, as the motor's effects need.
    """

    hardware: Hardware
    setpoint: Number
    load: Number
    fastest_settling: Number
    settling_scale: Number
    max_overshoot: Number
    max_sensitivity: Number | None
    noise: Float[Array, " samples"]
    part_samples: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)

    def with_noise(self, noise: Float[np.ndarray, " samples"]) -> Task:
        """The same task with this noise, rad/s."""
        return eqx.tree_at(lambda task: task.noise, self, jnp.asarray(noise))

    def course(self) -> Course:
        """Reference, load and noise at each sample of the three parts."""
        part = jnp.arange(PART_COUNT * self.part_samples) // self.part_samples
        reference = jnp.where(part < 2, self.setpoint, SECOND_SETPOINT * self.setpoint)
        load = jnp.where(part < 1, 0.0, self.load)
        return Course(reference, load, self.noise)

    def parts(self, response: Response, substeps: int = 1) -> list[tuple[Samples, Samples]]:
        """Time (s) and speed (rad/s) of each part."""
        count = self.part_samples * substeps
        cuts = (slice(k * count, (k + 1) * count) for k in range(PART_COUNT))
        return [(response.time[cut], response.speed[cut]) for cut in cuts]


PerMotor = Float[Array | np.ndarray, " motors"]
Part = tuple[Samples, Samples]


class Score(NamedTuple):
    """Metrics of one controller on each motor. A time is NaN where the event never happens.

    `settling`, s, and `overshoot`, %, of the step; `recovery` from the load, s; `second_settling`, s, and
    `second_overshoot`, %, of the second step; `tracking_error`, mean of |w / r - 1| over all parts; `steady_error`, its
    means over the ends of the step and of the load step, summed; `effort`, mean change of voltage from sample to
    sample, over the voltage limit; `peak_current`, A, the largest in all parts; `sensitivity`, peak over frequency,
    with the first motor.
    """

    settling: PerMotor
    overshoot: PerMotor
    recovery: PerMotor
    second_settling: PerMotor
    second_overshoot: PerMotor
    tracking_error: PerMotor
    steady_error: PerMotor
    effort: PerMotor
    peak_current: PerMotor
    sensitivity: Scalar


def exact_score(task: Task, model: SampledMotor, motors: Motor, controller: AbstractController) -> Score:
    """Exact metrics of a controller on every motor, resolved between samples too. `motors` has a leading axis."""
    setpoint, lower_setpoint = task.setpoint, SECOND_SETPOINT * task.setpoint

    def metrics(step: Part, loaded: Part, second: Part) -> dict[str, Scalar]:
        first = step_metrics(*step, setpoint)
        down = step_metrics(*second, lower_setpoint, setpoint)
        return {
            "settling": first.SettlingTime,
            "overshoot": first.Overshoot,
            "recovery": load_metrics(*loaded, setpoint).RecoveryTime,
            "second_settling": down.SettlingTime,
            "second_overshoot": down.Overshoot,
        }

    return _score(task, model, motors, controller, EXACT_SUBSTEPS, metrics)


def smooth_score(
    task: Task, model: SampledMotor, motors: Motor, controller: AbstractController, width: Number
) -> Score:
    """Differentiable approximations of the metrics, from the samples alone; `width`, in bands, sets the smoothing."""
    setpoint, lower_setpoint = task.setpoint, SECOND_SETPOINT * task.setpoint
    overshoot_width = OVERSHOOT_WIDTH * width

    def metrics(step: Part, loaded: Part, second: Part) -> dict[str, Scalar]:
        return {
            "settling": smooth_settling(*step, setpoint, 0.0, width),
            "overshoot": smooth_overshoot(step[1], setpoint, 0.0, overshoot_width * task.max_overshoot),
            "recovery": smooth_settling(*loaded, setpoint, 0.0, width),
            "second_settling": smooth_settling(*second, lower_setpoint, setpoint, width),
            "second_overshoot": smooth_overshoot(second[1], lower_setpoint, setpoint, overshoot_width),
        }

    return _score(task, model, motors, controller, 1, metrics)


def _score(
    task: Task,
    model: SampledMotor,
    motors: Motor,
    controller: AbstractController,
    substeps: int,
    metrics: Callable[[Part, Part, Part], dict[str, Scalar]],
) -> Score:
    """The given metrics, exact or smooth, with the errors, effort and sensitivity that both share."""
    law, course = Law(controller, task.hardware, model), task.course()
    substeps *= task.substeps
    reference = jnp.repeat(course.reference, substeps)
    steady_instants = round(STEADY_SHARE * task.part_samples * substeps)

    def motor_metrics(motor: Motor) -> dict[str, Scalar]:
        response = closed_loop(motor, law, course, substeps)
        errors = jnp.abs(response.speed / reference - 1).reshape(PART_COUNT, -1)
        changes = jnp.abs(jnp.diff(response.voltage[::substeps]))
        return {
            **metrics(*task.parts(response, substeps)),
            "tracking_error": jnp.mean(errors),
            "steady_error": jnp.sum(jnp.mean(errors[:2, -steady_instants:], axis=1)),
            "effort": jnp.mean(changes) / task.hardware.voltage_limit,
            "peak_current": jnp.max(jnp.abs(response.current)),
        }

    nominal = jax.tree.map(lambda leaf: leaf[0], motors)
    peak = sensitivity_peak(linear_loop(nominal, law))
    return Score(**jax.vmap(motor_metrics)(motors), sensitivity=peak)


def cost(task: Task, score: Score, strictness: Strictness) -> Float[Array, ""]:
    """Cost to minimise, over all motors: settling over the scale of the task, plus the weighted penalties."""

    def relative(time: PerMotor) -> PerMotor:
        return jnp.nan_to_num(time / task.settling_scale, nan=UNSETTLED_TIME)

    allowed = strictness.allowed_overshoot * task.max_overshoot
    costs = (
        relative(score.settling)
        + strictness.overshoot * overshoot_cost(score.overshoot, allowed)
        + RECOVERY_WEIGHT * relative(score.recovery)
        + strictness.tracking_error * score.tracking_error
        + SECOND_SETTLING_WEIGHT * relative(score.second_settling)
        + SECOND_OVERSHOOT_WEIGHT * overshoot_cost(score.second_overshoot, 100 * BAND)
        + STEADY_ERROR_WEIGHT * score.steady_error
        + score.effort
    )
    if task.max_sensitivity is None:
        return _mean_and_tail(costs)
    excess = score.sensitivity / task.max_sensitivity - strictness.allowed_sensitivity
    avoided = AVOIDED_EXCESS_WEIGHT * jax.nn.relu(excess - EXCESS_TO_AVOID)
    return _mean_and_tail(costs) + jax.nn.relu(excess) + avoided


def overshoot_cost(overshoot: Number, allowed: Number) -> Number:
    """Penalty on overshoot, %: 0 up to `allowed`; with the excess e, min(e / allowed, 0.3) + 0.3 e beyond."""
    excess = jax.nn.relu(overshoot - allowed)
    return jnp.minimum(excess / allowed, RATIO_COST_LIMIT) + COST_PER_PERCENT * excess


def _mean_and_tail(costs: PerMotor) -> Float[Array, ""]:
    """Half the mean over the motors plus half the mean of the worst tenth."""
    tail = max(1, round(TAIL_SHARE * costs.size))
    return 0.5 * jnp.mean(costs) + 0.5 * jnp.mean(jax.lax.top_k(costs, tail)[0])
