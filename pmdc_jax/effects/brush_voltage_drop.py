"""Contact voltage of brushes on the commutator."""

from __future__ import annotations

from typing import ClassVar

from .base import AbstractEffect, Grip, ParameterRange, Scalars, State


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
