"""Steady state: the current and voltage that hold a speed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..effects.base import State
from ..motor import Motor
from .controllers import Number

# of Newton's method: many more than its quadratic convergence needs, since a fixed number can be differentiated
NEWTON_STEPS = 20


def steady_state(motor: Motor, speed: Number, load: Number = 0.0) -> tuple[State, Number]:
    """The state in which a speed is held against a load, and the voltage (V) that holds it.

    Linear motor: i from `Motor.steady_current`, v = R i + Kb w. With effects, Newton's method starts from there and
    also solves for the states that they add, so that a winding is at its final temperature.

    **Arguments**: `speed`, rad/s; `load`, N m, opposes positive motion.
    """
    speed = jnp.asarray(speed, float)
    current = motor.steady_current(speed, load)
    voltage = motor.R * current + motor.Kb * speed
    if not motor.effects:
        return State(current, speed, {}), voltage

    def unpacked(unknown: Float[Array, " unknowns"]) -> tuple[State, Float[Array, ""]]:
        current, voltage, *extra = unknown
        return State(current, speed, dict(zip(motor.states, extra, strict=True))), voltage

    def rates(unknown: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        state, voltage = unpacked(unknown)
        moving = (jnp.sign(state.current), jnp.sign(speed))
        rate = motor.derivative(state, voltage, jnp.asarray(load, float), None, moving)
        return jnp.stack([rate.current, rate.speed, *(rate.extra[name] for name in motor.states)])

    def newton(_: Int[Array, ""], unknown: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
        # pseudo-inverse, because a state without equilibrium, such as an angle, makes the Jacobian singular
        return unknown - jnp.linalg.pinv(jax.jacfwd(rates)(unknown)) @ rates(unknown)

    start = jnp.stack([current, voltage, *(jnp.zeros(()) for _ in motor.states)])
    return unpacked(jax.lax.fori_loop(0, NEWTON_STEPS, newton, start))
