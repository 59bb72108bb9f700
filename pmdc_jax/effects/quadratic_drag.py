"""Drag that grows with the square of speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars, State
from .steps import step_of_reversals

if TYPE_CHECKING:
    from ..motor import Motor


class QuadraticDrag(AbstractEffect):
    """Quadratic drag: T_d = c w |w|, as of a fan, a pump, or the air around a fast rotor.

    **Fields**: `drag_Nms2_rad2`, c in N m s^2/rad^2, > 0.
    **Excitation needed**: four speeds or more, the highest several times the lowest.
    **Source**: Fitzgerald, Kingsley, Umans, "Electric Machinery", 6th edition (windage); White, "Fluid
    Mechanics", 7th edition, section 11.3 (torque of a fan goes with the square of its speed).
    """

    name: ClassVar = "quadratic_drag"
    label: ClassVar = "Quadratic drag"
    formula: ClassVar = "T_d = c w |w|"
    equation: ClassVar = "mechanical"
    variable: ClassVar = "speed"
    ranges: ClassVar = {"drag_Nms2_rad2": ParameterRange("N m s^2/rad^2", 1e-18, 1e4)}

    drag_Nms2_rad2: Scalars

    def torque(self, state: State) -> Scalars:
        return self.drag_Nms2_rad2 * state.speed * jnp.abs(state.speed)

    def longer_step(self, motor: Motor) -> Scalars:
        return step_of_reversals(motor)
