"""Free run of one motor and its sensitivities by multiple shooting: all blocks in parallel, then joined.

Simulating one motor over a long record is sequential work. Here all blocks run at once from guessed starts, together
with the derivatives of their samples and ends with respect to those starts; Newton's method then joins the blocks. One
pass is exact for a linear motor; with effects a few suffice, because the influence of a start decays.

**Source**: Bock, Plitt, "A multiple shooting algorithm for direct solution of optimal control problems",
IFAC Proceedings 17 (1984), doi:10.1016/S1474-6670(17)61205-9; Chartier, Philippe, Computing 51 (1993),
doi:10.1007/BF02238534 (its use for parallel time integration).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..motor import Motor
from ..runtime.compiled import compiled
from .blocks import MotorOnGrids, Pass, Start, Starts, pack, simulate_blocks, value_and_derivatives
from .propagator import grid_propagators
from .sensing import reported
from .tape import Tape

T = TypeVar("T")

# Relative gap between blocks below which no further pass follows. The last pass still corrects the gap to first order,
# so the remaining error is about the square of this.
MAX_RELATIVE_GAP = 1e-4

# Passes after which a fit gives up on a motor. Where teeth rattle in their play, the end of a block depends chaotically
# on its start: joining takes as many passes as a run has blocks, and the derivatives are of no use.
MAX_PASSES = 32


class RunUnknowns(NamedTuple):
    """Unknowns of each run: its initial state, and a constant load on top of the recorded one."""

    current: Float[Array, " runs"]  # A
    speed: Float[Array, " runs"]  # rad/s
    load_offset: Float[Array, " runs"]  # N m
    angle: Float[Array, " runs"]  # of the rotor, rad; used only by effects that depend on it
    twist: Float[Array, " runs"]  # of a spring, beyond that due to the load, rad
    resistance_rise: Float[Array, " runs"]  # of a winding that is still warm, relative

    @classmethod
    def as_recorded(cls, tape: Tape) -> RunUnknowns:
        """The values on the tape, with no load besides the recorded one, no additional twist and a cold winding."""
        current, speed = jnp.asarray(tape.initial).T
        none = jnp.zeros_like(current)
        return cls(current, speed, none, jnp.asarray(tape.angle), none, none)


# Columns of the sensitivities for the unknowns of a run
UNKNOWNS_PER_RUN = len(RunUnknowns._fields)


@compiled
def free_run(motor: Motor, tape: Tape, run_unknowns: RunUnknowns | None = None) -> Float[Array, "blocks 2 samples"]:
    """Current (A) and speed (rad/s) as the sensors report them, simulated freely.

    `run_unknowns`, the unknowns of each run, is by default as recorded.
    """
    run_unknowns = run_unknowns or RunUnknowns.as_recorded(tape)
    motor_on_grids = (motor, grid_propagators(motor, tape))
    initial = _initial_states(motor, run_unknowns, tape)
    states = initial.shape[1]
    guess = _guessed_starts(motor, run_unknowns, tape, initial)
    constant = _zero_derivatives(motor_on_grids, states)
    starts, joined, last, *_ = _join_blocks(motor_on_grids, constant, tape, run_unknowns, initial, guess)
    simulated = last.simulated + jnp.einsum("sncb,bn->scb", last.d_simulated[:, -states:], joined - starts)
    return reported(motor, tape, simulated.transpose(2, 1, 0))


class Sensitivities(NamedTuple):
    """A free run and its derivatives with respect to the parameters, and then to the unknowns of its own run."""

    simulated: Float[Array, "blocks 2 samples"]  # current A and speed rad/s, as reported
    d_simulated: Float[Array, "blocks 2 samples columns"]
    starts: Starts  # of the blocks
    d_starts: Float[Array, "blocks states columns"]


@eqx.filter_jit
def sensitivities(
    assemble: Callable[[Float[Array, " parameters"]], Motor],
    parameters: Float[Array, " parameters"],
    tape: Tape,
    run_unknowns: RunUnknowns | None = None,
    starts: Starts | Float[np.ndarray, "blocks states"] | None = None,
) -> Sensitivities:
    """Free run, and its derivatives with respect to `parameters` and then to the unknowns of the sample's own run.

    `assemble` makes a motor from the parameters; `starts` of the blocks, as far as they are about known, else NaN; the
    rest is as in `free_run`. The free run is NaN if `MAX_PASSES` passes do not join the blocks, as for a motor that
    depends chaotically on its initial state; its derivatives then say nothing.
    """
    run_unknowns = run_unknowns or RunUnknowns.as_recorded(tape)
    count = len(parameters)

    def prepare(parameters: Float[Array, " parameters"]) -> MotorOnGrids:
        motor = assemble(parameters)
        return motor, grid_propagators(motor, tape)

    motor_on_grids, d_motor_on_grids = value_and_derivatives(prepare, (parameters,), (jnp.eye(count),))
    motor, d_motor = motor_on_grids[0], _pad_columns(d_motor_on_grids[0], count + UNKNOWNS_PER_RUN)
    initial, d_initial = _initial_states_with_derivatives(motor, d_motor, run_unknowns, tape, count)
    states = initial.shape[1]
    # the parameters, the load offset and the start of the block
    d_motor_on_grids = _pad_columns(d_motor_on_grids, count + 1 + states)

    guess = _guessed_starts(motor, run_unknowns, tape, initial)
    if starts is not None:
        guess = jnp.where(jnp.isnan(starts), guess, starts)
    if not motor.effects or motor.gear:
        # passes with the columns of the start only, where one is enough or many are needed
        constant, passes = _zero_derivatives(motor_on_grids, states), MAX_PASSES if motor.effects else 1
        guess = _join_blocks(motor_on_grids, constant, tape, run_unknowns, initial, guess, passes).joined
    # otherwise every pass has all columns, because a pass with other columns is compiled anew
    starts, _, passed, *_ = _join_blocks(
        motor_on_grids, d_motor_on_grids, tape, run_unknowns, initial, guess, MAX_PASSES
    )
    joined, d_starts = _newton_correction_with_derivatives(passed, tape, starts, initial, d_initial, count)
    simulated, d_simulated = _joined_outputs_with_derivatives(passed, joined - starts, d_starts, count)
    if motor.speed_delay() is not None or tape.averaging is not None:
        simulated, d_simulated = value_and_derivatives(
            lambda motor, simulated: reported(motor, tape, simulated),
            (motor, simulated),
            (d_motor, jnp.moveaxis(d_simulated, -1, 0)),
        )
        d_simulated = jnp.moveaxis(d_simulated, 0, -1)
    return Sensitivities(simulated, d_simulated, joined, d_starts)


def _initial_states_with_derivatives(
    motor: Motor, d_motor: Motor, run_unknowns: RunUnknowns, tape: Tape, count: int
) -> tuple[Starts, Float[Array, "columns blocks states"]]:
    """Initial state of the run of each block, and its derivatives with respect to all columns."""
    columns = count + UNKNOWNS_PER_RUN
    ones = jnp.eye(UNKNOWNS_PER_RUN, columns, count)[:, :, None]
    d_own = RunUnknowns(*(jnp.broadcast_to(one, (columns, tape.runs)) for one in ones))
    return value_and_derivatives(
        lambda motor, unknowns: _initial_states(motor, unknowns, tape), (motor, run_unknowns), (d_motor, d_own)
    )


def _joined_outputs_with_derivatives(
    passed: Pass, change: Starts, d_starts: Float[Array, "blocks states columns"], count: int
) -> tuple[Float[Array, "blocks outputs samples"], Float[Array, "blocks outputs samples columns"]]:
    """The outputs of a pass after a change of its starts, to first order, and their derivatives with respect to all
    columns."""
    by_start = passed.d_simulated[:, -change.shape[1] :]
    simulated = passed.simulated + jnp.einsum("sncb,bn->scb", by_start, change)
    through = jnp.einsum("sncb,bnp->scbp", by_start, d_starts)
    direct = _in_all_columns(jnp.moveaxis(passed.d_simulated[:, : count + 1], 1, -1), count)
    return simulated.transpose(2, 1, 0), (direct + through).transpose(2, 1, 0, 3)


def _in_all_columns(own: Float[Array, "... own"], count: int) -> Float[Array, "... columns"]:
    """Derivatives with respect to parameters and load offset, padded with zeros to all columns."""
    none = jnp.zeros((*own.shape[:-1], 1))
    of_run = RunUnknowns(*[none] * UNKNOWNS_PER_RUN)._replace(load_offset=own[..., count:])
    return jnp.concatenate([own[..., :count], *of_run], -1)


def _initial_states(motor: Motor, run_unknowns: RunUnknowns, tape: Tape) -> Starts:
    """Initial state of the run of each block."""
    first = jnp.searchsorted(jnp.asarray(tape.run), jnp.arange(tape.runs))
    load = jnp.asarray(tape.load)[first, 0] + run_unknowns.load_offset
    state = motor.initial_state(run_unknowns.current, run_unknowns.speed, load, run_unknowns.angle)
    extra = dict(state.extra)
    for effect in motor.effects:
        if effect.spring_state:
            extra[effect.spring_state] += run_unknowns.twist
        if effect.thermal_state:
            extra[effect.thermal_state] += run_unknowns.resistance_rise
    return pack(state._replace(extra=extra)).T[tape.run]


def _guessed_starts(motor: Motor, run_unknowns: RunUnknowns, tape: Tape, initial: Starts) -> Starts:
    """Guessed starts of the blocks: current and speed as last measured before, or else as the run begins, and the angle
    from the measured speed."""
    known = (tape.weight > 0).any(-1).T
    current, speed = jnp.where(known, tape.measured[:, :, 0].T, initial[:, :2].T)
    length = tape.block_sample_time
    by_speed = tape.measured[:, 1] * tape.weight[:, 1] * length[:, None]
    turned = jnp.cumsum(jnp.where(jnp.isnan(tape.turn), by_speed, tape.turn).sum(-1))
    before = jnp.append(0.0, turned)
    first = jnp.searchsorted(jnp.asarray(tape.run), tape.run)
    angle = run_unknowns.angle[tape.run] + before[:-1] - before[first]
    load = jnp.asarray(tape.load)[:, 0] + run_unknowns.load_offset[tape.run]
    guess = pack(motor.initial_state(current, speed, load, angle)).T
    return jnp.where(jnp.asarray(tape.begins)[:, None], initial, guess)


class Joining(NamedTuple):
    """How far the blocks are joined."""

    starts: Starts  # of the last pass
    joined: Starts  # those at which every block begins where the one before it ended
    last: Pass
    gap: Float[Array, ""]  # largest relative gap that the last pass left
    passes: Int[Array, ""]


def _zero_derivatives(motor_on_grids: MotorOnGrids, columns: int) -> MotorOnGrids:
    """Derivatives of zero, for columns that are with respect to the starts only."""
    return jax.tree.map(lambda leaf: jnp.zeros((columns, *leaf.shape)), motor_on_grids)


def _join_blocks(
    motor_on_grids: MotorOnGrids,
    d_motor_on_grids: MotorOnGrids,
    tape: Tape,
    run_unknowns: RunUnknowns,
    initial: Starts,
    guess: Starts,
    max_passes: int | None = None,
) -> Joining:
    """Simulate all blocks until every block begins where the one before it ended.

    The starts are NaN if `max_passes` are not enough.
    """
    motor, columns = motor_on_grids[0], jax.tree.leaves(d_motor_on_grids)[0].shape[0]
    # the correction of a single pass joins a linear motor exactly; otherwise every pass makes at least one more block
    # of each run exact, so this ends for any motor
    exact = motor.affine and not motor.switches
    allowed = max_passes or (1 if exact else len(guess) + 1)

    def simulate(starts: Starts) -> Pass:
        return simulate_blocks(motor_on_grids, d_motor_on_grids, columns, tape, starts, run_unknowns.load_offset)

    def unjoined(joining: Joining) -> Bool[Array, ""]:
        return (joining.gap > MAX_RELATIVE_GAP) & (joining.passes < allowed)

    def improve(joining: Joining) -> Joining:
        starts = joining.joined
        last = simulate(starts)
        size = jnp.max(jnp.abs(jnp.concatenate([starts, last.end])), axis=0) + 1e-6
        limits = None if exact else (size, _state_periods(motor))
        joined = _newton_correction(last, tape, starts, initial, limits)
        gap = jnp.max(jnp.abs(joined - starts) / size)
        return Joining(starts, joined, last, gap, joining.passes + 1)

    shapes = jax.eval_shape(simulate, guess)
    none_yet = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    start = Joining(guess, guess, none_yet, jnp.asarray(jnp.inf), jnp.asarray(0))
    end = jax.lax.while_loop(unjoined, improve, start)
    if max_passes is None or exact:
        return end
    failed = end.gap > MAX_RELATIVE_GAP
    return end._replace(starts=jnp.where(failed, jnp.nan, end.starts), joined=jnp.where(failed, jnp.nan, end.joined))


def _newton_correction(
    passed: Pass, tape: Tape, starts: Starts, initial: Starts, limits: tuple[Start, Start] | None = None
) -> Starts:
    """Newton's correction: each block starts where the corrected one before it ends.

    Far from the solution Newton's linear extrapolation overshoots. Therefore `limits`, the sizes and the periods of the
    states (see `_state_periods`): a change of a start by whole periods is passed on to the end of the block unchanged,
    and any other change may not grow along the block, because the influence of a start decays.
    """
    by_start = jnp.moveaxis(passed.d_end[-starts.shape[1] :], 0, -1)

    def follow(
        end: Start, block: tuple[Start, Bool[Array, ""], Start, Float[Array, "states states"], Start]
    ) -> tuple[Start, Start]:
        begin, first, passed_end, jacobian, start = block
        new = jnp.where(first, begin, end)
        change = new - start
        if limits is None:
            return passed_end + jacobian @ change, new
        size, period = limits
        whole = jnp.where(period > 0, jnp.round(change / jnp.where(period > 0, period, 1.0)), 0.0)
        part = change - whole * period
        largest = size * jnp.max(jnp.abs(part) / size)
        return passed_end + whole * period + jnp.clip(jacobian @ part, -largest, largest), new

    blocks = (initial, jnp.asarray(tape.begins), passed.end, by_start, starts)
    return jax.lax.scan(follow, jnp.zeros_like(starts[0]), blocks)[1]


def _state_periods(motor: Motor) -> Float[Array, " states"]:
    """Period of each state: a shift by it changes nothing else. Zero without one."""
    known = {name: p for effect in motor.effects for name, p in effect.repeats_after().items()}
    return jnp.stack([jnp.zeros(()), jnp.zeros(()), *(known.get(n, jnp.zeros(())) for n in motor.states)])


# State at the start or end of a block, and its derivatives with respect to all columns
WithDerivatives = tuple[Start, Float[Array, "states columns"]]


def _newton_correction_with_derivatives(
    passed: Pass,
    tape: Tape,
    starts: Starts,
    initial: Starts,
    d_initial: Float[Array, "columns blocks states"],
    count: int,
) -> tuple[Starts, Float[Array, "blocks states columns"]]:
    """`_newton_correction` without limits, and the derivatives of the starts with respect to all columns."""
    states = starts.shape[1]
    by_column = jnp.moveaxis(passed.d_end, 0, -1)
    by_start = by_column[..., -states:]
    by_own = _in_all_columns(by_column[..., : count + 1], count)

    def follow(
        carry: WithDerivatives,
        block: tuple[
            Bool[Array, ""],
            WithDerivatives,
            Start,
            Float[Array, "states states"],
            Start,
            Float[Array, "states columns"],
        ],
    ) -> tuple[WithDerivatives, WithDerivatives]:
        first, begin, passed_end, jacobian, start, direct = block
        new, d_new = jax.tree.map(lambda a, b: jnp.where(first, a, b), begin, carry)
        return (passed_end + jacobian @ (new - start), jacobian @ d_new + direct), (new, d_new)

    at_begin = (initial, jnp.moveaxis(d_initial, 0, -1))
    blocks = (jnp.asarray(tape.begins), at_begin, passed.end, by_start, starts, by_own)
    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), at_begin)
    return jax.lax.scan(follow, nothing, blocks)[1]


def _pad_columns(derivatives: T, columns: int) -> T:
    """Derivatives with respect to the parameters, followed by zeros up to so many columns."""
    return jax.tree.map(lambda d: jnp.pad(d, [(0, columns - d.shape[0])] + [(0, 0)] * (d.ndim - 1)), derivatives)
