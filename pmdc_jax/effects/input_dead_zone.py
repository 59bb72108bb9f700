"""Voltage that is lost in the driver stage."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars


class InputDeadZone(AbstractEffect):
    """Dead zone: the winding gets v - clip(v, -width_V, width_V): zero up to the width, reduced by it above.

    **Fields**: `width_V`, in V, > 0; the dead time of a bridge at 20 kHz causes 0.1 to 1 V at 24 V.
    **Excitation needed**: small and large voltages in both directions.
    **Source**: Tao, Kokotovic, "Adaptive Control of Systems with Actuator and Sensor Nonlinearities" (1996),
    chapter 2.
    """

    name: ClassVar = "input_dead_zone"
    label: ClassVar = "Dead zone of the input"
    formula: ClassVar = "v_m = v - clip(v, -width, width)"
    equation: ClassVar = "input"
    variable: ClassVar = "voltage"
    affine: ClassVar = True
    ranges: ClassVar = {"width_V": ParameterRange("V", 1e-5, 1e3)}

    width_V: Scalars

    def terminal_voltage(self, voltage: Scalars) -> Scalars:
        return voltage - jnp.clip(voltage, -self.width_V, self.width_V)
