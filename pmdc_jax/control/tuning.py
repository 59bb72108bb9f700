"""From a motor and a specification to gains that work on the sampled, limited loop."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import attrs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from attrs import field, frozen

from ..compiled import make_room
from ..motor import Motor
from ..motor_file import Uncertainty
from ..precision import double_precision
from ..progress import ReportProgress, silent
from ..simulate.propagator import steps_within
from .classical import RULED, ziegler_nichols
from .controllers import AbstractController
from .descent import STARTS, best_coordinates
from .gains import GainSpace
from .hardware import Hardware
from .judge import SMALL_STEP, JudgedController, Robustness, judged, simulated, speeds
from .law import Law
from .loop import Response
from .margins import Margins, margins
from .objective import PARTS, Task
from .specification import MAX_SENSITIVITY, LoopRequirements, Specification
from .spread import drawn_motors, even_spread

TUNING_MOTORS = 32  # drawn from the uncertainty, that take part in the tuning
VALIDATION_MOTORS = 256  # drawn apart from these, that judge it afterwards
# Noise of the speed that a loop is tuned with at least, over the set point: gains that never saw any would shake.
TUNING_NOISE = 2e-4
# Overshoot allowed at least in the cost, %: its excess is weighed over what is allowed.
LEAST_OVERSHOOT = 0.01
# What is told of: the overshoot of a small step, over what the whole step may overshoot or does; and a peak of the
# sensitivity, over the default limit.
NOTABLE_OVERSHOOT = 1.2
NOTABLE_SENSITIVITY = 1.1


@frozen
class Tuning:
    """Gains, how well they do, and how far that is from what is possible."""

    law: Law
    motor: Motor
    task: Task
    asked: LoopRequirements
    margins: Margins
    candidates: tuple[JudgedController, ...]  # ours first
    response: Response = field(repr=False, converter=lambda r: Response(*map(np.asarray, r)))
    bundle: np.ndarray | None = field(repr=False)  # (motors, samples) rad/s, of the drawn motors
    seed: int
    seconds: Mapping[str, float] = field(factory=dict)
    messages: tuple[str, ...] = ()

    @property
    def metrics(self) -> Mapping[str, float | None]:
        """Of the step, on the nominal motor."""
        return self.candidates[0].metrics

    @property
    def load(self) -> Mapping[str, float | None]:
        """Metrics of the load step, on the nominal motor."""
        return self.candidates[0].load

    @property
    def robust(self) -> Robustness | None:
        """Over the drawn motors, if the motor is uncertain."""
        return self.candidates[0].robust

    @property
    def setpoint(self) -> float:
        """In rad/s."""
        return float(self.task.setpoint)

    @property
    def load_torque(self) -> float:
        """The load step that the loop was tried with, N m."""
        return float(self.task.load)

    @property
    def load_from(self) -> float:
        """When the load sets in, s."""
        return self.task.step_samples * float(self.hardware.sample_time)

    @property
    def fastest_possible_settling(self) -> float:
        """Of any controller within the limits, s."""
        return float(self.task.fastest_settling)

    @property
    def peak_current(self) -> float:
        """The largest on the way, A."""
        return float(np.abs(self.response.current).max())

    @property
    def controller(self) -> AbstractController:
        """The controller with its gains."""
        return self.law.controller

    @property
    def hardware(self) -> Hardware:
        """What it was tuned on."""
        return self.law.hardware

    @property
    def meets_specification(self) -> bool:
        """Are overshoot and, where it was limited, settling within the specification, on the nominal motor?"""
        overshoot, settling = self.metrics["Overshoot"], self.metrics["SettlingTime"]
        if overshoot is None or settling is None or overshoot > self.asked.max_overshoot:
            return False
        return self.asked.max_settling is None or settling <= self.asked.max_settling


def tune(
    motor: Motor,
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
    speed_noise: float = 0.0,
    measures_current: bool = True,
    uncertainty: Uncertainty | None = None,
    spread: float | None = None,
    max_sensitivity: float | None = MAX_SENSITIVITY,
    starts: int = STARTS,
    seed: int = 0,
    progress: ReportProgress | None = None,
) -> Tuning:
    """Find the gains with which a motor settles fastest at a set point, within the specification.

    The loop is simulated as it will run: sampled, late, limited in voltage and current, with the anti-windup on the
    voltage really applied. Gains are screened at random, the best followed down the gradient of the settling time,
    and judged by exact metrics between the samples.

    **Arguments**: `motor`, of scalars; `controller`, a key of `CONTROLLERS`; `setpoint`, rad/s, by default 80 % of
    what the voltage reaches; `voltage_limit`, V, by default a quarter above what the set point takes;
    `current_limit`, A; `sample_time`, s, by default 1 ms or a fortieth of the fastest settling;
    `max_overshoot`, %; `max_settling`, s; `load_torque`, N m, a load step to withstand, by default half of what
    can be held; `delay`, samples, 0 or 1; `speed_step`, rad/s, quantum of the speed sensor; `speed_noise`, rad/s;
    `measures_current`; `uncertainty` of the motor, from its file, or `spread`, a standard deviation of the
    logarithm of each parameter: then the worst tenth of 32 drawn motors counts for half, and 256 others judge;
    `max_sensitivity`, of the loop; `starts`, how many are followed; `seed`; `progress`.

    **Raises**: `InputError` for a specification that no controller can meet, with the limit.
    """
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
        measures_current=measures_current,
        spread=spread,
        max_sensitivity=max_sensitivity,
    )
    return design(motor, requirements, uncertainty, starts, seed, progress)


@double_precision
def design(
    motor: Motor,
    requirements: LoopRequirements,
    uncertainty: Uncertainty | None = None,
    starts: int = STARTS,
    seed: int = 0,
    progress: ReportProgress | None = None,
) -> Tuning:
    """`tune`, with what is asked of the loop in one object.

    **Arguments**: `motor`, of scalars; `requirements`; `uncertainty` of the motor, which the spread of the requirements
    takes the place of; `starts`, how many are followed; `seed`; `progress`.

    **Raises**: `InputError` for requirements that no controller can meet, with the limit.
    """
    begin = time.perf_counter()
    make_room()
    report = progress or silent
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    specification = requirements.completed(motor)
    tuning_motors, validation_motors = _tuning_and_validation_motors(
        motor, uncertainty, requirements.spread, seed
    )
    report("tuning from many starts")
    unit_noise = np.random.default_rng(seed).standard_normal(PARTS * specification.samples)
    task = _task(specification, motor, unit_noise)
    controller = _tuned(specification, task, tuning_motors, unit_noise, seed, starts)
    report("judging the loop", fraction=0.8)
    result = _judged(specification, task, motor, controller, validation_motors, seed)
    return attrs.evolve(
        result,
        messages=(*specification.notes, *_undetermined(uncertainty), *_verdicts(result)),
        seconds={"total": time.perf_counter() - begin},
    )


@double_precision
def robustness(tuning: Tuning, spread: float, seed: int) -> Robustness | None:
    """How a tuning does on motors it was not tuned for; see `tune` for `spread`."""
    _, motors = _tuning_and_validation_motors(tuning.motor, None, spread, seed)
    return judged("tuned", tuning.task, tuning.motor, tuning.controller, motors).robust


def _task(specification: Specification, motor: Motor, unit_noise: np.ndarray) -> Task:
    """What is simulated and judged; its noise has the size of the sensor's."""
    asked = specification.asked
    stall = float(specification.voltage_limit / motor.R)
    most = min(stall, asked.current_limit or stall)
    return Task(
        hardware=specification.hardware(),
        setpoint=jnp.asarray(specification.setpoint),
        load=jnp.asarray(specification.load_torque),
        fastest_settling=jnp.asarray(specification.fastest_settling),
        max_overshoot=jnp.asarray(max(asked.max_overshoot, LEAST_OVERSHOOT)),
        max_sensitivity=None
        if asked.max_sensitivity is None
        else jnp.asarray(asked.max_sensitivity),
        noise=jnp.asarray(asked.speed_noise * unit_noise),
        step_samples=specification.samples,
        substeps=int(steps_within(motor, specification.sample_time, jnp.asarray(most))),
    )


