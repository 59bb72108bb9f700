"""From a motor and a specification to a `Tuning`: gains for the sampled loop with its limits."""

from __future__ import annotations

import time
from pathlib import Path

import attrs
import jax
import jax.numpy as jnp
import numpy as np

from ..motor import Motor
from ..motor_file import MotorFile, Uncertainty
from ..progress import ReportProgress, silent
from ..runtime.compiled import free_memory_maps
from ..runtime.precision import double_precision
from ..runtime.threads import one_blas_thread
from .classical import textbook_controller
from .controllers import AbstractController
from .descent import STARTS, best_coordinates
from .evaluation import Robustness, evaluate, evaluate_robustness, simulate_speeds
from .gains import GainSpace
from .law import Law
from .objective import Task
from .remarks import remarks
from .specification import MAX_SENSITIVITY, LoopRequirements
from .spread import drawn_motors, even_spread
from .tuning import Tuning

TUNING_MOTORS = 32  # motors drawn from the uncertainty to tune on, beside the nominal one
VALIDATION_MOTORS = 256  # motors drawn independently of these to judge the result
# Standard deviation of the speed noise while tuning, over the set point. Gains tuned without any would make the voltage
# jitter; noise of the recordings that comes near the 2 % band would leave nothing to tune for.
MIN_TUNING_NOISE, MAX_RECORDED_NOISE = 2e-4, 5e-3


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
        file = MotorFile.read(motor)
        uncertainty = uncertainty or file.uncertainty
        recorded_noise = file.speed_noise if recorded_noise is None else recorded_noise
        motor = file.motor()
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
    task, notes = requirements.task(subject)
    variation = uncertainty if spread is None else even_spread(spread)
    report("tuning from many starts")
    unit_noise = np.random.default_rng(seed).standard_normal(task.noise.size)
    task = task.with_noise((requirements.speed_noise or 0.0) * unit_noise)
    tuning_motors = _tuning_motors(subject, variation, seed)
    best = _best_controller(requirements, task, tuning_motors, unit_noise, seed, starts)
    report("evaluating the loop", fraction=0.8)
    validation_motors = None if variation is None else _validation_motors(subject, variation, seed)
    result = _evaluated(requirements, task, subject, best, validation_motors, seed)
    return attrs.evolve(
        result, messages=(*notes, *remarks(result, uncertainty)), seconds={"total": time.perf_counter() - begin}
    )


@double_precision
def robustness(tuning: Tuning, spread: float, seed: int) -> Robustness:
    """Metrics of a tuning over motors that it was not tuned for; `spread` as in `tune`."""
    motors = _validation_motors(tuning.motor, even_spread(spread), seed)
    return evaluate_robustness(tuning.task, tuning.motor, tuning.controller, motors)


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
    requirements: LoopRequirements, task: Task, motors: Motor, unit_noise: np.ndarray, seed: int, starts: int
) -> AbstractController:
    """Best controller of all starts, tuned with noise even if the sensor has none (`MIN_TUNING_NOISE`)."""
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
    tuning_task = task.with_noise(unit_noise * _tuning_noise(requirements, abs(float(task.setpoint))))
    coordinates = best_coordinates(tuning_task, space, motors, seed, starts)
    return space.controller(jnp.asarray(coordinates))


def _tuning_noise(requirements: LoopRequirements, speed: float) -> float:
    """Standard deviation of the speed noise, rad/s, while tuning for a set point of this size."""
    noise = requirements.speed_noise
    if noise is None:
        noise = min(requirements.recorded_noise or 0.0, MAX_RECORDED_NOISE * speed)
    return max(noise, MIN_TUNING_NOISE * speed)


def _evaluated(
    requirements: LoopRequirements,
    task: Task,
    motor: Motor,
    controller: AbstractController,
    validation_motors: Motor | None,
    seed: int,
) -> Tuning:
    """The result: exact metrics of the tuned controller and of its textbook rival."""
    rule, rival = textbook_controller(motor, task, requirements.controller)
    law = Law.of(controller, task.hardware, motor)
    return Tuning(
        law=law,
        motor=motor,
        task=task,
        requirements=requirements,
        tuned=evaluate("tuned", task, motor, controller, validation_motors),
        textbook=evaluate(rule, task, motor, rival, validation_motors),
        validation_speeds=None
        if validation_motors is None
        else np.asarray(simulate_speeds(task, validation_motors, law)),
        seed=seed,
    )
