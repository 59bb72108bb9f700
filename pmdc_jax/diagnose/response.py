"""What an effect would change in the recorded outputs, to first order, along a free run of the motor.

An effect changes the state at the end of each sample, by a *state increment*. The linear motor propagates these, and
their sum is the response: one column of a regression, whose coefficient is the amplitude of the effect. No measured
signal is ever differentiated.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects import State
from ..effects.base import Scalars
from ..motor import Motor
from ..runtime.compiled import compiled
from ..simulate import Tape
from ..simulate.propagator import Instant, Propagator, grid_propagators, pick_grid, steps_in_sample
from ..simulate.sensing import outputs, reported
from ..simulate.solver import Input, held_step, held_step_and_mean

Outputs = Float[Array, "samples 2 blocks"]
Columns = Float[Array, "2 blocks columns"]  # at one sample
Extra = dict[str, Scalars]  # states that effects add, by name


class Trajectory(NamedTuple):
    """A free run, sample by sample: current (A) and speed (rad/s), and where dry elements hold one of them at zero."""

    current: Float[Array, "samples blocks"]
    speed: Float[Array, "samples blocks"]
    angle: Float[Array, "samples blocks"]  # rad, by the turns on the tape, or else by the simulated speed
    stuck: Bool[Array, "samples blocks"]  # the rotor, by dry friction
    coasting: Bool[Array, "samples blocks"]  # the rotor, without a current, which the brushes block


@compiled
def trajectory_of(
    simulated: Float[Array, "blocks 2 samples"],
    tape: Tape,
    start_angle: Float[Array, " runs"],
    can_stick: bool | Array,
    can_coast: bool | Array,
) -> Trajectory:
    """The trajectory of free runs.

    **Arguments**: `simulated`, current in A and speed in rad/s; `start_angle`, the angle in rad where each run begins;
    `can_stick` and `can_coast`, whether the motor has friction that can hold the rotor, and brushes that can block the
    current.
    """
    current, speed = simulated[:, 0].T, simulated[:, 1].T
    drive = tape.block_drive
    current = jnp.asarray(drive.voltage * current + drive.current * jnp.asarray(tape.value).T)
    step = tape.block_sample_time[:, None]
    # the turn in a sample is its mean speed times its length
    next_speed = jnp.append(simulated[:, 1].reshape(-1)[1:], 0.0).reshape(tape.turn.shape)
    turn = jnp.where(jnp.isnan(tape.turn), (simulated[:, 1] + next_speed) / 2 * step, tape.turn)
    before = jnp.append(0.0, jnp.cumsum(turn.reshape(-1))[:-1]).reshape(turn.shape)
    first = jnp.searchsorted(jnp.asarray(tape.run), tape.run)
    angle = before - before[first, :1] + start_angle[tape.run][:, None]
    coasting = (current == 0) & can_coast & (drive.voltage > 0)
    return Trajectory(current, speed, angle.T, (speed == 0) & can_stick, coasting)


@compiled
def state_increments(motor: Motor, bare: Motor, tape: Tape, trajectory: Trajectory) -> Outputs:
    """The difference in current and speed between `motor` and `bare` one sample after each point of the trajectory."""
    after = _after_one_sample(motor, tape, trajectory)
    without = _after_one_sample(bare, tape, trajectory)
    return jnp.stack([after.current - without.current, after.speed - without.speed], 1)


@compiled
def sensor_changes(motor: Motor, bare: Motor, tape: Tape, trajectory: Trajectory) -> Outputs:
    """The difference between what the sensors of `motor` and those of `bare` report of the trajectory."""
    return _sensor_outputs(motor, tape, trajectory) - _sensor_outputs(bare, tape, trajectory)


@compiled  # one trace of the bare motor serves all effects
def _sensor_outputs(motor: Motor, tape: Tape, trajectory: Trajectory) -> Outputs:
    """What the motor's sensors report of the trajectory."""
    propagator, inputs = _propagator_and_inputs(motor, tape)
    state, steps = _states(motor, tape, trajectory), steps_in_sample(motor, tape)
    mean = None
    if propagator.mean is not None:
        _, mean = held_step_and_mean(motor, propagator, inputs, state, steps)
    simulated = outputs(motor, propagator, inputs, state, steps, mean)
    return _reported_samples_first(motor, tape, jnp.moveaxis(simulated, 0, 1))


