"""Feasibility of a specification within the limits of voltage and current; errors state the limit."""

from __future__ import annotations

import math

from ..errors import InputError
from ..motor import Motor
from .steady import steady_state

BISECTIONS = 20  # in the search for the highest speed: to a millionth of the set point, of which tenths are shown
DEFAULT_LOAD_SHARE = 0.5  # default load step over the load torque that the limits still hold


def check_reachable(
    motor: Motor,
    setpoint: float,
    voltage_limit: float,
    current_limit: float | None,
    load: float,
    option: str = "--setpoint",
) -> None:
    """Raise an `InputError` where the set point cannot be held against the load within the limits."""
    state, voltage = steady_state(motor, setpoint, load)
    current, voltage = abs(float(state.current)), abs(float(voltage))
    against = f" against {load:g} N·m" if load else ""
    lower = "--setpoint or --load-torque" if load else "--setpoint"
    if voltage > voltage_limit:
        highest = _highest_speed(motor, setpoint, voltage_limit, load)
        raise InputError(
            option,
            f"{setpoint:g} rad/s{against} cannot be reached with {voltage_limit:g} V (at most {highest:.1f} rad/s)",
            f"Raise --voltage-limit to more than the {voltage:.2f} V that hold it, or lower {lower}",
        )
    if current_limit is not None and current > current_limit:
        raise InputError(
            option,
            f"holding {setpoint:g} rad/s{against} takes {current:.2f} A, more than the limit of {current_limit:g} A",
            f"Raise --current-limit, or lower {lower}",
        )


def _highest_speed(motor: Motor, setpoint: float, voltage_limit: float, load: float) -> float:
    """The highest speed (rad/s) that the voltage holds; with the motor's effects, by bisection."""
    if not motor.effects:
        return max(0.0, float(motor.steady_speed(voltage_limit, load)))
    low, high = 0.0, abs(setpoint)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        voltage = abs(float(steady_state(motor, math.copysign(middle, setpoint), load)[1]))
        low, high = (middle, high) if voltage <= voltage_limit else (low, middle)
    return low


def check_settling(max_settling: float | None, fastest_settling: float | None, setpoint: float) -> float:
    """The fastest settling; an `InputError` where there is none, or `max_settling` is shorter."""
    if fastest_settling is None:
        raise InputError(
            "--setpoint",
            f"{setpoint:g} rad/s is never reached within the limits",
            "Raise --voltage-limit or --current-limit",
        )
    if max_settling is not None and max_settling < fastest_settling:
        raise InputError(
            "--max-settling",
            f"{max_settling:g} s is less than the fastest settling possible within the limits"
            f" ({fastest_settling:.4f} s)",
            "Allow more time, voltage or current",
        )
    return fastest_settling


def default_load_torque(motor: Motor, setpoint: float, voltage_limit: float, current_limit: float | None) -> float:
    """Half the load torque that the limits still hold at the set point, N m: the default load step."""
    state, voltage = steady_state(motor, setpoint)
    spare_current = (voltage_limit - abs(float(voltage))) / float(motor.R)
    if current_limit is not None:
        spare_current = min(spare_current, current_limit - abs(float(state.current)))
    return math.copysign(DEFAULT_LOAD_SHARE * max(0.0, spare_current) * float(motor.Kt), setpoint)
