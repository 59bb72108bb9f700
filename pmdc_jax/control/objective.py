"""What a tuning minimises: settling time against the limit, and what it costs to miss the specification."""

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
from .metrics import (
    BAND,
    One,
    Samples,
    load_metrics,
    smooth_overshoot,
    smooth_settling,
    step_metrics,
)

PARTS = 3  # of the task, equally long: the step, the load step, and the second step under load
SECOND_SETPOINT = 0.5  # set point of the second step, over that of the first
EXACT_SUBSTEPS = 4  # instants a sample, between which exact metrics interpolate
# Width of the smooth overshoot where 1 % is allowed, %, over the width of the smooth settling.
SMOOTH_OVERSHOOT = 0.3
# Share of each part over whose end the steady error is taken.
STEADY_SHARE = 0.25

# Weights in the cost. Settling, over the fastest settling, counts 1, and so does the mean change of voltage from sample
# to sample, over the voltage limit.

# Of the recovery from the load, over the fastest settling: the step itself comes first.
RECOVERY = 0.1
# Of a relative steady error: one that fills the band costs as much as half the fastest settling.
STEADY_ERROR = 25.0
# Of the second step's settling, over the fastest settling, and of its overshoot, which may fill the band: it has no
# specification of its own.
SECOND_SETTLING = 0.05
SECOND_OVERSHOOT = 0.15
# An excess of overshoot costs its ratio to what is allowed, up to the first, and the second for each per cent of it:
# steep at the edge, and yet no wall to a loop that starts far beyond.
MOST_BY_RATIO = 0.3
EACH_PER_CENT = 0.3

# Settling time that is put down for a loop that never settles, over the fastest settling.
NEVER_SETTLES = 10.0
# Share of the motors that decides, the worst of them: the tail beyond a 95th percentile, and a little more.
TAIL = 0.1


class Strictness(NamedTuple):
    """What differs between the cost that is followed down and the one by which the best is chosen.

    **Fields**: `overshoot`, weight of its excess; `allowed_overshoot`, over that of the specification;
    `allowed_sensitivity`, likewise; `tracking_error`, its weight.
    """

    overshoot: float
    allowed_overshoot: float
    allowed_sensitivity: float
    tracking_error: float


# The descent keeps away from the limit of overshoot, which the smooth metrics blur, and the tracking error, 1 for each
# part, draws it on where nothing settles yet.
DESCENT = Strictness(
    overshoot=1.0, allowed_overshoot=0.8, allowed_sensitivity=1.0, tracking_error=3.0
)
# The choice goes by exact metrics: nearly all the overshoot may be used, but going beyond costs more than it can gain,
# and a sensitivity at its limit, where the descent ends, is not held against a loop.
CHOICE = Strictness(
    overshoot=3.0, allowed_overshoot=0.97, allowed_sensitivity=1.01, tracking_error=0.0
)


class Task(eqx.Module):
    """What the loop is to do, on which hardware, and how well.

    From rest to the set point; then a load sets in; then, under load, on to half the set point. Gains that were only
    ever asked for the first may do it by a windup that happens to fit.

    **Fields**: `setpoint`, rad/s; `load`, N m, a step that comes once the set point is held;
    `fastest_settling`, of any controller within the limits, s; `max_overshoot`, %; `max_sensitivity`, of
    the loop, None for any; `noise`, rad/s of measured speed at each sample; `step_samples`, how many each of the three
    parts takes.
    """

    hardware: Hardware
    setpoint: Number
    load: Number
    fastest_settling: Number
    max_overshoot: Number
    max_sensitivity: Number | None
    noise: Float[Array, " samples"]
    step_samples: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)  # a sample, which the motor's effects need

    def course(self) -> Course:
        """Set point, load, half the set point."""
        part = jnp.arange(PARTS * self.step_samples) // self.step_samples
        reference = jnp.where(part < 2, self.setpoint, SECOND_SETPOINT * self.setpoint)
        load = jnp.where(part < 1, 0.0, self.load)
        return Course(reference, load, self.noise)

    def parts(self, response: Response, substeps: int = 1) -> list[tuple[Samples, Samples]]:
        """Time and speed of each of the parts."""
        count = self.step_samples * substeps
        cuts = (slice(k * count, (k + 1) * count) for k in range(PARTS))
        return [(response.time[cut], response.speed[cut]) for cut in cuts]


Each = Float[Array | np.ndarray, " motors"]
Part = tuple[Samples, Samples]


class Score(NamedTuple):
    """Figures of one controller on each of the motors; NaN for times of what never happens.

    `settling`, s, and `overshoot`, %, of the step; `recovery` from the load, s; `second_settling`, s, and
    `second_overshoot`, %, of the second step; `tracking_error`, mean error over the set point; `steady_error`, the
    same at the end of the step, and of the load step, added up; `effort`, mean change of voltage from sample to
    sample, over the voltage limit; `sensitivity`, peak over frequency, with the first motor.
    """

    settling: Each
    overshoot: Each
    recovery: Each
    second_settling: Each
    second_overshoot: Each
    tracking_error: Each
    steady_error: Each
    effort: Each
    sensitivity: One


