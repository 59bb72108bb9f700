"""What an effect would change in the recorded outputs, to first order, along a free run of the motor.

An effect changes the state in which each sample ends: it *kicks* the motor a little at every sample. The linear motor
propagates the kicks, and their sum is the response: one column of a regression, whose coefficient is the amplitude of
the effect. No measured signal is ever differentiated.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiled import compiled
from ..effects import State
from ..effects.base import Scalars
from ..motor import Motor
from ..simulate import Tape
from ..simulate.propagator import Propagator, grid_propagators, pick_grid, steps_in_sample
from ..simulate.sensing import outputs, reported
from ..simulate.solver import Input, held_step, held_step_and_mean

Signal = Float[Array, "samples blocks"]
Outputs = Float[Array, "samples 2 blocks"]
Columns = Float[Array, "2 blocks columns"]  # at one sample
Extra = dict[str, Scalars]  # states that effects add, by name


class Path(NamedTuple):
    """A free run, sample by sample: current (A) and speed (rad/s), and where dry friction holds the rotor."""

    current: Signal
    speed: Signal
    angle: Signal  # rad, by the turns on the tape, or else by the simulated speed
    held: Bool[Array, "samples blocks"]


@compiled
def path_of(
    seen: Float[Array, "blocks 2 samples"],
    tape: Tape,
    begun: Float[Array, " runs"],
    dry: bool | Array,
) -> Path:
    """The path of free runs.

    **Arguments**: `seen`, simulated current in A and speed in rad/s; `begun`, the angle in rad where each run begins;
    `dry`, whether the motor has friction that can hold the rotor.
    """
    current, speed = seen[:, 0].T, seen[:, 1].T
    drive = jax.tree.map(lambda share: jnp.asarray(share)[tape.grid], tape.drive)
    current = drive.voltage * current + drive.current * jnp.asarray(tape.value).T
    step = jnp.asarray(tape.sample_time)[tape.grid][:, None]
    # the turn in a sample is its mean speed times its length
    ahead = jnp.append(seen[:, 1].reshape(-1)[1:], 0.0).reshape(tape.turn.shape)
    turn = jnp.where(jnp.isnan(tape.turn), (seen[:, 1] + ahead) / 2 * step, tape.turn)
    before = jnp.append(0.0, jnp.cumsum(turn.reshape(-1))[:-1]).reshape(turn.shape)
    first = jnp.searchsorted(jnp.asarray(tape.run), tape.run)
    angle = before - before[first, :1] + begun[tape.run][:, None]
    return Path(current, speed, angle.T, (speed == 0) & dry)


@compiled
def kicks(motor: Motor, bare: Motor, tape: Tape, path: Path) -> Outputs:
    """The difference in current and speed between `motor` and `bare` one sample after each point of the path."""
    after = _one_sample(motor, tape, path)
    without = _one_sample(bare, tape, path)
    return jnp.stack([after.current - without.current, after.speed - without.speed], 1)


@compiled
def sensed(motor: Motor, bare: Motor, tape: Tape, path: Path) -> Outputs:
    """The difference between what the sensors of `motor` and those of `bare` report of the path."""
    return _seen_on(motor, tape, path) - _seen_on(bare, tape, path)


@compiled  # one trace of the bare motor serves all effects
def _seen_on(motor: Motor, tape: Tape, path: Path) -> Outputs:
    """What the motor's sensors report of the path."""
    along, acting = _of_blocks(motor, tape)
    state, steps = _states(motor, tape, path), steps_in_sample(motor, tape)
    mean = None
    if along.mean is not None:
        _, mean = held_step_and_mean(motor, along, acting, state, steps)
    seen = outputs(motor, along, acting, state, steps, mean)
    return _reported_in_time(motor, tape, jnp.moveaxis(seen, 0, 1))


def _reported_in_time(
    motor: Motor, tape: Tape, seen: Float[Array, "samples outputs blocks"]
) -> Outputs:
    """What the motor reports (`reported`) of outputs whose axes are in another order."""
    return reported(motor, tape, seen.transpose(2, 1, 0)).transpose(2, 1, 0)


@compiled
def pushes(motor: Motor, tape: Tape) -> tuple[Outputs, Outputs]:
    """The change of current and speed within one sample by 1 V, and by a torque of 1 N m that opposes motion."""
    along, _ = _of_blocks(motor, tape)
    ones = jnp.ones((tape.value.shape[1], 1, 1))
    assert along.inputs is not None, "an effect would need a step of its own"
    voltage = jnp.asarray(tape.drive.voltage)[tape.grid]
    return ones * along.inputs[:, 0, 0] * voltage, ones * along.inputs[:, 1, 0]


