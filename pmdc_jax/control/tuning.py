"""From a motor and a specification to gains that work on the sampled, limited loop."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import attrs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from attrs import field, frozen

from ..errors import InputError
from ..motor import Motor
from ..motor_file import Uncertainty
from ..precision import double_precision
from .classical import ziegler_nichols
from .controllers import CONTROLLERS, AbstractController
from .descent import STARTS, tuned
from .gains import GainSpace
from .hardware import Hardware
from .law import Law, Model
from .limit import fastest_settling
from .loop import REMEMBERED, Response, closed_loop, steps_in_sample
from .margins import Margins, margins
from .metrics import load_metrics, step_metrics
from .objective import LOWER, PARTS, Score, Task, score
from .requirements import check_positive, check_reachable, check_time, reach, spare_torque
from .spread import drawn_motors, even_spread
from .steady import steady_state

if TYPE_CHECKING:
    from ..report.terminal import ReportProgress

# Motors that take part in the tuning, and that judge it afterwards.
TUNED_ON, JUDGED_ON = 32, 256
SUBSTEPS = 10  # instants a sample in what is reported
NOMINAL_VOLTAGE = 24.0
MAX_SENSITIVITY = 2.0
# Noise of the speed that a loop is tuned with at least, over the set point: gains that never saw any would shake.
TUNING_NOISE = 2e-4


@frozen
class Robustness:
    """The metrics over motors drawn from the uncertainty: 95th percentiles, None where more than 5 % never settle."""

    samples: int
    Overshoot_p95: float
    SettlingTime_p95: float | None
    overshoot: np.ndarray = field(repr=False)  # % of each motor
    settling: np.ndarray = field(repr=False)  # s of each motor, infinite where it never settles


@frozen
class Candidate:
    """One way of choosing the gains, and what comes of it."""

    name: str
    controller: AbstractController
    metrics: Mapping[str, float | None]
    load: Mapping[str, float | None]
    second: Mapping[str, float | None]  # of the step from the set point to half of it
    robust: Robustness | None
    stable: bool


@frozen
class Tuning:
    """Gains, how well they do, and how far that is from what is possible."""

    law: Law
    motor: Motor
    task: Task
    max_overshoot: float  # %
    max_settling: float | None  # s
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
        if overshoot is None or settling is None or overshoot > self.max_overshoot:
            return False
        return self.max_settling is None or settling <= self.max_settling


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
    _check(controller, setpoint, load_torque, max_overshoot, delay, speed_noise, spread)
    check_positive(
        voltage_limit=voltage_limit,
        current_limit=current_limit,
        sample_time=sample_time,
        max_settling=max_settling,
        speed_step=speed_step,
        max_sensitivity=max_sensitivity,
    )
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    messages: list[str] = []
    setpoint, voltage_limit = _ask(motor, setpoint, voltage_limit, messages)
    fastest = _possible(motor, setpoint, voltage_limit, current_limit, load_torque, max_settling)
    if sample_time is None:
        sample_time = min(1e-3, _round_number(fastest / 40))
        messages.append(f"no sample time given: {sample_time:g} s")
    if load_torque is None:
        load_torque = spare_torque(motor, setpoint, voltage_limit, current_limit)
    hardware = _arrays(
        Hardware(sample_time, voltage_limit, current_limit, speed_step, delay, measures_current)
    )
    _check_sensor(motor, sample_time)
    samples = _few_lengths(max(2.5 * fastest, fastest + 20 * _dead_time(motor, hardware)), hardware)
    white = jnp.asarray(np.random.default_rng(seed).standard_normal(PARTS * samples))
    task = Task(
        hardware=hardware,
        setpoint=jnp.asarray(setpoint),
        load=jnp.asarray(load_torque),
        limit=jnp.asarray(fastest),
        max_overshoot=jnp.asarray(max(max_overshoot, 0.01)),
        max_sensitivity=None if max_sensitivity is None else jnp.asarray(max_sensitivity),
        noise=speed_noise * white,
        step_samples=samples,
        substeps=steps_in_sample(motor, sample_time),
    )
    motors, judges = _motors(motor, uncertainty, spread, seed)
    stiffness, duration = jnp.asarray(voltage_limit / abs(setpoint)), task.limit
    space = GainSpace(controller, stiffness, duration, hardware.sample_time, motor, task.setpoint)
    if progress:
        progress("tuning from many starts")
    shaken = max(speed_noise, TUNING_NOISE * abs(setpoint)) * white
    noisy = eqx.tree_at(lambda t: t.noise, task, shaken)
    coordinates, _ = tuned(noisy, space, motors, seed, starts)
    if progress:
        progress("judging the loop", fraction=0.8)
    law = Law.of(space.controller(jnp.asarray(coordinates[0])), hardware, motor)
    result = Tuning(
        law=law,
        motor=motor,
        task=task,
        max_overshoot=max_overshoot,
        max_settling=max_settling,
        margins=margins(motor, law),
        candidates=(
            _candidate("tuned", task, motor, law.controller, judges),
            *_rivals(task, motor, controller, judges),
        ),
        response=_simulated(task, motor, law),
        bundle=None if judges is None else np.asarray(_speeds(task, judges, law)),
        seed=seed,
        seconds={"total": time.perf_counter() - begin},
    )
    return attrs.evolve(result, messages=(*messages, *_verdicts(result)))


def judged(tuning: Tuning, spread: float, seed: int) -> Robustness | None:
    """How a tuning does on motors it was not tuned for; see `tune` for `spread`."""
    with jax.enable_x64(True):
        _, judges = _motors(tuning.motor, None, spread, seed)
        task, motor = tuning.task, tuning.motor
        return _candidate("tuned", task, motor, tuning.controller, judges).robust


def _possible(
    motor: Motor,
    setpoint: float,
    voltage_limit: float,
    current_limit: float | None,
    load_torque: float | None,
    max_settling: float | None,
) -> float:
    """The fastest settling there can be, s, once the specification is known to be within what is possible."""
    check_reachable(motor, setpoint, voltage_limit, current_limit, 0.0)
    if load_torque:
        check_reachable(motor, setpoint, voltage_limit, current_limit, load_torque, "--load-torque")
    fastest = fastest_settling(motor, setpoint, voltage_limit, current_limit)
    return check_time(max_settling, fastest, setpoint)


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


def _arrays(hardware: Hardware) -> Hardware:
    """Numbers as arrays, so that other numbers need not be compiled again."""
    return jax.tree.map(lambda x: jnp.asarray(x, float), hardware)


def _ask(
    motor: Motor, setpoint: float | None, voltage_limit: float | None, messages: list[str]
) -> tuple[float, float]:
    """Set point and voltage, from one another where one is missing."""
    if voltage_limit is None:
        voltage_limit = NOMINAL_VOLTAGE
        if setpoint is not None:
            voltage_limit = float(f"{1.25 * abs(float(steady_state(motor, setpoint)[1])):.3g}")
        messages.append(f"no voltage limit given: {voltage_limit:g} V")
    if setpoint is None:
        setpoint = float(f"{0.8 * reach(motor, voltage_limit):.3g}")
        messages.append(f"no set point given: {setpoint:g} rad/s, 80 % of what the voltage reaches")
    return setpoint, voltage_limit


def _check(
    controller: str,
    setpoint: float | None,
    load_torque: float | None,
    max_overshoot: float,
    delay: int,
    speed_noise: float,
    spread: float | None,
) -> None:
    """Refuse what cannot be meant."""
    if controller not in CONTROLLERS:
        raise InputError(
            "--controller",
            f"there is no controller {controller!r}",
            f"Choose of {', '.join(CONTROLLERS)}",
        )
    if setpoint is not None and not (math.isfinite(setpoint) and setpoint != 0):
        raise InputError("--setpoint", f"{setpoint:g} is no speed to go to", "Give it in rad/s")
    if load_torque is not None and not math.isfinite(load_torque):
        raise InputError("--load-torque", f"{load_torque:g} is not a number", "Give it in N m")
    for option, value in {
        "--max-overshoot": max_overshoot,
        "--speed-noise": speed_noise,
        "--spread": 0.0 if spread is None else spread,
    }.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(option, f"{value:g} is not a number from 0 up", "Give it in SI units")
    if delay not in (0, 1):
        raise InputError("--delay", f"{delay} samples are not supported", "Choose 0 or 1")


def _check_sensor(motor: Motor, sample_time: float) -> None:
    """Refuse a speed sensor that is later than the simulated loop can remember."""
    late = motor.speed_delay()
    if late is not None and float(late) > (REMEMBERED - 2) * sample_time:
        raise InputError(
            "--sample-time",
            f"the speed sensor is {float(late):g} s late, more than {REMEMBERED - 2} samples",
            "Choose a longer sample time",
        )


def _round_number(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power:.3g}")


def _dead_time(motor: Motor, hardware: Hardware) -> float:
    """What a loop cannot be faster than by much, s: electrical time constant, hold and delay."""
    return float(motor.L / motor.R) / 4 + (1 + hardware.delay) * float(hardware.sample_time)


def _few_lengths(duration: float, hardware: Hardware) -> int:
    """Samples that cover a duration, rounded up so that few shapes are ever compiled."""
    needed = max(32, math.ceil(duration / float(hardware.sample_time)))
    if needed > 20_000:
        raise InputError(
            "--sample-time",
            f"{float(hardware.sample_time):g} s makes {needed} samples of one step",
            "Choose a longer sample time",
        )
    power = 2 ** math.floor(math.log2(needed))
    return next(n for n in (power, power * 3 // 2, power * 2) if n >= needed)


_score = eqx.filter_jit(score)


@eqx.filter_jit
def _simulated(task: Task, motor: Motor, law: Law) -> Response:
    return closed_loop(motor, law, task.course(), SUBSTEPS * task.substeps)


def _known(metrics) -> dict[str, float | None]:
    """Numbers by name, None for what never happens."""
    values = {name: float(value) for name, value in metrics._asdict().items()}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _candidate(
    name: str, task: Task, motor: Motor, controller: AbstractController, judges: Motor | None
) -> Candidate:
    controller = jax.tree.map(jnp.asarray, controller)
    law = Law.of(controller, task.hardware, motor)
    response = _simulated(task, motor, law)
    step, loaded, second = task.parts(response, SUBSTEPS * task.substeps)
    robust = None
    if judges is not None:
        model = Model.of(motor, task.hardware.sample_time)
        robust = _robustness(_score(task, model, judges, controller))
    found = (
        _known(step_metrics(*step, task.setpoint)),
        _known(load_metrics(*loaded, task.setpoint)),
        _known(step_metrics(*second, LOWER * task.setpoint, task.setpoint)),
    )
    return Candidate(name, controller, *found, robust, margins(motor, law).stable)


def _rivals(task: Task, motor: Motor, kind: str, judges: Motor | None):
    """What the textbook would have chosen."""
    if kind in ("pi", "pid"):
        rule = ziegler_nichols(motor, task.hardware, kind)
        yield _candidate("Ziegler-Nichols", task, motor, rule, judges)


def _robustness(found: Score) -> Robustness:
    settling = np.nan_to_num(np.asarray(found.settling), nan=np.inf)
    overshoot = np.asarray(found.overshoot)
    slow = float(np.quantile(settling, 0.95, method="higher"))
    return Robustness(
        samples=len(settling),
        Overshoot_p95=float(np.quantile(overshoot, 0.95, method="higher")),
        SettlingTime_p95=slow if math.isfinite(slow) else None,
        overshoot=overshoot,
        settling=settling,
    )


@eqx.filter_jit
def _speeds(task: Task, motors: Motor, law: Law):
    def speed(motor):
        return closed_loop(motor, law, task.course(), task.substeps).speed[:: task.substeps]

    return jax.vmap(speed)(motors)


def _verdicts(result: Tuning) -> list[str]:
    """What of the specification is not met, and what is to be minded."""
    messages = []
    overshoot, settling = result.metrics["Overshoot"], result.metrics["SettlingTime"]
    if settling is None:
        messages.append("the loop does not settle: try another controller or a shorter sample time")
    elif result.max_settling is not None and settling > result.max_settling:
        messages.append(
            f"settling takes {settling:.4g} s, longer than the {result.max_settling:g} s asked for"
        )
    if overshoot is not None and overshoot > result.max_overshoot:
        messages.append(
            f"overshoot is {overshoot:.3g} %, above the {result.max_overshoot:g} % asked for"
        )
    peak = result.margins.sensitivity_peak
    if peak is not None and peak > 1.1 * MAX_SENSITIVITY:
        messages.append(f"the loop has thin margins: its sensitivity reaches {peak:.2f}")
    return messages
