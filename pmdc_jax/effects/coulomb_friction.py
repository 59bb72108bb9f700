"""Dry friction of constant size, in both directions the same."""

from __future__ import annotations

from typing import ClassVar

from .base import AbstractEffect, Grip, ParameterRange, Scalars, State


class CoulombFriction(AbstractEffect):
    """Coulomb friction: T_f = torque_Nm sign(w) while moving, and |T_f| <= torque_Nm at rest.

    **Fields**: `torque_Nm`, friction torque in N m, >= 0.
    **Excitation needed**: motion in both directions, or several speeds.
    **Source**: Olsson, Astrom, Canudas de Wit, Gafvert, Lischinsky, "Friction models and friction
    compensation", European Journal of Control 4 (1998), doi:10.1016/S0947-3580(98)70113-X, equation (1).
    """

    name: ClassVar = "coulomb_friction"
    equation: ClassVar = "mechanical"
    holds: ClassVar = "speed"
    ranges: ClassVar = {"torque_Nm": ParameterRange("N m", 1e-7, 1e4)}

    torque_Nm: Scalars

    def grip(self, state: State) -> Grip:
        del state
        return Grip(self.torque_Nm, self.torque_Nm)
