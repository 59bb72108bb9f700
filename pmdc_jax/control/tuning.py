"""Tuning: from a motor and a specification to gains for the sampled loop with its limits."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import attrs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from attrs import field, frozen

from ..motor import Motor
from ..motor_file import Uncertainty, load_motor, load_speed_noise, load_uncertainty
from ..progress import ReportProgress, silent
from ..runtime.compiled import free_memory_maps
from ..runtime.precision import double_precision
from ..runtime.threads import one_blas_thread
from ..simulate.propagator import steps_within
from .classical import ZIEGLER_NICHOLS_CONTROLLERS, ziegler_nichols
from .controllers import AbstractController
from .descent import STARTS, best_coordinates
from .evaluation import (
    SMALL_STEP,
    EvaluatedController,
    Robustness,
    evaluate,
    evaluate_robustness,
    simulate_speeds,
    simulate_task,
)
from .gains import GainSpace
from .hardware import Hardware
from .law import Law
from .loop import Response
from .margins import Margins, margins
from .objective import PART_COUNT, Task
from .specification import MAX_SENSITIVITY, LoopRequirements, Specification
from .spread import drawn_motors, even_spread

TUNING_MOTORS = 32  # motors drawn from the uncertainty to tune on, beside the nominal one
VALIDATION_MOTORS = 256  # motors drawn independently of these to judge the result
# Standard deviation of the speed noise while tuning, over the set point. Gains tuned without any would make the voltage
# jitter; noise of the recordings that comes near the 2 % band would leave nothing to tune for.
MIN_TUNING_NOISE, MAX_RECORDED_NOISE = 2e-4, 5e-3
# Thresholds for a message: overshoot of the small step, over the larger of the allowed overshoot and the overshoot of
# the full step; peak sensitivity, over its default limit; and current, over its limit.
OVERSHOOT_TO_REPORT = 1.2
SENSITIVITY_TO_REPORT = 1.1
CURRENT_TO_REPORT = 1.02
# Kt over Kb, or its inverse, from which one of them must be in another unit: in SI they differ by iron losses
CONSTANTS_RATIO_TO_REPORT = 3.0


@frozen
class Tuning:
    """Result of a tuning: the law, its performance, and the fastest settling possible."""

    law: Law
    motor: Motor
    task: Task
    requirements: LoopRequirements
    margins: Margins
    candidates: tuple[EvaluatedController, ...]  # the tuned one first
    response: Response = field(repr=False, converter=lambda r: Response(*map(np.asarray, r)))
    validation_speeds: np.ndarray | None = field(repr=False)  # (motors, samples) rad/s
    seed: int
    seconds: Mapping[str, float] = field(factory=dict)
    messages: tuple[str, ...] = ()

    @property
    def metrics(self) -> Mapping[str, float | None]:
        """Metrics of the step, on the nominal motor."""
        return self.candidates[0].metrics

    @property
    def load(self) -> Mapping[str, float | None]:
        """Metrics of the load step, on the nominal motor."""
        return self.candidates[0].load

    @property
    def robust(self) -> Robustness | None:
        """Metrics over the drawn motors; None without an uncertainty or spread."""
        return self.candidates[0].robust

    @property
    def setpoint(self) -> float:
        """Set point, rad/s."""
        return float(self.task.setpoint)

    @property
    def load_torque(self) -> float:
        """Load step in the simulation, N m."""
        return float(self.task.load)

    @property
    def load_step_time(self) -> float:
        """Time of the load step, s."""
        return self.task.part_samples * float(self.hardware.sample_time)

    @property
    def fastest_possible_settling(self) -> float:
        """Shortest settling time of any controller within the limits, s."""
        return float(self.task.fastest_settling)

    @property
    def peak_current(self) -> float:
        """Largest simulated current, A."""
        return float(np.abs(self.response.current).max())

    @property
    def voltage_noise(self) -> float | None:
        """RMS of the voltage due to the noise of the speed sensor, V; None where the loop is unstable."""
        gain = self.margins.voltage_per_noise
        return None if gain is None else gain * self.requirements.sensor_noise

    @property
    def controller(self) -> AbstractController:
        """The controller with its gains."""
        return self.law.controller

    @property
    def hardware(self) -> Hardware:
        """The hardware that the loop was tuned for."""
        return self.law.hardware

    @property
    def meets_specification(self) -> bool:
        """Whether the overshoot, and the settling time if limited, meet the specification on the nominal motor."""
        overshoot, settling = self.metrics["Overshoot"], self.metrics["SettlingTime"]
        if overshoot is None or settling is None or overshoot > self.requirements.allowed_overshoot:
            return False
        return self.requirements.max_settling is None or settling <= self.requirements.max_settling


@double_precision
@one_blas_thread
def tune(
    motor: Motor | str | Path,
    controller: str = "pid",
    *,
    setpoint: float | None = None,
    voltage_limit: float | None = None,
    current_limit: float | None = None,
    sample_time: float | None = None,
    max_overshoot: float = 1.0,
    max_settling: float | None = None,
    load_torque: float | None = None,
    delay: int = 1,
    speed_step: float | None = None,
    speed_noise: float | None = None,
    recorded_noise: float | None = None,
    measures_current: bool = True,
    uncertainty: Uncertainty | None = None,
    spread: float | None = None,
    max_sensitivity: float | None = MAX_SENSITIVITY,
    starts: int = STARTS,
    seed: int = 0,
    progress: ReportProgress | None = None,
) -> Tuning:
    """Find the gains with which a motor settles fastest at a set point, within the specification.

    The loop is simulated as it will run: sampled, delayed, limited in voltage and current, with anti-windup driven by
    the voltage actually applied. Gains are drawn at random and screened; from the best, gradient descent minimises the
    settling time; exact metrics, resolved between the samples, select the result.

    **Arguments**: `motor`, with scalar fields, or its file, which gives `uncertainty` and `recorded_noise`, too, where
    they are left out; `controller`, a key of `CONTROLLERS`; `setpoint`, rad/s, by default 80 % of the speed that the
    voltage limit reaches; `voltage_limit`, V, by default 1.25 times the voltage that holds the
    set point, or 24 V if neither is given; `current_limit`, A; `sample_time`, s, by default at most 1 ms and at most a
    fortieth of the motor's transients; `max_overshoot`, %; `max_settling`, s; `load_torque`, N m, a load step to
    withstand, by default half of the torque that can still be held at the set point; `delay`, 0 or 1 samples from
    measurement to voltage; `speed_step`, rad/s, quantum of the speed sensor; `speed_noise`, rad/s, its standard
    deviation, which the metrics include, or `recorded_noise`, from the motor's file, which they do not: gains are tuned
    against either, the latter up to 0.5 % of the set point; `measures_current`, if False the law estimates the current;
    `uncertainty` of the motor, from its file, or `spread`, standard deviation of the logarithm of each parameter: with
    either, the worst tenth of the nominal and 32 drawn motors makes half of the cost, and 256 others validate the
    result; `max_sensitivity`, limit of the peak sensitivity, None for no limit; `starts`, number of descents; `seed`;
    `progress`.

    **Raises**: `InputError`, stating the limit, for a specification that no controller can meet.
    """
    begin = time.perf_counter()
    if not isinstance(motor, Motor):
        uncertainty = uncertainty or load_uncertainty(motor)
        recorded_noise = load_speed_noise(motor) if recorded_noise is None else recorded_noise
        motor = load_motor(motor)
    requirements = LoopRequirements(
        controller=controller,
        setpoint=setpoint,
        voltage_limit=voltage_limit,
        current_limit=current_limit,
        sample_time=sample_time,
        max_overshoot=max_overshoot,
        max_settling=max_settling,
        load_torque=load_torque,
        delay=delay,
        speed_step=speed_step,
        speed_noise=speed_noise,
        recorded_noise=recorded_noise,
        measures_current=measures_current,
        spread=spread,
        max_sensitivity=max_sensitivity,
    )
    free_memory_maps()
    report = progress or silent
    subject: Motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    specification = requirements.completed(subject)
    variation = uncertainty if spread is None else even_spread(spread)
    report("tuning from many starts")
    task_samples = PART_COUNT * specification.part_samples
    unit_noise = np.random.default_rng(seed).standard_normal(task_samples)
    task = _task(specification, subject, unit_noise)
    tuning_motors = _tuning_motors(subject, variation, seed)
    best = _best_controller(specification, task, tuning_motors, unit_noise, seed, starts)
    report("evaluating the loop", fraction=0.8)
    validation_motors = None if variation is None else _validation_motors(subject, variation, seed)
    result = _evaluated(specification, task, subject, best, validation_motors, seed)
    return attrs.evolve(
        result,
        messages=(*specification.notes, *_undetermined_remark(uncertainty), *_remarks(result)),
        seconds={"total": time.perf_counter() - begin},
    )


@double_precision
def robustness(tuning: Tuning, spread: float, seed: int) -> Robustness:
    """Metrics of a tuning over motors that it was not tuned for; `spread` as in `tune`."""
    motors = _validation_motors(tuning.motor, even_spread(spread), seed)
    return evaluate_robustness(tuning.task, tuning.motor, tuning.controller, motors)


def _task(specification: Specification, motor: Motor, unit_noise: np.ndarray) -> Task:
    """The task on which a controller is evaluated, with the noise of the sensor."""
    requirements = specification.requirements
    stall_current = float(specification.voltage_limit / motor.R)
    max_current = min(stall_current, requirements.current_limit or stall_current)
    return Task(
        hardware=specification.hardware(),
        setpoint=jnp.asarray(specification.setpoint),
        load=jnp.asarray(specification.load_torque),
        fastest_settling=jnp.asarray(specification.fastest_settling),
        settling_scale=jnp.asarray(specification.settling_scale),
        max_overshoot=jnp.asarray(requirements.allowed_overshoot),
        max_sensitivity=None
        if requirements.max_sensitivity is None
        else jnp.asarray(requirements.max_sensitivity),
        noise=jnp.asarray((requirements.speed_noise or 0.0) * unit_noise),
        part_samples=specification.part_samples,
        substeps=int(steps_within(motor, specification.sample_time, jnp.asarray(max_current))),
    )


def _tuning_motors(motor: Motor, variation: Uncertainty | None, seed: int) -> Motor:
    """Motors to tune on, stacked: the nominal one first, then those drawn from the variation, if any."""
    nominal = jax.tree.map(lambda leaf: leaf[None], motor)
    if variation is None:
        return nominal
    drawn = drawn_motors(motor, variation, TUNING_MOTORS, seed)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), nominal, drawn)


def _validation_motors(motor: Motor, variation: Uncertainty, seed: int) -> Motor:
    """Motors to validate on, stacked; drawn independently of those to tune on."""
    return drawn_motors(motor, variation, VALIDATION_MOTORS, seed + 1)


def _best_controller(
    specification: Specification,
    task: Task,
    motors: Motor,
    unit_noise: np.ndarray,
    seed: int,
    starts: int,
) -> AbstractController:
    """Best controller of all starts, tuned with noise even if the sensor has none (`MIN_TUNING_NOISE`)."""
    requirements = specification.requirements
    nominal = jax.tree.map(lambda leaf: leaf[0], motors)
    # of the voltage limit, which a loop needs that settles in its scale: at first the speed rises with voltage and time
    share = task.fastest_settling / task.settling_scale
    space = GainSpace(
        kind=requirements.controller,
        gain_unit=task.hardware.voltage_limit / jnp.abs(task.setpoint) * share,
        time_unit=task.settling_scale,
        sample_time=task.hardware.sample_time,
        motor=nominal,
        setpoint=task.setpoint,
    )
    tuning_noise = unit_noise * _tuning_noise(requirements, abs(specification.setpoint))
    tuning_task = eqx.tree_at(lambda t: t.noise, task, jnp.asarray(tuning_noise))
    coordinates = best_coordinates(tuning_task, space, motors, seed, starts)
    return space.controller(jnp.asarray(coordinates))


def _tuning_noise(requirements: LoopRequirements, speed: float) -> float:
    """Standard deviation of the speed noise, rad/s, while tuning for a set point of this size."""
    noise = requirements.speed_noise
    if noise is None:
        noise = min(requirements.recorded_noise or 0.0, MAX_RECORDED_NOISE * speed)
    return max(noise, MIN_TUNING_NOISE * speed)


def _evaluated(
    specification: Specification,
    task: Task,
    motor: Motor,
    controller: AbstractController,
    validation_motors: Motor | None,
    seed: int,
) -> Tuning:
    """The result: exact metrics of the tuned controller and of its textbook rivals."""
    law = Law.of(controller, task.hardware, motor)
    requirements = specification.requirements
    return Tuning(
        law=law,
        motor=motor,
        task=task,
        requirements=requirements,
        margins=margins(motor, law),
        candidates=(
            evaluate("tuned", task, motor, controller, validation_motors),
            *_textbook_candidates(task, motor, requirements.controller, validation_motors),
        ),
        response=simulate_task(task, motor, law),
        validation_speeds=None
        if validation_motors is None
        else np.asarray(simulate_speeds(task, validation_motors, law)),
        seed=seed,
    )


def _textbook_candidates(
    task: Task, motor: Motor, kind: str, validation_motors: Motor | None
) -> Iterator[EvaluatedController]:
    """Controllers by textbook rules, for comparison."""
    if kind in ZIEGLER_NICHOLS_CONTROLLERS:
        controller = ziegler_nichols(motor, task.hardware, kind)
        yield evaluate("Ziegler-Nichols", task, motor, controller, validation_motors)


def _undetermined_remark(uncertainty: Uncertainty | None) -> Iterator[str]:
    """A message on the parameters that no recording determined."""
    if uncertainty is not None and uncertainty.undetermined:
        yield (
            f"the recordings did not determine {', '.join(uncertainty.undetermined)} of this motor: the values in the"
            " file are used as they are"
        )


def _remarks(result: Tuning) -> Iterator[str]:
    """Messages on unmet requirements, and warnings."""
    yield from _unmet_requirements(result)
    yield from _constants_remark(result.motor)
    yield from _small_step_remark(result)
    peak = result.margins.sensitivity_peak
    if peak is not None and peak > SENSITIVITY_TO_REPORT * MAX_SENSITIVITY:
        yield f"the loop has small stability margins: its sensitivity peak is {peak:.2f}"
    limit = result.requirements.current_limit
    if limit is not None and result.peak_current > CURRENT_TO_REPORT * limit:
        yield (
            f"the current reaches {result.peak_current:.3g} A in simulation, beyond its limit of {limit:g} A, because"
            " the controller limits that of the motor without its effects: choose a lower limit"
        )


def _constants_remark(motor: Motor) -> Iterator[str]:
    """A message where the constants of torque and back-EMF cannot be those of one motor."""
    ratio = float(motor.Kt / motor.Kb)
    if max(ratio, 1 / ratio) > CONSTANTS_RATIO_TO_REPORT:
        yield (
            f"Kt is {ratio:.2g} times Kb, whereas they are about equal in SI (N m/A and V s/rad): check their units in"
            " the motor file"
        )


def _unmet_requirements(result: Tuning) -> Iterator[str]:
    """Messages where settling or overshoot miss the specification."""
    overshoot, settling = result.metrics["Overshoot"], result.metrics["SettlingTime"]
    requirements = result.requirements
    max_settling, max_overshoot = requirements.max_settling, requirements.allowed_overshoot
    if settling is None:
        yield "the loop does not settle: try another controller or a shorter sample time"
    elif max_settling is not None and settling > max_settling:
        yield f"settling takes {settling:.4g} s, longer than the required {max_settling:g} s"
    if overshoot is not None and overshoot > max_overshoot:
        yield f"overshoot is {overshoot:.3g} %, above the allowed {max_overshoot:g} %"


def _small_step_remark(result: Tuning) -> Iterator[str]:
    """A message where a small step overshoots notably more than the step to the set point, and by more than the
    sensor's quantum."""
    overshoot = result.candidates[0].small_step["Overshoot"] or 0.0
    step = SMALL_STEP * result.setpoint
    allowed = OVERSHOOT_TO_REPORT * max(
        result.requirements.max_overshoot, result.metrics["Overshoot"] or 0.0
    )
    quantum = result.requirements.speed_step or 0.0
    if overshoot > allowed and overshoot / 100 * abs(step) > quantum:
        yield (
            f"a small step of {step:.3g} rad/s overshoots by {overshoot:.3g} %, more than the step to the set point:"
            " tune for a smaller set point if such steps matter"
        )
