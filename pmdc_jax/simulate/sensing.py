"""Reported outputs of a simulated motor: they may be read some time after the voltage of their sample was applied; a
speed may be delayed by its sensor; either may be a mean over a sample, as differences of angles are."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..effects.base import Scalars, State
from ..motor import Motor
from .propagator import Instant, Propagator, samples_behind
from .solver import Input, held_step_and_mean
from .tape import BLOCK, Tape


def at_instant(
    motor: Motor, instant: Instant, acting: Input, state: State, steps: int | Int[Array, ""] = 1
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
    """Current and speed when a sample is read, and the other values from which `reported` makes delayed or averaged
    ones.

    With a delayed sensor, or a mean that ends later: the speed at the instant it sees, between this sample and the
    next. With averaging: the mean current and speed from this sample to the next, those of the `mean` state. With
    averaging and a speed that is seen within a sample: also the part of its mean that comes from before that instant.
    """
    reading, speed_seen, part_mean = propagator.reading, propagator.speed_seen, None
    if reading is None:
        simulated = [*motor.sensors(state)]
    else:
        there, part_mean = at_instant(motor, reading, acting, state, steps)
        simulated = [*motor.sensors(there)]
    if speed_seen is not None:
        there, part_mean = at_instant(motor, speed_seen, acting, state, steps)
        simulated.append(motor.sensors(there)[1])
    if mean is not None:
        simulated.extend(motor.sensors(mean))
    instant = speed_seen or reading
    if instant is not None and part_mean is not None:
        simulated.append(instant.share * motor.sensors(part_mean)[1])
    return jnp.stack(simulated)


def reports_of(propagator: Propagator) -> int:
    """Number of `outputs`."""
    delayed, averaged = propagator.speed_seen is not None, propagator.mean is not None
    within = delayed or propagator.reading is not None
    return 2 + delayed + 2 * averaged + (averaged and within)


def reported(
    motor: Motor, tape: Tape, simulated: Float[Array, "blocks outputs samples"]
) -> Float[Array, "blocks 2 samples"]:
    """Current and speed from `outputs`, averaged as the tape says, and the speed delayed by the motor's sensor.

    Before the start of a run both are taken to be as at the start.
    """
    delay, reading = motor.speed_delay(), tape.reading
    if delay is None and tape.averaging is None:
        return simulated
    current, speed, *others = (simulated[:, k].reshape(-1) for k in range(simulated.shape[1]))
    first = jnp.repeat(jnp.searchsorted(jnp.asarray(tape.run), tape.run) * BLOCK, BLOCK)
    begun, before = speed[first], jnp.arange(len(speed)) - 1

    def sample(values: Scalars, k: Int[Array, " all"], before: Scalars) -> Float[Array, " all"]:
        return jnp.where(k < first, before, values[jnp.clip(k, 0, len(speed) - 1)])

    last, share = before, None
    delayed = delay is not None or tape.later is not None
    if delayed or reading is not None:
        sample_time = jnp.repeat(tape.block_sample_time, BLOCK)
        later = None if tape.later is None else jnp.repeat(jnp.asarray(tape.later)[tape.grid], BLOCK)
        behind = samples_behind(delay, sample_time, reading, later)
        last = before - jnp.floor(behind).astype(int)
        share = 1 - (behind - jnp.floor(behind))
    if delayed:
        within, *others = others
        speed = sample(within, last, begun)
    if tape.averaging is not None:
        mean_current, mean, *parts = others

        def ending_within(k: Int[Array, " all"]) -> Float[Array, " all"]:
            """The mean over one sample time up to the instant seen within sample k, or up to its end without delay."""
            if share is None:
                return sample(mean, k, begun)
            (part,) = parts
            left = sample(mean - part, k - 1, (1 - share) * begun)
            return left + sample(part, k, share * begun)

        shares = jnp.repeat(jnp.asarray(tape.averaging)[tape.run], BLOCK, axis=0).T
        over_last, over_next, current_over_last = shares
        shift = sample(mean_current, before, current[first]) - current
        current = current + current_over_last * shift
        sampled = (1 - over_last - over_next) * speed
        mean_over_last, mean_over_next = ending_within(last), ending_within(last + 1)
        if tape.span is not None:
            span = jnp.repeat(jnp.asarray(tape.span)[tape.run], BLOCK)
            mean_over_last = _over_span(mean_over_last, span, first, begun)
            mean_over_next = sample(mean_over_last, before + 1 + span, begun)
        speed = sampled + over_last * mean_over_last + over_next * mean_over_next
    return jnp.stack([x.reshape(simulated[:, 0].shape) for x in (current, speed)], 1)


def _over_span(
    means: Float[Array, " all"], span: Int[Array, " all"], first: Int[Array, " all"], begun: Float[Array, " all"]
) -> Float[Array, " all"]:
    """The means over as many samples as `span` says from those over one sample; before the `first` sample of a run
    they are as it had `begun`."""
    total = jnp.append(0.0, jnp.cumsum(means))
    now = jnp.arange(len(means)) + 1
    then = jnp.maximum(now - span, first)
    return (total[now] - total[then] + (span - (now - then)) * begun) / span
