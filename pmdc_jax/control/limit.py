"""The fastest settling within the voltage and current limits, for any controller."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..compiled import compiled
from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from ..precision import double_precision
from ..simulate.propagator import Propagator, make_propagator
from ..simulate.solver import Input, held_step
from .controllers import Number
from .metrics import BAND
from .steady import steady_state

INSTANTS = 20_000  # of a simulated time-optimal step
DOUBLINGS = 12  # of its duration, after which the band counts as out of reach
DRIVE = Drive()  # the voltage is the input

# State of the motor, whether the voltage is reversed, and whether the speed has turned since
Dash = tuple[State, Bool[Array, ""], Bool[Array, ""]]


@double_precision
def fastest_settling(
    motor: Motor,
    setpoint: float,
    voltage_limit: float,
    current_limit: float | None = None,
    initial: float = 0.0,
    load: float = 0.0,
) -> float | None:
    """The shortest time in which any controller can bring the speed into the 2 % band and keep it there, s.

    The motor is driven towards the set point at the voltage or current limit, whichever binds. If the current would
    then carry the speed beyond the far edge of the band, the drive is fully reversed at the latest moment that keeps
    the speed inside. Bang-bang control with one switch is time-optimal for a motor with two states.

    **Arguments**: `setpoint` and `initial`, rad/s; `voltage_limit`, V, and `current_limit`, A, in either
    direction; `load`, N m, present from the start.

    **Returns**: the time, accurate to about 1e-4 of it, or None where the band is out of reach.

    **Source**: Pontryagin et al., "The Mathematical Theory of Optimal Processes" (1962), section 5.
    """
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    duration = 10 * float(motor.L / motor.R + motor.J * motor.R / (motor.Kt * motor.Kb))
    bounds = jax.tree.map(
        jnp.asarray, (setpoint, voltage_limit, current_limit, float(initial), float(load))
    )
    for _ in range(DOUBLINGS):
        reached = float(_dash(motor, jnp.asarray(duration), jnp.asarray(INSTANTS), *bounds)[0])
        if reached == reached:  # not NaN: repeat with the finest instants
            return _with_one_switch(motor, 1.2 * reached, *bounds)
        duration *= 2
    return None


def _with_one_switch(motor: Motor, duration: float, *bounds: Any) -> float:
    """Settling time (s) with the latest switch to full reverse that keeps the speed within the band."""
    settling, stays = _dash(motor, jnp.asarray(duration), jnp.asarray(INSTANTS), *bounds)
    early, late = 0, INSTANTS
    while not stays and late - early > 1:
        switch = (early + late) // 2
        trial, trial_stays = _dash(motor, jnp.asarray(1.5 * duration), jnp.asarray(switch), *bounds)
        if not trial_stays:
            late = switch
            continue
        early = switch
        if float(trial) == float(trial):
            settling = trial
    return float(settling)


@compiled
def _dash(
    motor: Motor,
    duration: Float[Array, ""],
    switch: Int[Array, ""],
    setpoint: Number,
    voltage_limit: Number,
    current_limit: Number | None,
    initial: Number,
    load: Number,
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Simulate full drive until instant `switch` or the band, then full reverse until the speed turns.

    **Returns**: the time (s) at which the band is reached, NaN if never, and whether the speed stays within its far
    edge.
    """
    step = duration / INSTANTS
    propagator = make_propagator(motor, jnp.asarray(step), DRIVE)
    ahead = jnp.sign(setpoint - initial)
    band = BAND * jnp.abs(setpoint - initial)
    load = jnp.asarray(load, float)

    def instant(carry: Dash, k: Int[Array, ""]) -> tuple[Dash, Scalars]:
        state, braking, turned = carry
        short = ahead * (setpoint - state.speed) - band
        braking = braking | (k >= switch) | (short <= 0)
        voltage = jnp.where(braking, -ahead, ahead) * voltage_limit
        new = _next_state(motor, propagator, state, voltage, current_limit, load)
        turned = turned | (braking & (ahead * (new.speed - state.speed) <= 0))
        # frozen once the speed has turned: what comes later is irrelevant
        state = jax.tree.map(lambda now, then: jnp.where(turned, now, then), state, new)
        return (state, braking, turned), state.speed

    at, _ = steady_state(motor, jnp.asarray(initial, float))
    start = (at, jnp.asarray(False), jnp.asarray(False))
    _, speed = jax.lax.scan(instant, start, jnp.arange(INSTANTS))
    short = ahead * (setpoint - jnp.concatenate([at.speed[None], speed])) - band
    k = jnp.argmax(short <= 0)
    crossing = step * (k - 1 + short[k - 1] / (short[k - 1] - short[k]))
    return jnp.where(jnp.any(short <= 0), crossing, jnp.nan), jnp.min(short) >= -2 * band


def _next_state(
    motor: Motor,
    propagator: Propagator,
    state: State,
    voltage: Float[Array, ""],
    current_limit: Number | None,
    load: Float[Array, ""],
) -> State:
    """The next state under this voltage, reduced where the step would end beyond the current limit."""
    acting = Input(DRIVE, voltage, load)
    flat_out = held_step(motor, propagator, acting, state)
    if current_limit is None:
        return flat_out
    idle = held_step(motor, propagator, acting._replace(value=jnp.zeros_like(voltage)), state)
    gain = flat_out.current - idle.current
    most = jnp.sign(voltage) * current_limit
    share = (most - idle.current) / jnp.where(gain == 0, 1.0, gain)
    applied = voltage * jnp.clip(share, -1.0, 1.0)
    return held_step(motor, propagator, acting._replace(value=applied), state)