def _tuned(
    specification: Specification,
    task: Task,
    motors: Motor,
    unit_noise: np.ndarray,
    seed: int,
    starts: int,
) -> AbstractController:
    """The best of many starts, tuned with some noise even where there is none."""
    nominal = jax.tree.map(lambda leaf: leaf[0], motors)
    stiffness = jnp.asarray(specification.voltage_limit / abs(specification.setpoint))
    period, kind = task.hardware.sample_time, specification.asked.controller
    space = GainSpace(kind, stiffness, task.fastest_settling, period, nominal, task.setpoint)
    least = TUNING_NOISE * abs(specification.setpoint)
    shaken = jnp.asarray(max(specification.asked.speed_noise, least) * unit_noise)
    noisy = eqx.tree_at(lambda t: t.noise, task, shaken)
    return space.controller(jnp.asarray(best_coordinates(noisy, space, motors, seed, starts)))


def _judged(
    specification: Specification,
    task: Task,
    motor: Motor,
    controller: AbstractController,
    validation_motors: Motor | None,
    seed: int,
) -> Tuning:
    """The tuned controller and what the textbook would have chosen, by exact metrics."""
    law = Law.of(controller, task.hardware, motor)
    asked = specification.asked
    return Tuning(
        law=law,
        motor=motor,
        task=task,
        asked=asked,
        margins=margins(motor, law),
        candidates=(
            judged("tuned", task, motor, controller, validation_motors),
            *_rivals(task, motor, asked.controller, validation_motors),
        ),
        response=simulated(task, motor, law),
        bundle=None
        if validation_motors is None
        else np.asarray(speeds(task, validation_motors, law)),
        seed=seed,
    )


