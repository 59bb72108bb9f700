"""All blocks of a tape simulated at once, each from its own start, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..effects.base import State
from ..motor import Drive, Motor
from .propagator import Propagator, pick_grid, steps_in_sample
from .sensing import outputs, reports_of
from .solver import Carry, Input, StepSolver, held_step_and_mean, take_steps
from .tape import BLOCK, Tape

T = TypeVar("T")

Starts = Float[Array, "blocks states"]
Start = Float[Array, " states"]  # of one block
# A motor, and its propagators on the grids of a tape; or their derivatives, with the columns as first axis
MotorOnGrids = tuple[Motor, Propagator]


class Pass(NamedTuple):
    """All blocks simulated once from given starts. Columns of the derivatives: parameters, load offset, start."""

    simulated: Float[Array, "samples outputs blocks"]
    d_simulated: Float[Array, "samples columns outputs blocks"]
    end: Starts
    d_end: Float[Array, "columns blocks states"]


@eqx.filter_jit  # one trace serves `_join_blocks` and other callers with as many columns
def simulate_blocks(
    motor_on_grids: MotorOnGrids,
    d_motor_on_grids: MotorOnGrids,
    columns: int,
    tape: Tape,
    starts: Starts,
    load_offset: Float[Array, " runs"],
) -> Pass:
    """Simulate every block from its start, with derivatives, whose last columns are with respect to the start."""
    motor, d_motor = motor_on_grids[0], d_motor_on_grids[0]
    propagator, d_propagator, drive = _of_blocks(motor_on_grids[1], d_motor_on_grids[1], tape)
    steps = steps_in_sample(motor, tape)
    value, turn = jnp.asarray(tape.value).T, jnp.asarray(tape.turn).T
    load, d_load = jnp.asarray(tape.load).T + load_offset[tape.run], _d_load(columns, starts)
    rise = None if tape.rise is None else jnp.asarray(tape.rise).T

    def advance(carry: Carry, k: Int[Array, ""]) -> Carry:
        state, d_state = carry.state
        rises = None if rise is None else rise[k]

        def observe_and_step(
            motor: Motor, propagator: Propagator, state: State, load: Float[Array, " blocks"]
        ) -> tuple[State, Float[Array, "outputs blocks"]]:
            acting = Input(drive, value[k], load, rises)
            after, mean = held_step_and_mean(motor, propagator, acting, state, steps)
            simulated = outputs(motor, propagator, acting, state, steps, mean)
            return _turned(state, after, turn[k]), simulated

        (state, simulated), (d_state, d_simulated) = value_and_derivatives(
            observe_and_step, (motor, propagator, state, load[k]), (d_motor, d_propagator, d_state, d_load)
        )
        return Carry((state, d_state), (simulated, d_simulated))

    reports = reports_of(propagator)
    nothing_simulated = (jnp.zeros((reports, len(starts))), jnp.zeros((columns, reports, len(starts))))
    start = Carry(_states_with_derivatives(motor, starts, columns), nothing_simulated)
    saveat = diffrax.SaveAt(
        subs=[
            diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: y.output),
            diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: y.state),
        ]
    )
    (simulated, d_simulated), (end, d_end) = take_steps(StepSolver(advance), start, BLOCK, saveat)
    end, d_end = jax.tree.map(lambda leaf: leaf[0], (end, d_end))
    return Pass(simulated, d_simulated, pack(end).T, jax.vmap(pack)(d_end).swapaxes(1, 2))


def _of_blocks(grids: Propagator, d_grids: Propagator, tape: Tape) -> tuple[Propagator, Propagator, Drive]:
    """The propagator of each block, its derivatives, and the drive."""
    # if there is one grid only, all blocks share its matrices: a copy for each would be read at every step
    grid = tape.grid if tape.sample_time.shape[0] > 1 else jnp.zeros(1, int)
    propagator, drive = pick_grid(grids, tape, grid)
    d_propagator = jax.tree.map(lambda leaf: leaf[:, grid], d_grids)

    def blocks_last(propagator: Propagator, axis: int) -> Propagator:
        # as the batch axis, which comes after the two axes of the matrices
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis, -1), propagator)

    return blocks_last(propagator, 0), blocks_last(d_propagator, 1), drive


def _d_load(columns: int, starts: Starts) -> Float[Array, "columns blocks"]:
    """Derivatives of the load: 1 in the column of its offset, if there are more columns than those of the start."""
    blocks, states = starts.shape
    one = jnp.zeros(columns)
    if columns > states:
        one = one.at[-1 - states].set(1.0)
    return jnp.broadcast_to(one[:, None], (columns, blocks))


def _states_with_derivatives(motor: Motor, starts: Starts, columns: int) -> tuple[State, State]:
    """The states at the start of every block, and their derivatives, which are 1 in the last columns."""
    blocks, states = starts.shape
    identity = jnp.zeros((columns, states, blocks))
    identity = identity.at[columns - states :].set(jnp.eye(states)[:, :, None])
    d_state = jax.vmap(lambda column: unpack(motor, column))(identity)
    return unpack(motor, starts.T), d_state


def _turned(before: State, after: State, turn: Float[Array, " blocks"]) -> State:
    """The state after a sample, with the rotor turned by the measured angle `turn` where it is not NaN."""
    if "angle" not in after.extra:
        return after
    followed = before.extra["angle"] + jnp.nan_to_num(turn)
    angle = jnp.where(jnp.isnan(turn), after.extra["angle"], followed)
    return after._replace(extra={**after.extra, "angle": angle})


def value_and_derivatives(
    function: Callable[..., T], primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[T, T]:
    """A function's value, and its derivative along every column of the tangents."""
    return jax.vmap(lambda *tangent: jax.jvp(function, primals, tangent), out_axes=(None, 0))(*tangents)


def pack(state: State) -> Float[Array, "states ..."]:
    """A state as one array: current, speed and the effects' states by name."""
    extra = [state.extra[name] for name in sorted(state.extra)]
    return jnp.stack([state.current, state.speed, *extra])


def unpack(motor: Motor, packed: Float[Array, "states ..."]) -> State:
    """The state that was packed."""
    return State(packed[0], packed[1], dict(zip(motor.states, packed[2:], strict=True)))
