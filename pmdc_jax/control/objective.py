"""What a tuning minimises: settling time against the limit, and what it costs to miss the specification."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..motor import Motor
from .controllers import AbstractController, Number
from .hardware import Hardware
from .law import Law, Model
from .loop import Course, Response, closed_loop
from .margins import linear_loop, sensitivity_peak
from .metrics import (
    BAND,
    One,
    Samples,
    load_metrics,
    smooth_overshoot,
    smooth_settling,
    step_metrics,
)

# Share of the motors that decides, the worst of them: the tail beyond a 95th percentile, and a little more.
TAIL = 0.1
# Cost of a relative steady error: one that fills the band costs as much as half the fastest settling.
STEADY = 25.0
PARTS, LOWER = 3, 0.5
# Weights of the second step's settling and of its overshoot, which may fill the band: it has no specification of its
# own.
SECOND_SETTLING, SECOND_OVERSHOOT = 0.05, 0.15


class Task(eqx.Module):
    """What the loop is to do, on which hardware, and how well.

    From rest to the set point; then a load sets in; then, under load, on to half the set point. Gains that were only
    ever asked for the first may do it by a windup that happens to fit.

    **Fields**: `setpoint`, rad/s; `load`, N m, a step that comes once the set point is held;
    `limit`, the fastest possible settling, s; `max_overshoot`, %; `max_sensitivity`, of the loop, None for any;
    `noise`, rad/s of measured speed at each sample; `step_samples`, how many each of the three parts takes.
    """

    hardware: Hardware
    setpoint: Number
    load: Number
    limit: Number
    max_overshoot: Number
    max_sensitivity: Number | None
    noise: Float[Array, " samples"]
    step_samples: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)  # a sample, which the motor's effects need

    def course(self) -> Course:
        """Set point, load, half the set point."""
        part = jnp.arange(PARTS * self.step_samples) // self.step_samples
        reference = jnp.where(part < 2, self.setpoint, LOWER * self.setpoint)
        load = jnp.where(part < 1, 0.0, self.load)
        return Course(reference, load, self.noise)

    def parts(self, response: Response, substeps: int = 1) -> list[tuple[Samples, Samples]]:
        """Time and speed of each of the parts."""
        count = self.step_samples * substeps
        cuts = (slice(k * count, (k + 1) * count) for k in range(PARTS))
        return [(response.time[cut], response.speed[cut]) for cut in cuts]


def smooth_cost(
    task: Task, model: Model, motors: Motor, controller: AbstractController, width: Number
) -> Float[Array, ""]:
    """The cost whose gradient is followed. `motors` has a leading axis; `width` softens the metrics, in bands."""
    law = Law(controller, task.hardware, model)
    costs = jax.vmap(lambda motor: _smooth_cost(task, law, motor, width))(motors)
    cost = _mean_and_tail(costs)
    if task.max_sensitivity is None:
        return cost
    first = jax.tree.map(lambda leaf: leaf[0], motors)
    peak = sensitivity_peak(linear_loop(first, law))
    return cost + jax.nn.relu(peak / task.max_sensitivity - 1)


def _smooth_cost(task: Task, law: Law, motor: Motor, width: Number) -> One:
    response = closed_loop(motor, law, task.course(), task.substeps)
    (time, speed), loaded, second = task.parts(response, task.substeps)
    settling = smooth_settling(time, speed, task.setpoint, 0.0, width)
    overshoot = smooth_overshoot(speed, task.setpoint, 0.0, 0.3 * width * task.max_overshoot)
    recovery = smooth_settling(*loaded, task.setpoint, 0.0, width)
    lower = LOWER * task.setpoint
    second_settling = smooth_settling(*second, lower, task.setpoint, width)
    dip = smooth_overshoot(second[1], lower, task.setpoint, 0.3 * width)
    errors = [jnp.abs(y / task.setpoint - 1) for y in (speed, loaded[1])]
    return (
        settling / task.limit
        + overshoot_cost(overshoot, 0.8 * task.max_overshoot)
        + 0.1 * recovery / task.limit
        # draws loops that do not settle yet
        + jnp.mean(errors[0])
        + jnp.mean(errors[1])
        + jnp.mean(jnp.abs(second[1] / lower - 1))
        + SECOND_SETTLING * second_settling / task.limit
        + SECOND_OVERSHOOT * overshoot_cost(dip, 100 * BAND)
        + STEADY * sum(_late(error) for error in errors)
        + jnp.mean(jnp.abs(jnp.diff(response.voltage[:: task.substeps])))
        / task.hardware.voltage_limit
    )


def _late(error: Samples) -> One:
    """Mean size over the last quarter."""
    return jnp.mean(jnp.abs(error)[-(error.size // 4) :])


def overshoot_cost(overshoot: Number, allowed: Number) -> Number:
    """Nothing within what is allowed; beyond, steeply what is missing in proportion, then in per cent."""
    excess = jax.nn.relu(overshoot - allowed)
    return jnp.minimum(excess / allowed, 0.3) + 0.3 * excess


Each = Float[Array | np.ndarray, " motors"]


class Score(NamedTuple):
    """Exact figures of one controller on each of the motors."""

    settling: Each
    overshoot: Each
    recovery: Each
    late_error: Each
    effort: Each
    second_settling: Each
    second_overshoot: Each
    sensitivity: One


def score(
    task: Task, model: Model, motors: Motor, controller: AbstractController, substeps: int = 4
) -> Score:
    """The exact metrics of a controller on every motor, between samples too."""
    law = Law(controller, task.hardware, model)
    substeps *= task.substeps

    def of(motor: Motor):
        response = closed_loop(motor, law, task.course(), substeps)
        step, loaded, lower = task.parts(response, substeps)
        found = step_metrics(*step, task.setpoint)
        after = load_metrics(*loaded, task.setpoint)
        second = step_metrics(*lower, LOWER * task.setpoint, task.setpoint)
        late = _late(step[1] / task.setpoint - 1) + _late(loaded[1] / task.setpoint - 1)
        swings = jnp.abs(jnp.diff(response.voltage[::substeps]))
        effort = jnp.mean(swings) / task.hardware.voltage_limit
        first = (found.SettlingTime, found.Overshoot, after.RecoveryTime)
        return *first, late, effort, second.SettlingTime, second.Overshoot

    found = jax.vmap(of)(motors)
    first = jax.tree.map(lambda leaf: leaf[0], motors)
    peak = sensitivity_peak(linear_loop(first, law))
    return Score(*found, sensitivity=peak)


def exact_cost(task: Task, found: Score) -> Float[Array, ""]:
    """The cost of exact figures, by which the best of the tuned controllers is chosen."""
    never = 10.0 * task.limit
    settling = jnp.nan_to_num(found.settling, nan=never)
    costs = settling / task.limit + 0.1 * jnp.nan_to_num(found.recovery, nan=never) / task.limit
    costs = costs + STEADY * found.late_error + found.effort
    second = jnp.nan_to_num(found.second_settling, nan=never) / task.limit
    costs = costs + SECOND_SETTLING * second
    costs = costs + SECOND_OVERSHOOT * overshoot_cost(found.second_overshoot, 100 * BAND)
    costs = costs + 3 * overshoot_cost(found.overshoot, 0.97 * task.max_overshoot)
    cost = _mean_and_tail(costs)
    if task.max_sensitivity is None:
        return cost
    return cost + jax.nn.relu(found.sensitivity / task.max_sensitivity - 1.01)


def _mean_and_tail(costs: Each) -> Float[Array, ""]:
    """The mean, and the mean of the worst tenth, half each."""
    worst = max(1, round(TAIL * costs.size))
    return 0.5 * jnp.mean(costs) + 0.5 * jnp.mean(jax.lax.top_k(costs, worst)[0])