def _tuning_and_validation_motors(
    motor: Motor, uncertainty: Uncertainty | None, spread: float | None, seed: int
) -> tuple[Motor, Motor | None]:
    """Those to tune on, the nominal one first, and others to judge by; along a leading axis."""
    nominal = jax.tree.map(lambda leaf: leaf[None], motor)
    if spread is not None:
        uncertainty = even_spread(spread)
    if uncertainty is None:
        return nominal, None
    others = drawn_motors(motor, uncertainty, TUNING_MOTORS, seed)
    tuning_motors = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), nominal, others)
    return tuning_motors, drawn_motors(motor, uncertainty, VALIDATION_MOTORS, seed + 1)


def _rivals(
    task: Task, motor: Motor, kind: str, validation_motors: Motor | None
) -> Iterator[JudgedController]:
    """What the textbook would have chosen."""
    if kind in RULED:
        rule = ziegler_nichols(motor, task.hardware, kind)
        yield judged("Ziegler-Nichols", task, motor, rule, validation_motors)


def _undetermined(uncertainty: Uncertainty | None) -> Iterator[str]:
    """What of the motor is taken as it stands in the file."""
    if uncertainty is not None and uncertainty.undetermined:
        yield (
            f"no recording determined {', '.join(uncertainty.undetermined)} of this motor: the values in the file are"
            " taken as they are"
        )


def _verdicts(result: Tuning) -> Iterator[str]:
    """What of the specification is not met, and what is to be minded."""
    yield from _unmet(result)
    yield from _small_step_remark(result)
    peak = result.margins.sensitivity_peak
    if peak is not None and peak > NOTABLE_SENSITIVITY * MAX_SENSITIVITY:
        yield f"the loop has thin margins: its sensitivity reaches {peak:.2f}"


def _unmet(result: Tuning) -> Iterator[str]:
    """Where settling or overshoot miss what was asked for."""
    overshoot, settling = result.metrics["Overshoot"], result.metrics["SettlingTime"]
    max_settling, max_overshoot = result.asked.max_settling, result.asked.max_overshoot
    if settling is None:
        yield "the loop does not settle: try another controller or a shorter sample time"
    elif max_settling is not None and settling > max_settling:
        yield f"settling takes {settling:.4g} s, longer than the {max_settling:g} s asked for"
    if overshoot is not None and overshoot > max_overshoot:
        yield f"overshoot is {overshoot:.3g} %, above the {max_overshoot:g} % asked for"


def _small_step_remark(result: Tuning) -> Iterator[str]:
    """Whether a small step overshoots notably more than the step to the set point, and by more than the sensor's
    quantum alone explains."""
    overshoot = result.candidates[0].small_step["Overshoot"] or 0.0
    step = SMALL_STEP * result.setpoint
    allowed = NOTABLE_OVERSHOOT * max(
        result.asked.max_overshoot, result.metrics["Overshoot"] or 0.0
    )
    quantum = result.asked.speed_step or 0.0
    if overshoot > allowed and overshoot / 100 * abs(step) > quantum:
        yield (
            f"a step of {step:.3g} rad/s, which no limit slows down, overshoots by {overshoot:.3g} %: tune for a"
            " smaller set point if such steps matter"
        )