def _reported_samples_first(motor: Motor, tape: Tape, simulated: Float[Array, "samples outputs blocks"]) -> Outputs:
    """What the motor reports (`reported`) of outputs whose first axis is the samples."""
    return reported(motor, tape, simulated.transpose(2, 1, 0)).transpose(2, 1, 0)


@compiled
def input_gains(motor: Motor, tape: Tape) -> tuple[Outputs, Outputs]:
    """The change of current and speed within one sample by 1 V, and by a torque of 1 N m that opposes motion."""
    propagator, _ = _propagator_and_inputs(motor, tape)
    ones = jnp.ones((tape.value.shape[1], 1, 1))
    voltage = tape.block_drive.voltage
    return ones * propagator.inputs[:, 0, 0] * voltage, ones * propagator.inputs[:, 1, 0]


@compiled
def respond(
    motor: Motor, tape: Tape, trajectory: Trajectory, increments: Float[Array | np.ndarray, "samples 2 blocks columns"]
) -> Float[Array, "samples 2 blocks columns"]:
    """The response of the linear `motor` to the state increments of every column, in current and speed.

    Blocks are simulated in parallel from zero; then the state at the end of each is carried on into the next.
    """
    propagator, _ = _propagator_and_inputs(motor, tape)
    transition = propagator.transition[:, :, 0]
    slowing = jnp.exp(-motor.f / motor.J * tape.block_sample_time)

    def step(
        x: Columns,
        sample: tuple[Float[Array | np.ndarray, "2 blocks columns"], Float[Array, " blocks"], Float[Array, " blocks"]],
    ) -> tuple[Columns, Columns]:
        increment, moves, conducts = sample
        # written out here and below: XLA multiplies such small matrices slowly
        after = transition[:, 0, :, None] * x[0] + transition[:, 1, :, None] * x[1] + increment
        coasting = slowing[:, None] * x[1] + increment[1]
        # what is held at zero keeps no change
        current = conducts[:, None] * after[0]
        speed = moves[:, None] * jnp.where(conducts[:, None] > 0, after[1], coasting)
        return jnp.stack([current, speed]), x

    moves, conducts = (1.0 - held.astype(increments.dtype) for held in (trajectory.stuck, trajectory.coasting))
    zero = jnp.zeros(increments.shape[1:])
    end, forced = jax.lax.scan(step, zero, (increments, moves, conducts))
    basis = jnp.broadcast_to(jnp.eye(2)[:, None, :], (2, increments.shape[2], 2))
    without = jnp.zeros((*increments.shape[:3], 2))
    free_end, free = jax.lax.scan(step, basis, (without, moves, conducts))

    starts = _starts_of_blocks(tape, free_end, end)
    response = forced + free[..., :1] * starts[:, 0] + free[..., 1:] * starts[:, 1]
    varies = jnp.stack([conducts, moves], 1)[..., None]
    return _reported_response(motor, tape, propagator, response, increments, varies)


def _starts_of_blocks(
    tape: Tape, free: Float[Array, "2 blocks 2"], forced: Float[Array, "2 blocks columns"]
) -> Float[Array, "blocks 2 columns"]:
    """The states at the start of each block: from zero at the start of each run, carried through the blocks.

    **Arguments**: the states at the end of each block, from the unit states (`free`) and from zero with increments.
    """

    def next_block(
        start: Float[Array, "2 columns"], block: tuple[Bool[Array, ""], Float[Array, "2 2"], Float[Array, "2 columns"]]
    ) -> tuple[Float[Array, "2 columns"], Float[Array, "2 columns"]]:
        begins, transition, forced_end = block
        start = jnp.where(begins, 0.0, start)
        return transition @ start + forced_end, start

    blocks = (jnp.asarray(tape.begins), free.transpose(1, 0, 2), forced.transpose(1, 0, 2))
    return jax.lax.scan(next_block, jnp.zeros((2, forced.shape[2])), blocks)[1]