@compiled
def respond(
    motor: Motor,
    tape: Tape,
    path: Path,
    kicks: Float[Array | np.ndarray, "samples 2 blocks columns"],
) -> Float[Array, "samples 2 blocks columns"]:
    """The response of the linear `motor` to the kicks of every column, in current and speed.

    Blocks are simulated side by side from zero; then the state at the end of each is carried on into the next.
    """
    along, _ = _of_blocks(motor, tape)
    whole = along.transition[:, :, 0]

    def step(
        x: Columns,
        sample: tuple[Float[Array | np.ndarray, "2 blocks columns"], Float[Array, " blocks"]],
    ) -> tuple[Columns, Columns]:
        kick, held = sample
        after = jnp.einsum("ijb,jbc->ibc", whole, x) + kick
        # a rotor that sticks keeps no change of speed
        return after.at[1].multiply(1.0 - held[:, None]), x

    stuck = path.held.astype(kicks.dtype)
    zero = jnp.zeros(kicks.shape[1:])
    end, driven = jax.lax.scan(step, zero, (kicks, stuck))
    basis = jnp.broadcast_to(jnp.eye(2)[:, None, :], (2, kicks.shape[2], 2))
    through, free = jax.lax.scan(step, basis, (jnp.zeros((*kicks.shape[:3], 2)), stuck))

    def follow(
        start: Float[Array, "2 columns"],
        block: tuple[Bool[Array, ""], Float[Array, "2 2"], Float[Array, "2 columns"]],
    ) -> tuple[Float[Array, "2 columns"], Float[Array, "2 columns"]]:
        begins, passed, own = block
        start = jnp.where(begins, 0.0, start)
        return passed @ start + own, start

    blocks = (jnp.asarray(tape.begins), through.transpose(1, 0, 2), end.transpose(1, 0, 2))
    starts = jax.lax.scan(follow, jnp.zeros((2, kicks.shape[3])), blocks)[1]
    response = driven + jnp.einsum("sibj,bjc->sibc", free, starts)
    if along.mean is None:
        return response
    # a kick builds up evenly over its sample: half of it is in the mean
    mean = jnp.einsum("jsb,sjbc->sbc", along.mean.transition[1], response) + kicks[:, 1] / 2
    moving = mean * (1.0 - stuck[:, :, None])
    seen = jnp.concatenate([response, moving[:, None]], 1)
    return jax.vmap(partial(_reported_in_time, motor, tape), in_axes=-1, out_axes=-1)(seen)


def _of_blocks(motor: Motor, tape: Tape) -> tuple[Propagator, Input]:
    """The propagator of every block, and the inputs that act there, broadcast to (samples, blocks)."""
    along, drive = pick_grid(grid_propagators(motor, tape), tape, tape.grid)
    samples = tape.value.shape[1]

    def spread(leaf: Float[Array, "blocks ..."]) -> Float[Array, "... samples blocks"]:
        blocks_last = jnp.moveaxis(leaf, 0, -1)[..., None, :]
        return jnp.broadcast_to(
            blocks_last, (*blocks_last.shape[:-2], samples, blocks_last.shape[-1])
        )

    value, load = jnp.asarray(tape.value).T, jnp.asarray(tape.load).T
    rise = None if tape.rise is None else jnp.asarray(tape.rise).T
    return jax.tree.map(spread, along), Input(drive, value, load, rise)


@compiled  # one trace of the bare motor serves all effects
def _one_sample(motor: Motor, tape: Tape, path: Path) -> State:
    along, acting = _of_blocks(motor, tape)
    return held_step(motor, along, acting, _states(motor, tape, path), steps_in_sample(motor, tape))


# Whether a run begins, the effects' initial states, current, speed, value of the drive, load, and index of the block
OfSample = tuple[Bool[Array, ""], Extra, Scalars, Scalars, Scalars, Scalars, Int[Array, ""]]


def _states(motor: Motor, tape: Tape, path: Path) -> State:
    """The motor's states on the path; those that its effects add are simulated along its current and speed."""
    load = jnp.asarray(tape.load).T
    start = motor.initial_state(path.current, path.speed, load, path.angle)
    if not set(motor.states) - {"angle"}:
        return start
    (along, acting), steps = _of_blocks(motor, tape), steps_in_sample(motor, tape)
    begins = jnp.zeros(load.shape, bool).at[0].set(tape.begins)

    def advance(extra: Extra, sample: OfSample) -> tuple[Extra, Extra]:
        begins, rest, current, speed, value, load, block = sample
        extra = jax.tree.map(lambda new, old: jnp.where(begins, new, old), rest, extra)
        here = jax.tree.map(lambda leaf: leaf[..., 0, block], along)
        drive = jax.tree.map(lambda share: share[block], acting.drive)
        state = State(current, speed, extra)
        return held_step(motor, here, Input(drive, value, load), state, steps).extra, extra

    block = jnp.broadcast_to(jnp.arange(load.shape[1]), load.shape)
    samples = (begins, start.extra, path.current, path.speed, acting.value, load, block)
    in_time = jax.tree.map(lambda x: x.T.reshape(-1), samples)
    nothing = jax.tree.map(lambda x: 0.0 * x[0], in_time[1])
    extra = jax.lax.scan(advance, nothing, in_time)[1]
    return start._replace(extra=jax.tree.map(lambda x: x.reshape(load.shape[::-1]).T, extra))
