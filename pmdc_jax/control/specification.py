"""What a loop is asked to do, on which hardware; what is left open is filled in, what cannot be is refused."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from attrs import frozen

from ..errors import InputError
from ..motor import Motor
from .controllers import CONTROLLERS
from .hardware import Hardware
from .limit import fastest_settling
from .loop import REMEMBERED
from .requirements import check_reachable, check_time, reach, spare_torque
from .steady import steady_state

NOMINAL_VOLTAGE = 24.0
MAX_SENSITIVITY = 2.0
MOST_SAMPLES = 20_000  # of one step
FEW_SAMPLES = 10  # of the fastest settling


@frozen
class Asked:
    """What a user says, None for what is left open. The fields are the arguments of `tune` of the same names.

    **Raises**: `InputError` for what cannot be meant, naming the option.
    """

    controller: str
    setpoint: float | None
    voltage_limit: float | None
    current_limit: float | None
    sample_time: float | None
    max_overshoot: float
    max_settling: float | None
    load_torque: float | None
    delay: int
    speed_step: float | None
    speed_noise: float
    measures_current: bool
    spread: float | None
    max_sensitivity: float | None

    def __attrs_post_init__(self) -> None:
        if self.controller not in CONTROLLERS:
            choice = ", ".join(CONTROLLERS)
            message = f"there is no controller {self.controller!r}"
            raise InputError("--controller", message, f"Choose of {choice}")
        if self.delay not in (0, 1):
            message = f"{self.delay} samples are not supported"
            raise InputError("--delay", message, "Choose 0 or 1")
        _check("setpoint", self.setpoint, "a speed to go to", lambda x: x != 0)
        _check("load_torque", self.load_torque, "a number", lambda x: True)
        for name in ("max_overshoot", "speed_noise", "spread"):
            _check(name, getattr(self, name), "a number from 0 up", lambda x: x >= 0)
        for name in ("voltage_limit", "current_limit", "sample_time", "max_settling", "speed_step"):
            _check(name, getattr(self, name), "a positive number", lambda x: x > 0)
        _check("max_sensitivity", self.max_sensitivity, "a positive number", lambda x: x > 0)

    def completed(self, motor: Motor) -> Specification:
        """The same with nothing left open.

        **Raises**: `InputError` where no controller can meet it, with the limit.
        """
        notes = []
        volts, setpoint = self.voltage_limit, self.setpoint
        if volts is None:
            volts = NOMINAL_VOLTAGE
            if setpoint is not None:
                volts = _three_digits(1.25 * abs(float(steady_state(motor, setpoint)[1])))
            notes.append(f"no voltage limit given: {volts:g} V")
        if setpoint is None:
            setpoint = _three_digits(0.8 * reach(motor, volts))
            notes.append(
                f"no set point given: {setpoint:g} rad/s, 80 % of what the voltage reaches"
            )
        limits = motor, setpoint, volts, self.current_limit
        check_reachable(*limits, 0.0)
        if self.load_torque:
            check_reachable(*limits, self.load_torque, "--load-torque")
        fastest = check_time(self.max_settling, fastest_settling(*limits), setpoint)
        sample_time, better = self.sample_time, min(1e-3, _round_number(fastest / 40))
        if sample_time is None:
            sample_time = better
            notes.append(f"no sample time given: {sample_time:g} s")
        elif sample_time > fastest / FEW_SAMPLES:
            taken = f"{fastest / sample_time:.2g} samples of {sample_time:g} s"
            notes.append(
                f"the fastest settling, {fastest:.3g} s, takes {taken}:"
                f" a sample time of {better:g} s would lose less"
            )
        _check_sensor(motor, sample_time)
        return Specification(
            asked=self,
            setpoint=setpoint,
            voltage_limit=volts,
            sample_time=sample_time,
            load_torque=spare_torque(*limits) if self.load_torque is None else self.load_torque,
            fastest=fastest,
            samples=_samples(motor, fastest, sample_time, self.delay),
            notes=tuple(notes),
        )


@frozen
class Specification:
    """What a loop is to do: as asked, and what stands for what was left open.

    **Fields**: `setpoint`, rad/s; `voltage_limit`, V; `sample_time`, s; `load_torque`, N m; `fastest`, the shortest
    settling time within the limits, s; `samples` of each part of the task; `notes`, what was chosen, in words.
    """

    asked: Asked
    setpoint: float
    voltage_limit: float
    sample_time: float
    load_torque: float
    fastest: float
    samples: int
    notes: tuple[str, ...]

    def hardware(self) -> Hardware:
        """What the loop runs on. Numbers are arrays, so that other numbers need not be compiled again."""
        asked = self.asked
        hardware = Hardware(
            self.sample_time,
            self.voltage_limit,
            asked.current_limit,
            asked.speed_step,
            asked.delay,
            asked.measures_current,
        )
        return jax.tree.map(lambda x: jnp.asarray(x, float), hardware)


def _check(name: str, value: float | None, wanted: str, is_right: Callable[[float], bool]) -> None:
    if value is not None and not (math.isfinite(value) and is_right(value)):
        option = "--" + name.replace("_", "-")
        raise InputError(option, f"{value:g} is not {wanted}", "Give it in SI units")


def _samples(motor: Motor, fastest: float, sample_time: float, delay: int) -> int:
    """How many show one step, rounded up so that few shapes are ever compiled."""
    # what no loop is much faster than: electrical time constant, hold and delay
    dead = float(motor.L / motor.R) / 4 + (1 + delay) * sample_time
    needed = max(32, math.ceil(max(2.5 * fastest, fastest + 20 * dead) / sample_time))
    if needed > MOST_SAMPLES:
        raise InputError(
            "--sample-time",
            f"{sample_time:g} s makes {needed} samples of one step",
            "Choose a longer sample time",
        )
    power = 2 ** math.floor(math.log2(needed))
    return next(n for n in (power, power * 3 // 2, power * 2) if n >= needed)


def _check_sensor(motor: Motor, sample_time: float) -> None:
    """Refuse a speed sensor that is later than the simulated loop can remember."""
    late = motor.speed_delay()
    if late is not None and float(late) > (REMEMBERED - 2) * sample_time:
        raise InputError(
            "--sample-time",
            f"the speed sensor is {float(late):g} s late, more than {REMEMBERED - 2} samples",
            "Choose a longer sample time",
        )


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _round_number(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above."""
    power = 10.0 ** math.floor(math.log10(value))
    return _three_digits(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)
