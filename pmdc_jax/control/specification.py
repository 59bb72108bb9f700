"""What a user asks of a loop, and the task of it: defaults for what is left open, errors for what is impossible."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from attrs import frozen

from ..effects import GearBacklash, ShaftCompliance
from ..errors import InputError
from ..motor import Motor
from ..simulate.propagator import steps_within
from .controllers import CONTROLLERS
from .feasibility import check_reachable, check_settling, default_load_torque
from .hardware import Hardware
from .loop import REMEMBERED_SAMPLES
from .objective import PART_COUNT, SECOND_SETPOINT, Task
from .steady import steady_state
from .time_optimal import fastest_settling

NOMINAL_VOLTAGE = 24.0  # V, voltage limit if neither it nor the set point is given
VOLTAGE_RESERVE = 1.25  # default voltage limit over the voltage that holds the set point
SETPOINT_SHARE = 0.8  # default set point over the speed that the voltage limit reaches
MAX_SENSITIVITY = 2.0  # default limit of the peak sensitivity
MAX_DEFAULT_SAMPLE_TIME = 1e-3  # s
SAMPLES_PER_SETTLING = 40  # least number of default sample times in the fastest settling
SUFFICIENT_SAMPLES = 10  # in the fastest settling; with fewer the loop loses much performance
MAX_SAMPLE_TIME_RATIO = 10  # sample time over the transients, above which it must be a mistake
NO_OVERSHOOT = 0.01  # %; less is none
# Dead times of a loop in the shortest settling that it can have
LOOP_DEAD_TIMES = 4
# ... and periods of a shaft's resonance
RESONANCES_TO_SETTLE = 0.5
# Duration of each part of the task: at least 2.5 times the fastest settling, and at least the fastest settling plus 20
# dead times of the loop, and plus two periods of a torque that depends on the angle, at half the set point, and plus
# five of a shaft's resonance
PART_SETTLINGS = 2.5
PART_DEAD_TIMES = 20
PART_TORQUE_PERIODS = 2
PART_RESONANCES = 5
ROUNDING = 1e-9  # relative, within which a number counts as round
MIN_SAMPLES = 32  # in each part of the task
MAX_SAMPLES = 20_000  # in each part of the task


@frozen
class LoopRequirements:
    """What a user asks of a loop; None leaves a value open. Fields are the arguments of `tune` of the same names.

    **Raises**: `InputError`, naming the option, for an invalid value.
    """

    controller: str = "pid"
    setpoint: float | None = None
    voltage_limit: float | None = None
    current_limit: float | None = None
    sample_time: float | None = None
    max_overshoot: float = 1.0
    max_settling: float | None = None
    load_torque: float | None = None
    delay: int = 1
    speed_step: float | None = None
    speed_noise: float | None = None
    recorded_noise: float | None = None
    measures_current: bool = True
    spread: float | None = None
    max_sensitivity: float | None = MAX_SENSITIVITY

    def __attrs_post_init__(self) -> None:
        if self.controller not in CONTROLLERS:
            choice = ", ".join(CONTROLLERS)
            message = f"unknown controller {self.controller!r}"
            raise InputError("--controller", message, f"Choose from {choice}")
        if self.delay not in (0, 1):
            message = f"a delay of {self.delay} samples is not supported"
            raise InputError("--delay", message, "Choose 0 or 1")
        _check_number("setpoint", self.setpoint, "a nonzero speed", lambda x: x != 0)
        _check_number("load_torque", self.load_torque, "a number", lambda x: True)
        for name in ("max_overshoot", "speed_noise", "recorded_noise"):
            _check_number(name, getattr(self, name), "a number of at least 0", lambda x: x >= 0)
        if self.spread is not None and not 0 <= self.spread <= 1:
            message = f"a spread of {100 * self.spread:g} % is not between 0 and 100 %"
            raise InputError("--spread", message, "Give the standard deviation of each parameter")
        for name in ("voltage_limit", "current_limit", "sample_time", "max_settling", "speed_step"):
            _check_number(name, getattr(self, name), "a positive number", lambda x: x > 0)
        _check_number("max_sensitivity", self.max_sensitivity, "a positive number", lambda x: x > 0)

    @property
    def sensor_noise(self) -> float:
        """Noise of the speed sensor, rad/s: as stated, else as recorded, else none."""
        stated = self.recorded_noise if self.speed_noise is None else self.speed_noise
        return stated or 0.0

    @property
    def allowed_overshoot(self) -> float:
        """Largest overshoot, %, that counts as none if none is wanted."""
        return max(self.max_overshoot, NO_OVERSHOOT)

    def task(self, motor: Motor) -> tuple[Task, list[str]]:
        """The task for a motor, without noise, with defaults for what is left open, and notes on these. Its numbers are
        arrays, so that other values do not cause recompilation.

        **Raises**: `InputError`, stating the limit, where no controller can meet it.
        """
        setpoint, voltage_limit, limit_notes = self._operating_point(motor)
        operation = motor, setpoint, voltage_limit, self.current_limit
        check_reachable(*operation, 0.0)
        if self.load_torque:
            check_reachable(*operation, self.load_torque, "--load-torque")
        fastest = check_settling(self.max_settling, fastest_settling(*operation), setpoint)
        sample_time, sampling_notes = self._sampling(motor, fastest)
        _check_sensor(motor, sample_time)
        dead_time = _dead_time(motor, sample_time, self.delay)
        stall_current = voltage_limit / float(motor.R)
        max_current = min(stall_current, self.current_limit or stall_current)
        resonance = _resonance_period(motor)
        part_samples = _part_samples(fastest, dead_time, _torque_period(motor, setpoint), resonance, sample_time)
        task = Task(
            hardware=Hardware(
                sample_time, voltage_limit, self.current_limit, self.speed_step, self.delay, self.measures_current
            ),
            setpoint=setpoint,
            load=default_load_torque(*operation) if self.load_torque is None else self.load_torque,
            fastest_settling=fastest,
            settling_scale=max(fastest, LOOP_DEAD_TIMES * dead_time, RESONANCES_TO_SETTLE * resonance),
            max_overshoot=self.allowed_overshoot,
            max_sensitivity=self.max_sensitivity,
            noise=jnp.zeros(PART_COUNT * part_samples),
            part_samples=part_samples,
            substeps=int(steps_within(motor, jnp.asarray(sample_time), jnp.asarray(max_current), sample_time)),
        )
        return jax.tree.map(lambda x: jnp.asarray(x, float), task), [*limit_notes, *sampling_notes]

    def _operating_point(self, motor: Motor) -> tuple[float, float, list[str]]:
        """Set point (rad/s), voltage limit (V), and a note on each that is a default."""
        notes = []
        voltage_limit, setpoint = self.voltage_limit, self.setpoint
        if voltage_limit is None:
            voltage_limit = NOMINAL_VOLTAGE
            if setpoint is not None:
                holding_voltage = abs(float(steady_state(motor, setpoint)[1]))
                voltage_limit = _three_digits(VOLTAGE_RESERVE * holding_voltage)
            notes.append(f"no voltage limit given: using {voltage_limit:g} V")
        if setpoint is None:
            setpoint = _three_digits(SETPOINT_SHARE * float(motor.steady_speed(voltage_limit)))
            notes.append(
                f"no set point given: using {setpoint:g} rad/s, {100 * SETPOINT_SHARE:g} % of the largest speed"
            )
        return setpoint, voltage_limit, notes

    def _sampling(self, motor: Motor, fastest: float) -> tuple[float, list[str]]:
        """Sample time (s) for a fastest settling of `fastest` (s), and a note if it is a default or rather long."""
        # a tiny step may be over within a fraction of the motor's own time constants
        transient = max(fastest, float(motor.transient_time))
        suitable = min(MAX_DEFAULT_SAMPLE_TIME, _rounded_down(transient / SAMPLES_PER_SETTLING))
        if self.sample_time is None:
            return suitable, [f"no sample time given: using {suitable:g} s"]
        if self.sample_time <= fastest / SUFFICIENT_SAMPLES:
            return self.sample_time, []
        if self.sample_time > MAX_SAMPLE_TIME_RATIO * transient:
            raise InputError(
                "--sample-time",
                f"{self.sample_time:g} s is far longer than the motor's transients, {transient:.3g} s:"
                " they are over within one sample",
                f"The unit is seconds; {suitable:g} suits this motor",
            )
        samples = f"{fastest / self.sample_time:.2g} samples of {self.sample_time:g} s"
        remark = f"the fastest settling, {fastest:.3g} s, takes {samples}"
        if suitable < self.sample_time:
            remark += f": a sample time of {suitable:g} s would perform better"
        return self.sample_time, [remark]


def _check_number(name: str, value: float | None, wanted: str, is_valid: Callable[[float], bool]) -> None:
    if value is not None and not (math.isfinite(value) and is_valid(value)):
        option = "--" + name.replace("_", "-")
        raise InputError(option, f"{value:g} is not {wanted}", "Give it in SI units")


def _dead_time(motor: Motor, sample_time: float, delay: int) -> float:
    """The hold of a loop, its delay, that of the speed sensor and a quarter of the electrical time constant together,
    s: no loop is much faster."""
    of_sensor = motor.speed_delay()
    sensed = 0.0 if of_sensor is None else float(of_sensor)
    return float(motor.L / motor.R) / 4 + (1 + delay) * sample_time + sensed


def _torque_period(motor: Motor, setpoint: float) -> float:
    """The longest period, s, of a torque that depends on the angle, at half the set point; zero without one."""
    angles = [float(e.repeats_after().get("angle", 0.0)) for e in motor.effects]
    return max(angles, default=0.0) / (SECOND_SETPOINT * abs(setpoint))


def _resonance_period(motor: Motor) -> float:
    """The longest period, s, of a resonance of shaft or gear; zero without one."""
    shafts = (e for e in motor.effects if isinstance(e, ShaftCompliance | GearBacklash))
    return max((2 * math.pi / float(shaft.natural_frequency(motor)) for shaft in shafts), default=0.0)


def _part_samples(fastest: float, dead_time: float, torque_period: float, resonance: float, sample_time: float) -> int:
    """Samples in one part of the task, rounded up to 2^k or 1.5 2^k so that few shapes are compiled."""
    more = max(PART_DEAD_TIMES * dead_time, PART_TORQUE_PERIODS * torque_period, PART_RESONANCES * resonance)
    duration = max(PART_SETTLINGS * fastest, fastest + more)
    needed = max(MIN_SAMPLES, math.ceil(duration / sample_time))
    if needed > MAX_SAMPLES:
        raise InputError(
            "--sample-time", f"{sample_time:g} s needs {needed} samples for one step", "Choose a longer sample time"
        )
    power = 2 ** math.floor(math.log2(needed))
    return next(n for n in (power, power * 3 // 2, power * 2) if n >= needed)


def _check_sensor(motor: Motor, sample_time: float) -> None:
    """Raise an `InputError` if the speed sensor's delay is longer than the simulated loop remembers."""
    delay = motor.speed_delay()
    if delay is not None and float(delay) > (REMEMBERED_SAMPLES - 2) * sample_time:
        raise InputError(
            "--sample-time",
            f"the speed sensor has a delay of {float(delay):g} s, more than {REMEMBERED_SAMPLES - 2} samples",
            "Choose a longer sample time",
        )


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _rounded_down(value: float) -> float:
    """Largest of 1, 2 or 5 times a power of ten that does not exceed `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return _three_digits(max(m for m in (1, 2, 5) if m * power <= value * (1 + ROUNDING)) * power)