def _reported_response(
    motor: Motor,
    tape: Tape,
    propagator: Propagator,
    at_start: Float[Array, "samples 2 blocks columns"],
    increments: Float[Array | np.ndarray, "samples 2 blocks columns"],
    varies: Float[Array, "samples 2 blocks 1"],
) -> Float[Array, "samples 2 blocks columns"]:
    """The response when the outputs are read, as their sensors report it, from that at the start of each sample.

    **Arguments**: `increments`, each of which builds up evenly over its sample; `varies`, zero where an output is held.
    """
    reading, speed_seen = propagator.reading, propagator.speed_seen

    def share_of(instant: Instant) -> Float[Array, "samples 1 blocks 1"]:
        return jnp.asarray(instant.share)[:, None, :, None]

    def at(instant: Instant) -> Float[Array, "samples 2 blocks columns"]:
        by_start = jnp.einsum("ijsb,sjbc->sibc", instant.propagator.transition, at_start)
        return (by_start + share_of(instant) * increments) * varies

    def mean(within: Propagator, share: Scalars | float) -> Float[Array, "samples 2 blocks columns"]:
        """Over a share of each sample."""
        assert within.mean is not None
        by_start = jnp.einsum("ijsb,sjbc->sibc", within.mean.transition, at_start)
        return (by_start + share / 2 * increments) * varies

    simulated = [at_start if reading is None else at(reading)]  # in the order of `outputs`
    if speed_seen is not None:
        simulated.append(at(speed_seen)[:, 1:])
    if propagator.mean is not None:
        simulated.append(mean(propagator, 1.0))
        if instant := speed_seen or reading:
            share = share_of(instant)
            simulated.append((share * mean(instant.propagator, share))[:, 1:])
    if len(simulated) == 1:
        return simulated[0]
    simulated = jnp.concatenate(simulated, 1)
    report = partial(_reported_samples_first, motor, tape)
    return jax.vmap(report, in_axes=-1, out_axes=-1)(simulated)


def _propagator_and_inputs(motor: Motor, tape: Tape) -> tuple[Propagator, Input]:
    """The propagator of every block, and the inputs that act there, broadcast to (samples, blocks)."""
    propagator, drive = pick_grid(grid_propagators(motor, tape), tape, tape.grid)
    samples = tape.value.shape[1]

    def broadcast(leaf: Float[Array, "blocks ..."]) -> Float[Array, "... samples blocks"]:
        blocks_last = jnp.moveaxis(leaf, 0, -1)[..., None, :]
        return jnp.broadcast_to(blocks_last, (*blocks_last.shape[:-2], samples, blocks_last.shape[-1]))

    value, load = jnp.asarray(tape.value).T, jnp.asarray(tape.load).T
    rise = None if tape.rise is None else jnp.asarray(tape.rise).T
    return jax.tree.map(broadcast, propagator), Input(drive, value, load, rise)


@compiled  # one trace of the bare motor serves all effects
def _after_one_sample(motor: Motor, tape: Tape, trajectory: Trajectory) -> State:
    """The motor's states one sample after each point of the trajectory."""
    propagator, inputs = _propagator_and_inputs(motor, tape)
    states, steps = _states(motor, tape, trajectory), steps_in_sample(motor, tape)
    return held_step(motor, propagator, inputs, states, steps)


# Whether a run begins, the effects' initial states, current, speed, value of the drive, load, and index of the block
OfSample = tuple[Bool[Array, ""], Extra, Scalars, Scalars, Scalars, Scalars, Int[Array, ""]]


def _states(motor: Motor, tape: Tape, trajectory: Trajectory) -> State:
    """The motor's states on the trajectory; those that its effects add are simulated along its current and speed."""
    load = jnp.asarray(tape.load).T
    start = motor.initial_state(trajectory.current, trajectory.speed, load, trajectory.angle)
    if not set(motor.states) - {"angle"}:
        return start
    propagator, inputs = _propagator_and_inputs(motor, tape)
    steps = steps_in_sample(motor, tape)
    begins = jnp.zeros(load.shape, bool).at[0].set(tape.begins)

    def advance(extra: Extra, sample: OfSample) -> tuple[Extra, Extra]:
        begins, initial, current, speed, value, load, block = sample
        extra = jax.tree.map(lambda new, old: jnp.where(begins, new, old), initial, extra)
        block_propagator = jax.tree.map(lambda leaf: leaf[..., 0, block], propagator)
        drive = jax.tree.map(lambda share: share[block], inputs.drive)
        state = State(current, speed, extra)
        return held_step(motor, block_propagator, Input(drive, value, load), state, steps).extra, extra

    block = jnp.broadcast_to(jnp.arange(load.shape[1]), load.shape)
    samples = (begins, start.extra, trajectory.current, trajectory.speed, inputs.value, load, block)
    in_time = jax.tree.map(lambda x: x.T.reshape(-1), samples)
    zero = jax.tree.map(lambda x: 0.0 * x[0], in_time[1])
    extra = jax.lax.scan(advance, zero, in_time)[1]
    return start._replace(extra=jax.tree.map(lambda x: x.reshape(load.shape[::-1]).T, extra))
