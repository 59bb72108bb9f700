"""How long a step may be that resolves what an effect does in a motor: for `AbstractEffect.longer_step`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp

from .base import Scalars

if TYPE_CHECKING:
    from ..motor import Motor

# Radians of the motor's undamped oscillation in which a change of direction is resolved, to 1e-4 of the speed
RESOLVED_ANGLE = 0.1


def step_of_reversals(motor: Motor) -> Scalars:
    """The longest step, s, that resolves how a motor with dry friction or drag changes direction."""
    return RESOLVED_ANGLE * motor.oscillation_time


def step_of_currents(motor: Motor) -> Scalars:
    """The longest step, s, that resolves the current, its changes of sign and its heat: at most L / R, after which the
    heat of a current that dies away is known to 1 %."""
    return jnp.minimum(step_of_reversals(motor), motor.L / motor.R)
