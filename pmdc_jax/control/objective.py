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
from .loop import Course, closed_loop
from .margins import linear_loop, sensitivity_peak
from .metrics import (
    One,
    load_metrics,
    smooth_overshoot,
    smooth_settling,
    step_metrics,
)

# Share of the motors that decides, the worst of them: the tail beyond a 95th percentile, and a little more.
TAIL = 0.1
# Cost of a relative steady error: one that fills the band costs as much as half the fastest settling.
STEADY = 25.0


class Task(eqx.Module):
    """What the loop is to do, on which hardware, and how well.

    **Fields**: `setpoint` and `initial`, rad/s; `load`, N m, a step that comes once the set point is held;
    `limit`, the fastest possible settling, s; `max_overshoot`, %; `max_sensitivity`, of the loop, None for any;
    `noise`, rad/s of measured speed at each sample; `step_samples`, how many until the load comes.
    """

    hardware: Hardware
    setpoint: Number
    initial: Number
    load: Number
    limit: Number
    max_overshoot: Number
    max_sensitivity: Number | None
    noise: Float[Array, " samples"]
    step_samples: int = eqx.field(static=True)

    def course(self) -> Course:
        """Set point at the first sample, load at `step_samples`."""
        samples = jnp.arange(self.noise.shape[0])
        reference = jnp.full(samples.shape, self.setpoint, float)
        load = jnp.where(samples < self.step_samples, 0.0, self.load)
        return Course(reference, load, self.noise, self.initial)


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
    response = closed_loop(motor, law, task.course())
    split = task.step_samples
    time, speed = response.time[:split], response.speed[:split]
    settling = smooth_settling(time, speed, task.setpoint, task.initial, width)
    overshoot = smooth_overshoot(
        speed, task.setpoint, task.initial, 0.3 * width * task.max_overshoot
    )
    error = jnp.abs(response.speed / task.setpoint - 1)
    late = response.time[split:], response.speed[split:]
    recovery = smooth_settling(*late, task.setpoint, 0.0, width)
    return (
        settling / task.limit
        + overshoot_cost(overshoot, 0.8 * task.max_overshoot)
        + 0.1 * recovery / task.limit
        # draws loops that do not settle yet
        + jnp.mean(error[:split])
        + jnp.mean(error[split:])
        + STEADY * _late_error(error, split)
        + jnp.mean(jnp.abs(jnp.diff(response.voltage))) / task.hardware.voltage_limit
    )


def _late_error(error: Float[Array, " samples"], split: int) -> Float[Array, ""]:
    """Mean relative error over the last quarter of the step, and of the load."""
    late = split // 4
    return jnp.mean(error[split - late : split]) + jnp.mean(error[-late:])


def overshoot_cost(overshoot: Number, allowed: Number) -> Float[Array, ""]:
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
    sensitivity: One


def score(
    task: Task, model: Model, motors: Motor, controller: AbstractController, substeps: int = 4
) -> Score:
    """The exact metrics of a controller on every motor, between samples too."""
    law = Law(controller, task.hardware, model)

    def of(motor: Motor):
        response = closed_loop(motor, law, task.course(), substeps)
        split = task.step_samples * substeps
        found = step_metrics(
            response.time[:split], response.speed[:split], task.setpoint, task.initial
        )
        after = load_metrics(response.time[split:], response.speed[split:], task.setpoint)
        late = _late_error(jnp.abs(response.speed / task.setpoint - 1), split)
        swings = jnp.abs(jnp.diff(response.voltage[::substeps]))
        effort = jnp.mean(swings) / task.hardware.voltage_limit
        return found.SettlingTime, found.Overshoot, after.RecoveryTime, late, effort

    first = jax.tree.map(lambda leaf: leaf[0], motors)
    return Score(*jax.vmap(of)(motors), sensitivity_peak(linear_loop(first, law)))


def exact_cost(task: Task, found: Score) -> Float[Array, ""]:
    """The cost of exact figures, by which the best of the tuned controllers is chosen."""
    never = 10.0 * task.limit
    settling = jnp.nan_to_num(found.settling, nan=never)
    costs = settling / task.limit + 0.1 * jnp.nan_to_num(found.recovery, nan=never) / task.limit
    costs = costs + STEADY * found.late_error + found.effort
    costs = costs + 3 * overshoot_cost(found.overshoot, 0.97 * task.max_overshoot)
    cost = _mean_and_tail(costs)
    if task.max_sensitivity is None:
        return cost
    return cost + jax.nn.relu(found.sensitivity / task.max_sensitivity - 1.01)


def _mean_and_tail(costs: Float[Array, " motors"]) -> Float[Array, ""]:
    """The mean, and the mean of the worst tenth, half each."""
    worst = max(1, round(TAIL * costs.size))
    return 0.5 * jnp.mean(costs) + 0.5 * jnp.mean(jax.lax.top_k(costs, worst)[0])
