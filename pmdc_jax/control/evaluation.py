"""Evaluation of a controller: exact metrics on the nominal motor and over motors drawn from its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from attrs import field, frozen
from jaxtyping import Array, Float

from ..motor import Motor
from ..runtime.compiled import compiled
from .controllers import AbstractController
from .law import Law, SampledMotor
from .loop import Response, closed_loop
from .margins import Margins, margins
from .metrics import LoadMetrics, StepMetrics, load_metrics, step_metrics
from .objective import SECOND_SETPOINT, Score, Task, exact_score

REPORTED_SUBSTEPS = 10  # simulated instants per sample in reported responses
SMALL_STEP = 0.05  # set point of the small step over that of the task


@frozen
class Robustness:
    """Metrics over the drawn motors: 95th percentiles, None where more than 5 % never settle or cannot be simulated."""

    samples: int
    Overshoot_p95: float | None
    SettlingTime_p95: float | None
    PeakCurrent_p95: float | None  # A, in the steps and under load
    overshoot: np.ndarray = field(repr=False)  # of each motor, %; infinite if it diverges
    settling: np.ndarray = field(repr=False)  # of each motor, s; infinite where it never settles


@frozen
class EvaluatedController:
    """A controller, named after how its gains were chosen, with its metrics; None where an event never happens."""

    name: str
    controller: AbstractController
    metrics: Mapping[str, float | None]
    load: Mapping[str, float | None]
    second_step: Mapping[str, float | None]  # of the step from the set point to half of it
    small_step: Mapping[str, float | None]  # of a step to 5 % of the set point
    robust: Robustness | None
    margins: Margins
    response: Response = field(repr=False, converter=lambda r: Response(*map(np.asarray, r)))  # over the whole course


def evaluate(
    name: str, task: Task, motor: Motor, controller: AbstractController, validation_motors: Motor | None
) -> EvaluatedController:
    """A controller with its exact metrics; `validation_motors`, along a leading axis, give the percentiles."""
    controller = jax.tree.map(jnp.asarray, controller)
    law = Law.of(controller, task.hardware, motor)
    response = simulate_task(task, motor, law)
    step, loaded, second = task.parts(response, REPORTED_SUBSTEPS * task.substeps)
    return EvaluatedController(
        name=name,
        controller=controller,
        metrics=_finite_or_none(step_metrics(*step, task.setpoint)),
        load=_finite_or_none(load_metrics(*loaded, task.setpoint)),
        second_step=_finite_or_none(step_metrics(*second, SECOND_SETPOINT * task.setpoint, task.setpoint)),
        small_step=_finite_or_none(_small_step_metrics(task, motor, law)),
        robust=None if validation_motors is None else evaluate_robustness(task, motor, controller, validation_motors),
        margins=margins(motor, law),
        response=response,
    )


def _small_step_metrics(task: Task, motor: Motor, law: Law) -> StepMetrics:
    """Metrics of a step to a twentieth of the set point, without load and noise. Gains that do not overshoot a step
    with the voltage at its limit may overshoot this one."""
    small = eqx.tree_at(
        lambda t: (t.setpoint, t.load, t.noise), task, (SMALL_STEP * task.setpoint, 0 * task.load, 0 * task.noise)
    )
    (time, speed), *_ = small.parts(simulate_task(small, motor, law), REPORTED_SUBSTEPS * task.substeps)
    return step_metrics(time, speed, small.setpoint)


@compiled
def simulate_task(task: Task, motor: Motor, law: Law) -> Response:
    """Response over the whole course, ten instants per simulation step."""
    return closed_loop(motor, law, task.course(), REPORTED_SUBSTEPS * task.substeps)


@compiled
def simulate_speeds(task: Task, motors: Motor, law: Law) -> Float[Array | np.ndarray, "motors samples"]:
    """Speed of every motor at every sample, rad/s."""

    def speed(motor: Motor) -> Float[Array | np.ndarray, " samples"]:
        return closed_loop(motor, law, task.course(), task.substeps).speed[:: task.substeps]

    return jax.vmap(speed)(motors)


def _finite_or_none(metrics: StepMetrics | LoadMetrics) -> dict[str, float | None]:
    """Metrics by name, None where the event never happens."""
    values = {name: float(value) for name, value in metrics._asdict().items()}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def evaluate_robustness(task: Task, motor: Motor, controller: AbstractController, motors: Motor) -> Robustness:
    """Metrics over `motors`, along a leading axis, of a controller whose law is designed for `motor`."""
    controller = jax.tree.map(jnp.asarray, controller)
    model = SampledMotor.of(motor, task.hardware.sample_time)
    score: Score = _exact_score(task, model, motors, controller)
    settling = np.nan_to_num(np.asarray(score.settling), nan=np.inf)
    overshoot = np.nan_to_num(np.asarray(score.overshoot), nan=np.inf)
    current = np.nan_to_num(np.asarray(score.peak_current), nan=np.inf)
    return Robustness(
        samples=len(settling),
        Overshoot_p95=_p95(overshoot),
        SettlingTime_p95=_p95(settling),
        PeakCurrent_p95=_p95(current),
        overshoot=overshoot,
        settling=settling,
    )


def _p95(values: np.ndarray) -> float | None:
    p95 = float(np.quantile(values, 0.95, method="higher"))
    return p95 if math.isfinite(p95) else None


_exact_score = compiled(exact_score)
