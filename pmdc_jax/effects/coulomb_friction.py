"""Dry friction of constant size."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from .base import AbstractEffect, Grip, ParameterRange, Scalars, State
from .steps import step_of_reversals

if TYPE_CHECKING:
    from ..motor import Motor


class CoulombFriction(AbstractEffect):
    """Coulomb friction: T_f = torque_Nm sign(w) while moving, and |T_f| <= torque_Nm at rest.

    **Fields**: `torque_Nm`, friction torque in N m, >= 0.
    **Excitation needed**: motion in both directions, or several speeds.
    **Source**: Olsson, Astrom, Canudas de Wit, Gafvert, Lischinsky, "Friction models and friction
    compensation", European Journal of Control 4 (1998), doi:10.1016/S0947-3580(98)70113-X, equation (1).
    """

    name: ClassVar = "coulomb_friction"
    label: ClassVar = "Coulomb friction"
    formula: ClassVar = "T_f = T_c sign(w)"
    equation: ClassVar = "mechanical"
    variable: ClassVar = "speed"
    holds: ClassVar = "speed"
    affine: ClassVar = True
    ranges: ClassVar = {"torque_Nm": ParameterRange("N m", 1e-10, 1e5)}

    torque_Nm: Scalars

    def grip(self, state: State) -> Grip:
        del state
        return Grip(self.torque_Nm, self.torque_Nm)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_reversals(motor)


class AsymmetricFriction(AbstractEffect):
    """Coulomb friction that differs with direction: T_f = forward_Nm for w > 0, -backward_Nm for w < 0.

    At rest it takes any value between the two. While the motor turns this is the same torque as
    `coulomb_friction` of half the sum and a `constant_load` of half the difference.

    **Fields**: `forward_Nm`, `backward_Nm`, friction torque in N m in either direction, both >= 0.
    **Excitation needed**: motion in both directions at several speeds.
    **Source**: Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey of models, analysis tools and
    compensation methods for the control of machines with friction", Automatica 30 (1994),
    doi:10.1016/0005-1098(94)90209-7.
    """

    name: ClassVar = "asymmetric_friction"
    label: ClassVar = "Friction that differs with direction"
    formula: ClassVar = "T_f = T_+ for w > 0, -T_- for w < 0"
    equation: ClassVar = "mechanical"
    variable: ClassVar = "speed"
    holds: ClassVar = "speed"
    affine: ClassVar = True
    ranges: ClassVar = {
        "forward_Nm": ParameterRange("N m", 1e-10, 1e5),
        "backward_Nm": ParameterRange("N m", 1e-10, 1e5),
    }

    forward_Nm: Scalars
    backward_Nm: Scalars

    def grip(self, state: State) -> Grip:
        del state
        return Grip(self.backward_Nm, self.forward_Nm)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_reversals(motor)