def exact_score(
    task: Task, model: SampledMotor, motors: Motor, controller: AbstractController
) -> Score:
    """The exact metrics of a controller on every motor, between samples too. `motors` has a leading axis."""
    setpoint, lower = task.setpoint, SECOND_SETPOINT * task.setpoint

    def metrics(step: Part, loaded: Part, second: Part) -> dict[str, One]:
        first, last = step_metrics(*step, setpoint), step_metrics(*second, lower, setpoint)
        return {
            "settling": first.SettlingTime,
            "overshoot": first.Overshoot,
            "recovery": load_metrics(*loaded, setpoint).RecoveryTime,
            "second_settling": last.SettlingTime,
            "second_overshoot": last.Overshoot,
        }

    return _score(task, model, motors, controller, EXACT_SUBSTEPS, metrics)


def smooth_score(
    task: Task, model: SampledMotor, motors: Motor, controller: AbstractController, width: Number
) -> Score:
    """The metrics with a derivative everywhere, at the samples; `width` softens them, in bands."""
    setpoint, lower = task.setpoint, SECOND_SETPOINT * task.setpoint
    soft = SMOOTH_OVERSHOOT * width

    def metrics(step: Part, loaded: Part, second: Part) -> dict[str, One]:
        return {
            "settling": smooth_settling(*step, setpoint, 0.0, width),
            "overshoot": smooth_overshoot(step[1], setpoint, 0.0, soft * task.max_overshoot),
            "recovery": smooth_settling(*loaded, setpoint, 0.0, width),
            "second_settling": smooth_settling(*second, lower, setpoint, width),
            "second_overshoot": smooth_overshoot(second[1], lower, setpoint, soft),
        }

    return _score(task, model, motors, controller, 1, metrics)


def _score(
    task: Task,
    model: SampledMotor,
    motors: Motor,
    controller: AbstractController,
    substeps: int,
    metrics: Callable[[Part, Part, Part], dict[str, One]],
) -> Score:
    """Exact or smooth metrics, and what is the same beside either."""
    law, course = Law(controller, task.hardware, model), task.course()
    substeps *= task.substeps
    reference = jnp.repeat(course.reference, substeps)
    end = round(STEADY_SHARE * task.step_samples * substeps)

    def figures(motor: Motor) -> dict[str, One]:
        response = closed_loop(motor, law, course, substeps)
        errors = jnp.abs(response.speed / reference - 1).reshape(PARTS, -1)
        changes = jnp.abs(jnp.diff(response.voltage[::substeps]))
        return {
            **metrics(*task.parts(response, substeps)),
            "tracking_error": jnp.mean(errors),
            "steady_error": jnp.sum(jnp.mean(errors[:2, -end:], axis=1)),
            "effort": jnp.mean(changes) / task.hardware.voltage_limit,
        }

    first = jax.tree.map(lambda leaf: leaf[0], motors)
    peak = sensitivity_peak(linear_loop(first, law))
    return Score(**jax.vmap(figures)(motors), sensitivity=peak)


def cost(task: Task, score: Score, strictness: Strictness) -> Float[Array, ""]:
    """What is minimised: settling over the fastest settling on the motors, and what it costs to miss the rest."""

    def over_fastest(time: Each) -> Each:
        return jnp.nan_to_num(time / task.fastest_settling, nan=NEVER_SETTLES)

    allowed = strictness.allowed_overshoot * task.max_overshoot
    costs = (
        over_fastest(score.settling)
        + strictness.overshoot * overshoot_cost(score.overshoot, allowed)
        + RECOVERY * over_fastest(score.recovery)
        + strictness.tracking_error * score.tracking_error
        + SECOND_SETTLING * over_fastest(score.second_settling)
        + SECOND_OVERSHOOT * overshoot_cost(score.second_overshoot, 100 * BAND)
        + STEADY_ERROR * score.steady_error
        + score.effort
    )
    if task.max_sensitivity is None:
        return _mean_and_tail(costs)
    excess = score.sensitivity / task.max_sensitivity - strictness.allowed_sensitivity
    return _mean_and_tail(costs) + jax.nn.relu(excess)


def overshoot_cost(overshoot: Number, allowed: Number) -> Number:
    """Nothing within what is allowed; beyond, the excess over it at first, then its per cent."""
    excess = jax.nn.relu(overshoot - allowed)
    return jnp.minimum(excess / allowed, MOST_BY_RATIO) + EACH_PER_CENT * excess


def _mean_and_tail(costs: Each) -> Float[Array, ""]:
    """The mean, and the mean of the worst tenth, half each."""
    worst = max(1, round(TAIL * costs.size))
    return 0.5 * jnp.mean(costs) + 0.5 * jnp.mean(jax.lax.top_k(costs, worst)[0])
