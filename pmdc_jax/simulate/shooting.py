"""Free run of one motor, and its sensitivities: all blocks side by side, joined by multiple shooting.

One motor on a long record is sequential work. Here every block runs at once from a guessed start, together
with the derivatives of its samples and its end by that start; Newton's method then joins the blocks. For a
linear motor one pass is exact; with effects a few are, because a motor forgets how it began.

**Source**: Bock, Plitt, "A multiple shooting algorithm for direct solution of optimal control problems",
IFAC Proceedings 17 (1984), doi:10.1016/S1474-6670(17)61205-9; Chartier, Philippe, Computing 51 (1993),
doi:10.1007/BF02238534 (its use for parallel time integration).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import State
from ..motor import Motor
from .solver import HeldInput, Propagator, Walk, along_grids, held_step, pick_grid, walk
from .tape import BLOCK, Tape

# The last pass corrects to first order what is left, so the joint error is about the square of this.
JOINED = 1e-4

# Columns of the sensitivities for a run's own unknowns: initial current, initial speed, load offset.
LOCAL = 3

Starts = Float[Array, "blocks states"]


class Pass(NamedTuple):
    """All blocks once, from given starts. Derivatives are by the columns: parameters, load offset, start."""

    seen: Float[Array, "samples 2 blocks"]  # current A, speed rad/s
    d_seen: Float[Array, "samples columns 2 blocks"]
    end: Starts
    d_end: Float[Array, "columns blocks states"]


@eqx.filter_jit
def free_run(
    motor: Motor,
    tape: Tape,
    initial: Float[Array, "runs 2"],
    load_offset: Float[Array, " runs"],
) -> Float[Array, "blocks 2 samples"]:
    """Current (A) and speed (rad/s) as the sensors report them, simulated freely from each run's `initial`.

    `load_offset` is a constant load in N m on top of each run's recorded one.
    """
    prepared = (motor, along_grids(motor, tape))
    starts, last = _join(prepared, tape, initial, load_offset)
    shift = _stitch(last, tape, starts, _begins(motor, initial, tape)) - starts
    states = shift.shape[1]
    seen = last.seen + jnp.einsum("sncb,bn->scb", last.d_seen[:, -states:], shift)
    return jnp.moveaxis(seen, -1, 0).transpose(0, 2, 1)


@eqx.filter_jit
def sensitivities(
    assemble: Callable[[Float[Array, " parameters"]], Motor],
    parameters: Float[Array, " parameters"],
    tape: Tape,
    initial: Float[Array, "runs 2"],
    load_offset: Float[Array, " runs"],
) -> tuple[Float[Array, "blocks 2 samples"], Float[Array, "blocks 2 samples columns"]]:
    """Free run, and its derivatives by `parameters` and then by the run's own initial current, initial speed
    and load offset.

    `assemble` makes a motor of the parameters.
    """

    def prepare(parameters):
        motor = assemble(parameters)
        return motor, along_grids(motor, tape)

    count = len(parameters)
    prepared, d_prepared = jax.vmap(
        lambda direction: jax.jvp(prepare, (parameters,), (direction,)), out_axes=(None, 0)
    )(jnp.eye(count))
    motor = prepared[0]
    begins = _begins(motor, initial, tape)
    states = begins.shape[1]
    columns = count + 1 + states
    d_prepared = jax.tree.map(lambda leaf: _pad_columns(leaf, columns), d_prepared)

    # the derivatives by the parameters must be those at the joined starts
    guess, last = _join(prepared, tape, initial, load_offset)
    starts = _stitch(last, tape, guess, begins)
    passed = _pass(prepared, d_prepared, columns, tape, starts, load_offset)
    joined, d_starts = _stitch_tangents(passed, tape, starts, begins, count)

    by_start = passed.d_seen[:, -states:]
    seen = passed.seen + jnp.einsum("sncb,bn->scb", by_start, joined - starts)
    through = jnp.einsum("sncb,bnp->scbp", by_start, d_starts)
    own = jnp.moveaxis(passed.d_seen[:, : count + 1], 1, -1)
    direct = jnp.concatenate(
        [own[..., :count], jnp.zeros((*own.shape[:-1], 2)), own[..., count:]], -1
    )
    return seen.transpose(2, 1, 0), (direct + through).transpose(2, 1, 0, 3)


def _join(prepared, tape: Tape, initial, load_offset) -> tuple[Starts, Pass]:
    """Starts at which every block begins where the one before it ended, and the last pass."""
    motor = prepared[0]
    begins = _begins(motor, initial, tape)
    states = begins.shape[1]
    still = jax.tree.map(lambda leaf: jnp.zeros((states, *leaf.shape)), prepared)

    # where it was measured, a block begins close to what was measured at its first sample
    known = tape.weight[:, :, 0] > 0
    guess = begins.at[:, :2].set(jnp.where(known, tape.measured[:, :, 0], begins[:, :2]))
    guess = jnp.where(jnp.asarray(tape.begins)[:, None], begins, guess)
    # a linear motor is joined exactly by the correction of its one pass; any other block is exact once the
    # one before it is, so this ends however hard the motor
    passes = len(guess) + 1 if motor.effects else 1

    def unjoined(carry):
        _, _, gap, passed = carry
        return (gap > JOINED) & (passed < passes)

    def again(carry):
        starts, _, _, passed = carry
        run = _pass(prepared, still, states, tape, starts, load_offset)
        joined = _stitch(run, tape, starts, begins)
        size = jnp.max(jnp.abs(joined), axis=0) + 1e-6
        # what the last pass started from is kept: its derivatives belong to it
        return joined, (starts, run), jnp.max(jnp.abs(joined - starts) / size), passed + 1

    shapes = jax.eval_shape(again, (guess, None, 0.0, 0))[1]
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    carry = (guess, nothing, jnp.asarray(jnp.inf), jnp.asarray(0))
    return jax.lax.while_loop(unjoined, again, carry)[1]


def _pass(prepared, d_prepared, columns: int, tape: Tape, starts: Starts, load_offset) -> Pass:
    """Run every block from its start, with tangents. The last columns are the starts themselves."""
    motor, grids = prepared
    d_motor, d_grids = d_prepared
    along, drive = pick_grid(grids, tape, tape.grid)
    along = _blocks_last(along, 0)
    d_along = _blocks_last(jax.tree.map(lambda leaf: leaf[:, tape.grid], d_grids), 1)
    states = starts.shape[1]
    offset = load_offset[tape.run]
    d_load = jnp.zeros(columns)
    if columns > states:
        d_load = d_load.at[-1 - states].set(1.0)
    d_load = jnp.broadcast_to(d_load[:, None], (columns, len(starts)))
    value, load = jnp.asarray(tape.value).T, jnp.asarray(tape.load).T + offset

    def advance(carry, k):
        state, d_state = carry.state

        def look_and_step(motor, along, state, load):
            seen = jnp.stack(motor.sensors(state.current, state.speed))
            return held_step(motor, along, drive, state, value[k], load), seen

        (state, seen), (d_state, d_seen) = jax.vmap(
            lambda *tangents: jax.jvp(look_and_step, (motor, along, state, load[k]), tangents),
            out_axes=(None, 0),
        )(d_motor, d_along, d_state, d_load)
        return Walk((state, d_state), (seen, d_seen))

    state = _unpack(motor, starts.T)
    identity = (
        jnp.zeros((columns, states, len(starts)))
        .at[columns - states :]
        .set(jnp.eye(states)[:, :, None])
    )
    d_state = jax.vmap(lambda column: _unpack(motor, column))(identity)
    seen = (jnp.zeros((2, len(starts))), jnp.zeros((columns, 2, len(starts))))
    saveat = diffrax.SaveAt(
        subs=[
            diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: y.seen),
            diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: y.state),
        ]
    )
    (seen, d_seen), (end, d_end) = walk(
        HeldInput(advance), Walk((state, d_state), seen), BLOCK, saveat
    )
    end, d_end = jax.tree.map(lambda leaf: leaf[0], (end, d_end))
    return Pass(seen, d_seen, _pack(end).T, jax.vmap(_pack)(d_end).swapaxes(1, 2))


def _stitch(passed: Pass, tape: Tape, starts: Starts, begins: Starts) -> Starts:
    """Newton's correction: each block starts where the corrected one before it ends."""
    by_start = jnp.moveaxis(passed.d_end[-starts.shape[1] :], 0, -1)

    def follow(end, block):
        begin, first, passed_end, jacobian, start = block
        new = jnp.where(first, begin, end)
        return passed_end + jacobian @ (new - start), new

    blocks = (begins, jnp.asarray(tape.begins), passed.end, by_start, starts)
    return jax.lax.scan(follow, jnp.zeros_like(starts[0]), blocks)[1]


