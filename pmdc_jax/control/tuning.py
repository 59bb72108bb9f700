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
from ..simulate.solver import steps_within
from .classical import ziegler_nichols
from .controllers import AbstractController
from .descent import STARTS, tuned
from .gains import GainSpace
from .hardware import Hardware
from .judge import SMALL, Candidate, Robustness, judged, simulated, speeds
from .law import Law
from .loop import Response
from .margins import Margins, margins
from .objective import PARTS, Task
from .specification import MAX_SENSITIVITY, Asked, Specification
from .spread import drawn_motors, even_spread

# Motors that take part in the tuning, and that judge it afterwards.
TUNED_ON, JUDGED_ON = 32, 256
# Noise of the speed that a loop is tuned with at least, over the set point: gains that never saw any would shake.
TUNING_NOISE = 2e-4


@frozen
class Tuning:
    """Gains, how well they do, and how far that is from what is possible."""

    law: Law
    motor: Motor
    task: Task
    asked: Asked
    margins: Margins
    candidates: tuple[Candidate, ...]  # ours first
    response: Response = field(repr=False, converter=lambda r: Response(*map(np.asarray, r)))
    bundle: np.ndarray | None = field(repr=False)  # (motors, samples) rad/s, of the drawn motors
    seed: int
    seconds: Mapping[str, float]
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
        return float(self.task.limit)

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


@double_precision
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
    begin = time.perf_counter()
    make_room()
    asked = Asked(
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
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    specification = asked.completed(motor)
    motors, judges = _motors(motor, uncertainty, spread, seed)
    report = progress or silent
    report("tuning from many starts")
    white = np.random.default_rng(seed).standard_normal(PARTS * specification.samples)
    task = _task(specification, motor, white)
    law = Law.of(_tuned(specification, task, motors, white, seed, starts), task.hardware, motor)
    report("judging the loop", fraction=0.8)
    result = Tuning(
        law=law,
        motor=motor,
        task=task,
        asked=asked,
        margins=margins(motor, law),
        candidates=(
            judged("tuned", task, motor, law.controller, judges),
            *_rivals(task, motor, controller, judges),
        ),
        response=simulated(task, motor, law),
        bundle=None if judges is None else np.asarray(speeds(task, judges, law)),
        seed=seed,
        seconds={"total": time.perf_counter() - begin},
    )
    notes = (*specification.notes, *_undetermined(uncertainty), *_verdicts(result))
    return attrs.evolve(result, messages=notes)


def robustness(tuning: Tuning, spread: float, seed: int) -> Robustness | None:
    """How a tuning does on motors it was not tuned for; see `tune` for `spread`."""
    with jax.enable_x64(True):
        _, judges = _motors(tuning.motor, None, spread, seed)
        return judged("tuned", tuning.task, tuning.motor, tuning.controller, judges).robust


def _task(specification: Specification, motor: Motor, white: np.ndarray) -> Task:
    """What is simulated and judged; its noise has the size of the sensor's."""
    asked = specification.asked
    stall = float(specification.voltage_limit / motor.R)
    most = min(stall, asked.current_limit or stall)
    return Task(
        hardware=specification.hardware(),
        setpoint=jnp.asarray(specification.setpoint),
        load=jnp.asarray(specification.load_torque),
        limit=jnp.asarray(specification.fastest),
        max_overshoot=jnp.asarray(max(asked.max_overshoot, 0.01)),
        max_sensitivity=None
        if asked.max_sensitivity is None
        else jnp.asarray(asked.max_sensitivity),
        noise=jnp.asarray(asked.speed_noise * white),
        step_samples=specification.samples,
        substeps=int(steps_within(motor, specification.sample_time, jnp.asarray(most))),
    )


def _tuned(
    specification: Specification,
    task: Task,
    motors: Motor,
    white: np.ndarray,
    seed: int,
    starts: int,
) -> AbstractController:
    """The best of many starts, tuned with some noise even where there is none."""
    nominal = jax.tree.map(lambda leaf: leaf[0], motors)
    stiffness = jnp.asarray(specification.voltage_limit / abs(specification.setpoint))
    period, kind = task.hardware.sample_time, specification.asked.controller
    space = GainSpace(kind, stiffness, task.limit, period, nominal, task.setpoint)
    least = TUNING_NOISE * abs(specification.setpoint)
    shaken = jnp.asarray(max(specification.asked.speed_noise, least) * white)
    noisy = eqx.tree_at(lambda t: t.noise, task, shaken)
    coordinates, _ = tuned(noisy, space, motors, seed, starts)
    return space.controller(jnp.asarray(coordinates[0]))


def _motors(
    motor: Motor, uncertainty: Uncertainty | None, spread: float | None, seed: int
) -> tuple[Motor, Motor | None]:
    """Those to tune on, the nominal one first, and those that judge; stacked."""
    nominal = jax.tree.map(lambda leaf: leaf[None], motor)
    if spread is not None:
        uncertainty = even_spread(spread)
    if uncertainty is None:
        return nominal, None
    others = drawn_motors(motor, uncertainty, TUNED_ON, seed)
    motors = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), nominal, others)
    return motors, drawn_motors(motor, uncertainty, JUDGED_ON, seed + 1)


def _rivals(task: Task, motor: Motor, kind: str, judges: Motor | None) -> Iterator[Candidate]:
    """What the textbook would have chosen."""
    if kind in ("pi", "pid"):
        rule = ziegler_nichols(motor, task.hardware, kind)
        yield judged("Ziegler-Nichols", task, motor, rule, judges)


def _undetermined(uncertainty: Uncertainty | None) -> Iterator[str]:
    """What of the motor is taken as it stands in the file."""
    if uncertainty is not None and uncertainty.undetermined:
        yield (
            f"no recording determined {', '.join(uncertainty.undetermined)} of this motor: the values in the file are"
            " taken as they are"
        )


def _verdicts(result: Tuning) -> list[str]:
    """What of the specification is not met, and what is to be minded."""
    messages = []
    overshoot, settling = result.metrics["Overshoot"], result.metrics["SettlingTime"]
    if settling is None:
        messages.append("the loop does not settle: try another controller or a shorter sample time")
    elif result.asked.max_settling is not None and settling > result.asked.max_settling:
        messages.append(
            f"settling takes {settling:.4g} s, longer than the {result.asked.max_settling:g} s asked for"
        )
    if overshoot is not None and overshoot > result.asked.max_overshoot:
        messages.append(
            f"overshoot is {overshoot:.3g} %, above the {result.asked.max_overshoot:g} % asked for"
        )
    small, step = result.candidates[0].small["Overshoot"] or 0.0, SMALL * result.setpoint
    allowed = 1.2 * max(result.asked.max_overshoot, overshoot or 0.0)
    if small > allowed and small * abs(step) > 100 * (result.asked.speed_step or 0.0):
        messages.append(
            f"a step of {step:.3g} rad/s, which no limit slows down, overshoots by {small:.3g} %: tune for a smaller"
            " set point if such steps matter"
        )
    peak = result.margins.sensitivity_peak
    if peak is not None and peak > 1.1 * MAX_SENSITIVITY:
        messages.append(f"the loop has thin margins: its sensitivity reaches {peak:.2f}")
    return messages
