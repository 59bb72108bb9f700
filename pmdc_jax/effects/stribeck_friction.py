"""Dry friction that falls as motion begins."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from .base import AbstractEffect, Grip, ParameterRange, Scalars, State
from .steps import step_of_reversals

if TYPE_CHECKING:
    from ..motor import Motor

# Share of the time in which the fall from static to Coulomb friction would accelerate the motor by `speed_rad_s`
RESOLVED_FALL = 1 / 4


class StribeckFriction(AbstractEffect):
    """Stribeck friction: T_f = (T_c + (T_s - T_c) exp(-(w / w_s)^2)) sign(w), and |T_f| <= T_s at rest.

    **Fields**: `coulomb_Nm`, T_c, friction at speed in N m; `static_Nm`, T_s, break-away torque in N m, usually
    1.1 to 3 T_c; `speed_rad_s`, w_s, over which friction falls from T_s to T_c, in rad/s; all > 0.
    **Excitation needed**: fast levels, and slow motion through standstill in both directions.
    **Source**: Olsson, Astrom, Canudas de Wit, Gafvert, Lischinsky, "Friction models and friction
    compensation", European Journal of Control 4 (1998), doi:10.1016/S0947-3580(98)70113-X, equation (5).
    """

    name: ClassVar = "stribeck_friction"
    label: ClassVar = "Stribeck friction"
    formula: ClassVar = "T_f = (T_c + (T_s - T_c) exp(-(w / w_s)^2)) sign(w)"
    equation: ClassVar = "mechanical"
    variable: ClassVar = "speed"
    holds: ClassVar = "speed"
    ranges: ClassVar = {
        "coulomb_Nm": ParameterRange("N m", 1e-10, 1e5),
        "static_Nm": ParameterRange("N m", 1e-10, 1e5),
        "speed_rad_s": ParameterRange("rad/s", 1e-4, 1e3),
    }

    coulomb_Nm: Scalars
    static_Nm: Scalars
    speed_rad_s: Scalars

    def is_possible(self) -> bool:
        return bool(self.static_Nm >= self.coulomb_Nm)

    def grip(self, state: State) -> Grip:
        slow = jnp.exp(-((state.speed * (1 / self.speed_rad_s)) ** 2))
        torque = self.coulomb_Nm + (self.static_Nm - self.coulomb_Nm) * slow
        return Grip(torque, torque)

    def longer_step(self, motor: Motor) -> Scalars:
        fall = jnp.maximum(self.static_Nm - self.coulomb_Nm, 0.0)
        return 1 / (1 / step_of_reversals(motor) + fall / (RESOLVED_FALL * motor.J * self.speed_rad_s))
