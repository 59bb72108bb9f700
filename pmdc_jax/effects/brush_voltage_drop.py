"""Contact voltage of brushes on the commutator."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from .base import AbstractEffect, Grip, ParameterRange, Scalars, State
from .steps import step_of_currents

if TYPE_CHECKING:
    from ..motor import Motor


class BrushVoltageDrop(AbstractEffect):
    """Brush drop: v_b = voltage_V sign(i) while current flows, and |v_b| <= voltage_V without.

    **Fields**: `voltage_V`, drop of both brushes together in V, >= 0; 0.2 to 3 V is usual.
    **Excitation needed**: current in both directions, or several currents at one speed.
    **Source**: Fitzgerald, Kingsley, Umans, "Electric Machinery", 6th edition, section 7.2 (the brush-contact
    drop of carbon brushes is nearly constant).
    """

    name: ClassVar = "brush_voltage_drop"
    label: ClassVar = "Brush voltage drop"
    formula: ClassVar = "v_b = V_b sign(i)"
    equation: ClassVar = "electrical"
    variable: ClassVar = "current"
    holds: ClassVar = "current"
    affine: ClassVar = True
    ranges: ClassVar = {"voltage_V": ParameterRange("V", 1e-5, 10.0)}

    voltage_V: Scalars

    def grip(self, state: State) -> Grip:
        del state
        return Grip(self.voltage_V, self.voltage_V)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_currents(motor)


class GradualBrushDrop(AbstractEffect):
    """Brush drop that sets in gradually: v_b = voltage_V tanh(i / onset_A), a form of `BrushVoltageDrop`.

    **Fields**: `voltage_V`, drop of both brushes together at large currents in V, >= 0; `onset_A`, current in A at
    which it is three quarters of that, > 0.
    **Excitation needed**: currents in both directions, below the onset and far above it.
    **Source**: a smooth form of the drop in Fitzgerald, Kingsley, Umans (see `BrushVoltageDrop`).
    """

    name: ClassVar = BrushVoltageDrop.name
    label: ClassVar = BrushVoltageDrop.label
    formula: ClassVar = "v_b = V_b tanh(i / i_0)"
    equation: ClassVar = "electrical"
    variable: ClassVar = "current"
    ranges: ClassVar = {**BrushVoltageDrop.ranges, "onset_A": ParameterRange("A", 1e-5, 1e3)}

    voltage_V: Scalars
    onset_A: Scalars

    def voltage_drop(self, state: State) -> Scalars:
        return self.voltage_V * jnp.tanh(state.current / self.onset_A)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_currents(motor)

    def fastest_rate(self, motor: Motor, current: Scalars) -> Scalars:
        del current
        # three times the rate itself: with one step for that, a current through zero is off by 0.9 % of its peak
        return 3 * self.voltage_V / (self.onset_A * motor.L)
