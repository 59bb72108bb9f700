"""The fastest settling of any controller within the voltage and current limits: time-optimal, bang-bang control."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from ..runtime.compiled import compiled
from ..runtime.precision import double_precision
from ..simulate.propagator import Propagator, make_propagator
from ..simulate.solver import Input, held_step
from .controllers import Number
from .metrics import BAND
from .steady import steady_state

INSTANTS = 20_000  # of a simulated step
FIRST_DURATION = 10  # of a simulated step, over the motor's transient time
DOUBLINGS = 12  # of its duration, after which the band counts as out of reach
DURATION_MARGIN = 1.2  # duration of the second, finer simulation over the time at which the band was reached
BRAKED_DURATION = 1.5  # duration with a switch to full reverse, over that without: the band is reached later
DRIVE = Drive()  # the voltage is the input


class BangBangStep(NamedTuple):
    """Outcome of a step under full drive and then full reverse: the time (s) at which the speed enters the band, NaN if
    never, and whether it stays within the far edge."""

    entry_time: Float[Array, ""]
    stays: Bool[Array, ""]


class _Progress(NamedTuple):
    """A step under way: state of the motor, whether the drive is reversed, and whether the speed has turned since."""

    state: State
    braking: Bool[Array, ""]
    turned: Bool[Array, ""]


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
    duration = FIRST_DURATION * float(motor.transient_time)
    bounds = jax.tree.map(jnp.asarray, (setpoint, voltage_limit, current_limit, float(initial), float(load)))
    for _ in range(DOUBLINGS):
        entry_time = float(_bang_bang_step(motor, duration, INSTANTS, *bounds).entry_time)
        if not math.isnan(entry_time):
            # again, with the instants as close together as this duration permits
            return _settling_with_one_switch(motor, DURATION_MARGIN * entry_time, *bounds)
        duration *= 2
    return None


def _settling_with_one_switch(motor: Motor, duration: float, *bounds: Any) -> float | None:
    """Settling time (s) with the latest switch to full reverse that keeps the speed within the band; None if every
    switch lets it leave the band or never reach it."""
    unswitched = _bang_bang_step(motor, duration, INSTANTS, *bounds)
    if math.isnan(unswitched.entry_time):
        return None  # only coarse steps overcome the friction
    if unswitched.stays:
        return float(unswitched.entry_time)
    settling = None
    early, late = 0, INSTANTS
    while late - early > 1:
        switch = (early + late) // 2
        trial = _bang_bang_step(motor, BRAKED_DURATION * duration, switch, *bounds)
        if not trial.stays:
            late = switch
            continue
        early = switch
        if not jnp.isnan(trial.entry_time):
            settling = float(trial.entry_time)
    return settling


def _bang_bang_step(motor: Motor, duration: float, switch: int, *bounds: Any) -> BangBangStep:
    # as arrays, so that other values do not cause recompilation
    return _simulate_bang_bang(motor, jnp.asarray(duration), jnp.asarray(switch), *bounds)


@compiled
def _simulate_bang_bang(
    motor: Motor,
    duration: Float[Array, ""],
    switch: Int[Array, ""],
    setpoint: Number,
    voltage_limit: Number,
    current_limit: Number | None,
    initial: Number,
    load: Number,
) -> BangBangStep:
    """Simulate full drive until instant `switch` or the band, then full reverse until the speed turns."""
    step = duration / INSTANTS
    step_matrices = make_propagator(motor, jnp.asarray(step), DRIVE)
    direction = jnp.sign(setpoint - initial)
    band = BAND * jnp.abs(setpoint - initial)
    load = jnp.asarray(load, float)

    def distance_to_band(speed: Scalars) -> Scalars:
        """From the near edge; negative inside the band, below -2 `band` beyond its far edge."""
        return direction * (setpoint - speed) - band

    def instant(before: _Progress, k: Int[Array, ""]) -> tuple[_Progress, Scalars]:
        state, braking, turned = before
        braking = braking | (k >= switch) | (distance_to_band(state.speed) <= 0)
        voltage = jnp.where(braking, -direction, direction) * voltage_limit
        new = _next_state(motor, step_matrices, state, voltage, current_limit, load)
        turned = turned | (braking & (direction * (new.speed - state.speed) <= 0))
        # frozen once the speed has turned: what comes later is irrelevant
        state = jax.tree.map(lambda now, then: jnp.where(turned, now, then), state, new)
        return _Progress(state, braking, turned), state.speed

    at_rest, _ = steady_state(motor, jnp.asarray(initial, float))
    start = _Progress(at_rest, jnp.asarray(False), jnp.asarray(False))
    _, speed = jax.lax.scan(instant, start, jnp.arange(INSTANTS))
    distance = distance_to_band(jnp.concatenate([at_rest.speed[None], speed]))
    k = jnp.argmax(distance <= 0)
    entry_time = step * (k - 1 + distance[k - 1] / (distance[k - 1] - distance[k]))
    return BangBangStep(
        entry_time=jnp.where(jnp.any(distance <= 0), entry_time, jnp.nan), stays=jnp.min(distance) >= -2 * band
    )


def _next_state(
    motor: Motor,
    step_matrices: Propagator,
    state: State,
    voltage: Float[Array, ""],
    current_limit: Number | None,
    load: Float[Array, ""],
) -> State:
    """The next state under this voltage, reduced where the step would end beyond the current limit."""
    full_input = Input(DRIVE, voltage, load)
    full_drive = held_step(motor, step_matrices, full_input, state)
    if current_limit is None:
        return full_drive
    no_input = full_input._replace(value=jnp.zeros_like(voltage))
    no_drive = held_step(motor, step_matrices, no_input, state)
    gain = full_drive.current - no_drive.current
    allowed_current = jnp.sign(voltage) * current_limit
    share = (allowed_current - no_drive.current) / jnp.where(gain == 0, 1.0, gain)
    limited_input = full_input._replace(value=voltage * jnp.clip(share, -1.0, 1.0))
    return held_step(motor, step_matrices, limited_input, state)
