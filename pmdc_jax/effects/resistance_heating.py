"""Winding resistance that rises as the winding warms up."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx

from .base import AbstractEffect, ParameterRange, Scalars, State
from .steps import step_of_currents

if TYPE_CHECKING:
    from ..motor import Motor


class ResistanceHeating(AbstractEffect):
    """Heating: R(t) = R (1 + rise(t)), d rise/dt = (rise_per_W R(t) i^2 - rise) / time_constant_s.

    `rise` is the relative rise of the resistance over its value at the temperature of the surroundings, alpha times the
    temperature rise; alpha = 0.00393 / K for copper. A run begins with a cold winding; a fit estimates the initial rise
    of runs that begin with a warm one.

    **Fields**: `rise_per_W`, relative rise per watt of copper loss in steady state, 1/W (alpha times the
    thermal resistance), > 0; `time_constant_s`, thermal time constant of the winding in s, > 0.
    **Excitation needed**: high current for at least a third of the time constant, then low.
    **Source**: Hughes, Drury, "Electric Motors and Drives", 5th edition, section 1.7; IEC 60034-1.
    """

    name: ClassVar = "resistance_heating"
    label: ClassVar = "Heating of the winding"
    formula: ClassVar = "R (1 + rise), tau drise/dt = a R i^2 - rise"
    equation: ClassVar = "electrical"
    needs_current: ClassVar = True
    states: ClassVar = ("resistance_rise",)
    thermal_state: ClassVar = "resistance_rise"
    ranges: ClassVar = {
        "rise_per_W": ParameterRange("1/W", 1e-9, 1e3),
        "time_constant_s": ParameterRange("s", 0.1, 1e4),
    }

    rise_per_W: Scalars
    time_constant_s: Scalars

    def parameters(self, motor: Motor, state: State) -> Motor:
        hot = motor.R * (1 + state.extra["resistance_rise"])
        return eqx.tree_at(lambda m: m.R, motor, hot)

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        del load
        rise = state.extra["resistance_rise"]
        loss = motor.R * state.current**2
        return {"resistance_rise": (self.rise_per_W * loss - rise) * (1 / self.time_constant_s)}

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_currents(motor)