def _stitch_tangents(passed: Pass, tape: Tape, starts: Starts, begins: Starts, count: int):
    """The same, and the derivatives of the starts by parameters, initial current, initial speed, offset."""
    states = starts.shape[1]
    by_column = jnp.moveaxis(passed.d_end, 0, -1)
    by_start, by_own = by_column[..., -states:], by_column[..., : count + 1]
    zero = jnp.zeros((*by_own.shape[:-1], 2))
    by_own = jnp.concatenate([by_own[..., :count], zero, by_own[..., count:]], -1)
    at_begin = jnp.zeros((states, count + LOCAL)).at[0, count].set(1.0).at[1, count + 1].set(1.0)

    def follow(carry, block):
        begin, first, passed_end, jacobian, start, own = block
        new, d_new = jax.tree.map(lambda a, b: jnp.where(first, a, b), (begin, at_begin), carry)
        return (passed_end + jacobian @ (new - start), jacobian @ d_new + own), (new, d_new)

    blocks = (begins, jnp.asarray(tape.begins), passed.end, by_start, starts, by_own)
    return jax.lax.scan(follow, (jnp.zeros_like(starts[0]), jnp.zeros_like(at_begin)), blocks)[1]


def _begins(motor: Motor, initial: Float[Array, "runs 2"], tape: Tape) -> Starts:
    """How the run of each block begins."""
    of_block = jnp.asarray(initial)[tape.run]
    return _pack(motor.rest(of_block[:, 0], of_block[:, 1])).T


def _blocks_last(along: Propagator, axis: int) -> Propagator:
    # a block's step length is a scalar, its matrices have two axes in front of the batch
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis, -1), along)


def _pad_columns(leaf: Float[Array, "parameters ..."], columns: int) -> Float[Array, "columns ..."]:
    return jnp.pad(leaf, [(0, columns - leaf.shape[0])] + [(0, 0)] * (leaf.ndim - 1))


def _pack(state: State) -> Float[Array, "states ..."]:
    extra = [state.extra[name] for name in sorted(state.extra)]
    return jnp.stack([state.current, state.speed, *extra])


def _unpack(motor: Motor, packed: Float[Array, "states ..."]) -> State:
    return State(packed[0], packed[1], dict(zip(motor.states, packed[2:], strict=True)))
