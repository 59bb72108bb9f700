"""Reported outputs of a simulated motor: they may be read some time after the voltage of their sample was applied; a
speed may be delayed by its sensor, or be a mean over a sample, as differences of angles are."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..effects.base import Scalars, State
from ..motor import Motor
from .propagator import Instant, Propagator
from .solver import Input, held_step_and_mean
from .tape import BLOCK, Tape


def at_instant(
    motor: Motor,
    instant: Instant,
    acting: Input,
    state: State,
    steps: int | Int[Array, ""] = 1,
) -> tuple[State, State | None]:
    """The state at an instant within a sample, and its mean up to there, from the state at the start of the sample."""
    within = acting.part(instant.share / 2, instant.share)
    return held_step_and_mean(motor, instant.propagator, within, state, steps)


def outputs(
    motor: Motor,
    propagator: Propagator,
    acting: Input,
    state: State,
    steps: int | Int[Array, ""],
    mean: State | None = None,
) -> Float[Array, "outputs ..."]:
    """Current and speed when a sample is read, and the other values from which `reported` makes a delayed or averaged
    speed.

    With a delayed sensor: the speed at the instant it sees, between this sample and the next. With averaging: the mean
    speed from this sample to the next, that of the `mean` state. With averaging and a speed that is seen within a
    sample: also the part of this mean that comes from before that instant.
    """
    reading, speed_seen, part_mean = propagator.reading, propagator.speed_seen, None
    if reading is None:
        seen = [*motor.sensors(state)]
    else:
        there, part_mean = at_instant(motor, reading, acting, state, steps)
        seen = [*motor.sensors(there)]
    if speed_seen is not None:
        there, part_mean = at_instant(motor, speed_seen, acting, state, steps)
        seen.append(motor.sensors(there)[1])
    if mean is not None:
        seen.append(motor.sensors(mean)[1])
    instant = speed_seen or reading
    if instant is not None and part_mean is not None:
        seen.append(instant.share * motor.sensors(part_mean)[1])
    return jnp.stack(seen)


def reports_of(propagator: Propagator) -> int:
    """Number of `outputs`."""
    delayed, averaged = propagator.speed_seen is not None, propagator.mean is not None
    within = delayed or propagator.reading is not None
    return 2 + delayed + averaged + (averaged and within)


def reported(
    motor: Motor, tape: Tape, seen: Float[Array, "blocks outputs samples"]
) -> Float[Array, "blocks 2 samples"]:
    """Current and speed from `outputs`, with the speed delayed by the motor's sensor and averaged as the tape says.

    Before the start of a run the speed is taken to be that at the start.
    """
    delay, reading = motor.speed_delay(), tape.reading
    if delay is None and tape.averaging is None:
        return seen
    speed, *others = (seen[:, k].reshape(-1) for k in range(1, seen.shape[1]))
    first = jnp.repeat(jnp.searchsorted(jnp.asarray(tape.run), tape.run) * BLOCK, BLOCK)
    begun, last = speed[first], jnp.arange(len(speed)) - 1

    def sample(values: Scalars, k: Int[Array, " all"], before: Scalars) -> Float[Array, " all"]:
        return jnp.where(k < first, before, values[jnp.clip(k, 0, len(speed) - 1)])

    share = None
    if delay is not None or reading is not None:
        sample_time = jnp.repeat(jnp.asarray(tape.sample_time)[tape.grid], BLOCK)
        behind = (0.0 if delay is None else delay) / sample_time
        behind -= 0.0 if reading is None else reading
        last = last - jnp.floor(behind).astype(int)
        share = 1 - (behind - jnp.floor(behind))
    if delay is not None:
        within, *others = others
        speed = sample(within, last, begun)
    if tape.averaging is not None:
        mean, *parts = others

        def ending_within(k: Int[Array, " all"]) -> Float[Array, " all"]:
            """The mean over one sample time up to the instant seen within sample k, or up to its end without delay."""
            if share is None:
                return sample(mean, k, begun)
            (part,) = parts
            left = sample(mean - part, k - 1, (1 - share) * begun)
            return left + sample(part, k, share * begun)

        over_last, over_next = jnp.repeat(jnp.asarray(tape.averaging)[tape.run], BLOCK, axis=0).T
        sampled = (1 - over_last - over_next) * speed
        speed = sampled + over_last * ending_within(last) + over_next * ending_within(last + 1)
    return jnp.stack([seen[:, 0], speed.reshape(seen[:, 0].shape)], 1)
