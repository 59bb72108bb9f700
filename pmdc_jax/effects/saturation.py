"""Effects of high current on the magnetic circuit."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars, State
from .steps import step_of_currents, step_of_reversals

if TYPE_CHECKING:
    from ..motor import Motor


# Share of L / R, at small currents, that a step with a varying inductance may take
RESOLVED_DECAY = 1 / 8


class TorqueConstantSaturation(AbstractEffect):
    """Saturated torque: Kt / (1 + c i^2) in place of Kt.

    Armature reaction weakens the flux under load, and with it the back-EMF, as far as that appears at the brushes.

    **Fields**: `per_A2`, c in 1/A^2, > 0: at a current of 1 / sqrt(c) the torque per ampere is halved; `emf_share`, e,
    between 0 and 1: the relative loss of back-EMF is e times that of torque per ampere.
    **Excitation needed**: high and low torque at known load, or accelerations with high and with low current.
    **Source**: Fitzgerald, Kingsley, Umans, "Electric Machinery", 6th edition, section 7.3 (armature reaction).
    """

    name: ClassVar = "torque_constant_saturation"
    label: ClassVar = "Saturation of the torque constant"
    formula: ClassVar = "T_m = g Kt i, e = (1 - e_s (1 - g)) Kb w, g = 1 / (1 + c i^2)"
    equation: ClassVar = "mechanical"
    needs_current: ClassVar = True
    variable: ClassVar = "current"
    ranges: ClassVar = {
        "per_A2": ParameterRange("1/A^2", 1e-10, 1e4),
        # beyond 0 and 1, because estimates scatter around them
        "emf_share": ParameterRange("", -0.5, 1.5, "linear"),
    }

    per_A2: Scalars
    emf_share: Scalars

    def parameters(self, motor: Motor, state: State) -> Motor:
        flux = 1 / (1 + self.per_A2 * state.current**2)
        constants = motor.Kt * flux, motor.Kb * (1 - self.emf_share * (1 - flux))
        return eqx.tree_at(lambda m: (m.Kt, m.Kb), motor, constants)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_currents(motor)


class InductanceSaturation(AbstractEffect):
    """Saturated inductance: L / (1 + c i^2) in place of L, the differential inductance d flux / di.

    **Fields**: `per_A2`, c in 1/A^2, > 0: at a current of 1 / sqrt(c) the inductance is halved.
    **Excitation needed**: voltage steps from zero and from high current, sampled faster than L / R.
    **Source**: Krishnan, "Permanent Magnet Synchronous and Brushless DC Motor Drives" (2010), section 1.3.
    """

    name: ClassVar = "inductance_saturation"
    label: ClassVar = "Saturation of the inductance"
    formula: ClassVar = "L di/dt = (1 + c i^2) (v - R i - Kb w)"
    equation: ClassVar = "electrical"
    needs_current: ClassVar = True
    variable: ClassVar = "current"
    longest_step: ClassVar = 2.5e-4
    ranges: ClassVar = {"per_A2": ParameterRange("1/A^2", 1e-10, 1e4)}

    per_A2: Scalars

    def parameters(self, motor: Motor, state: State) -> Motor:
        return eqx.tree_at(lambda m: m.L, motor, motor.L * (1 / (1 + self.per_A2 * state.current**2)))

    def longer_step(self, motor: Motor) -> Scalars:
        return jnp.minimum(step_of_reversals(motor), RESOLVED_DECAY * motor.L / motor.R)

    def fastest_rate(self, motor: Motor, current: Scalars) -> Scalars:
        return motor.R * (1 / motor.L) * self.per_A2 * current**2
