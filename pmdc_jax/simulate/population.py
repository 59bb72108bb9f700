"""How well each of many candidate motors reproduces the runs: the hot loop of the genetic search."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import Scalars, State
from ..motor import Motor
from ..runtime.compiled import compiled
from ..runtime.threads import CORES, map_in_threads
from .exponential import Matrix, product
from .propagator import Propagator, grid_propagators, pick_grid, steps_in_sample
from .sensing import at_instant
from .solver import Carry, Input, StepSolver, held_step_and_mean, take_steps
from .tape import BLOCK, Samples, Tape

# Samples in a stride of linear motors, a power of two that divides a block; 8 and 32 were measured to be slower.
STRIDE = 16

# Sums of squared errors of current (A^2) and speed (rad^2/s^2)
Errors = tuple[Float[Array, " population"], Float[Array, " population"]]

# With fewer candidates for each, linear or with effects, threads cost more than they save; with more, what is carried
# from sample to sample leaves the processor's cache.
MIN_LINEAR_PER_THREAD, MIN_PER_THREAD, MAX_PER_THREAD = 256, 32, 1024


def squared_errors(motors: Motor, tape: Tape) -> Errors:
    """Sums of squared errors of current (A^2) and speed (rad^2/s^2) for a population, in free run.

    **Arguments**: `motors`, whose fields have the shape (population,). Every run starts at the tape's initial
    state; unknown loads are taken as zero. A motor whose simulation fails gets infinity, never NaN.
    """
    shares = _shares(motors)
    if shares == 1:
        return _errors(motors, tape, np.asarray(0), 1)

    def part(k: int) -> Errors:
        return jax.block_until_ready(_errors(motors, tape, np.asarray(k), shares))

    # XLA runs the loop over samples on one core, so the population is divided among threads
    parts = map_in_threads(part, range(shares))
    current, speed = (jnp.asarray(np.concatenate(errors)) for errors in zip(*parts, strict=True))
    return current, speed


def _shares(motors: Motor) -> int:
    """Number of equal shares in which a population is simulated: those of different sizes would be compiled twice."""
    if jax.default_backend() != "cpu":
        return 1
    size, least = motors.R.shape[0], MIN_PER_THREAD if motors.effects else MIN_LINEAR_PER_THREAD
    most = max(min(CORES, size // least), size // MAX_PER_THREAD, 1)
    return next(shares for shares in range(most, 0, -1) if size % shares == 0)


# The widest vectors that the processor has: by default XLA uses half of that width.
@partial(compiled, options={"xla_cpu_prefer_vector_width": 512})
def _errors(motors: Motor, tape: Tape, share: Int[Array | np.ndarray, ""], shares: int) -> Errors:
    """Errors of one of the equal shares of a population."""
    if shares > 1:
        size = motors.R.shape[0] // shares
        leaves = [jax.lax.dynamic_slice_in_dim(x, share * size, size) for x in jax.tree.leaves(motors)]
        # the barrier keeps XLA from fusing the slices into the arithmetic, which would lose its vector instructions
        motors = jax.tree.unflatten(jax.tree.structure(motors), jax.lax.optimization_barrier(leaves))
    return _errors_with_effects(motors, tape) if motors.effects else _errors_of_linear(motors, tape)


def _means_at_sample_start(tape: Tape) -> tuple[Samples, Samples, Bool[Array, "blocks 2"] | None]:
    """Measurements and weights, with means over the last sample moved to where that sample begins; and which currents
    and speeds of the blocks are such means, None if nothing of the tape is a mean.

    A mean around a sample is centred already, and stays.
    """
    if tape.averaging is None:
        return tape.measured, tape.weight, None
    over_last = (jnp.asarray(tape.averaging)[:, (2, 0)] == 1)[tape.run]
    if tape.span is not None:  # near enough for a search
        over_last &= jnp.stack([jnp.ones(tape.run.shape, bool), jnp.asarray(tape.span)[tape.run] == 1], -1)
    if tape.later is not None:
        over_last &= jnp.stack([jnp.ones(tape.run.shape, bool), jnp.asarray(tape.later)[tape.grid] == 0], -1)
    # the mean from the last sample of a run on was not recorded
    last_of_run = jnp.append(jnp.asarray(tape.begins)[1:], True)

    def moved(signal: Samples) -> Float[Array, "blocks 2 samples"]:
        signal = jnp.asarray(signal)
        next_block = jnp.where(last_of_run[:, None], 0.0, jnp.roll(signal[..., 0], -1, axis=0))
        sooner = jnp.concatenate([signal[..., 1:], next_block[..., None]], -1)
        return jnp.where(over_last[..., None], sooner, signal)

    return moved(tape.measured), moved(tape.weight), over_last


def _outputs_or_means(
    motors: Motor, state: State, mean: State | None, over_last: Bool[Array, "blocks 2"] | None, block: Int[Array, ""]
) -> tuple[Scalars, Scalars]:
    """Current and speed at a sample, or, in blocks that report means, the means from there to the next sample."""
    outputs = motors.sensors(state)
    if mean is None or over_last is None:
        return outputs
    current, speed = (
        jnp.where(over_last[block, c], *both) for c, both in enumerate(zip(motors.sensors(mean), outputs, strict=True))
    )
    return current, speed


def _when_read(
    motors: Motor, propagator: Propagator, acting: Input, state: State, steps: int | Int[Array, ""] = 1
) -> State:
    """The state when the outputs of a sample are read, from that at its start."""
    if propagator.reading is None:
        return state
    return at_instant(motors, propagator.reading, acting, state, steps)[0]


# State of the motors, and their squared errors of current and speed so far
Gathered = tuple[State, tuple[Scalars, ...]]
# Current and speed
Two = tuple[Scalars, Scalars] | Float[Array, "2 ..."]


def _step_and_compare(
    motors: Motor,
    propagator: Propagator,
    acting: Input,
    gathered: Gathered,
    measured: Two,
    weight: Two,
    block: Int[Array, ""],
    over_last: Bool[Array, "blocks 2"] | None,
    steps: int | Int[Array, ""] = 1,
) -> Gathered:
    """The state one sample later, and the errors with those at this sample added."""
    state, errors = gathered
    after, mean = held_step_and_mean(motors, propagator, acting, state, steps)
    read = _when_read(motors, propagator, acting, state, steps)
    simulated = _outputs_or_means(motors, read, mean, over_last, block)
    return after, tuple(e + weight[c] * (simulated[c] - measured[c]) ** 2 for c, e in enumerate(errors))


def _begun(tape: Tape, block: Int[Array, ""], initial: State, before: State) -> State:
    """The state at the start of a block: the initial one of a run, or that at the end of the block before."""
    begins = tape.begins[block]
    return jax.tree.map(lambda new, old: jnp.where(begins, new, old), initial, before)


def _sums_over_blocks(
    motors: Motor, tape: Tape, advance: Callable[[Carry, Int[Array, ""]], Carry], none: Scalars
) -> list[Float[Array, "..."]]:
    """The errors of current and speed, from `none` on, after all blocks."""
    zero = jnp.zeros_like(motors.R)
    start = Carry(motors.initial_state(zero, zero), (none, none))
    errors = take_steps(StepSolver(advance), start, tape.value.shape[0], diffrax.SaveAt(t1=True)).output
    return [e[0] for e in errors]


class Stride(NamedTuple):
    """The exact step of linear motors over `STRIDE` samples: x(end) = transition x(start) + response to inputs."""

    transition: Matrix  # exp(A h)^STRIDE
    # first axis: the driving values at all samples, then the loads
    input_response: Float[Array, "inputs 2 population"]


def _stride(propagator: Propagator) -> Stride:
    """By repeated doubling from one sample: the response to the earlier inputs is propagated through the later half."""
    transition, input_response = propagator.transition[:, :, None], propagator.inputs[:, :, None]
    for _ in range(STRIDE.bit_length() - 1):
        input_response = jnp.concatenate([product(transition, input_response), input_response], axis=2)
        transition = product(transition, transition)
    by_input = jnp.moveaxis(input_response, 0, 2)
    return Stride(transition[:, :, 0], by_input.reshape(2 * STRIDE, 2, -1))


def _stride_starts(stride: Stride, state: State, value: Samples, load: Samples) -> tuple[State, State]:
    """States of linear motors at the end of a block, and at the start of each of its strides, (strides, population).

    The inputs of all strides go through one matrix product, so that little sequential work is left.
    """
    inputs = jnp.concatenate([_in_strides(value), _in_strides(load)], axis=1)
    responses = jnp.tensordot(inputs, stride.input_response, 1)

    def follow(
        x: Float[Array, "2 population"], response: Float[Array, "2 population"]
    ) -> tuple[Float[Array, "2 population"], Float[Array, "2 population"]]:
        return stride.transition[:, 0] * x[0] + stride.transition[:, 1] * x[1] + response, x

    end, starts = jax.lax.scan(follow, jnp.stack([state.current, state.speed]), responses)
    return State(end[0], end[1], {}), State(starts[:, 0], starts[:, 1], {})


def _in_strides(samples: Float[Samples, "... samples"]) -> Float[Array, "... strides stride"]:
    return jnp.asarray(samples).reshape(*samples.shape[:-1], -1, STRIDE)


def _errors_of_linear(motors: Motor, tape: Tape) -> Errors:
    """Errors of one share of linear motors: block after block, with the whole share in the state.

    The strides of a block run in parallel: XLA fuses all the arithmetic of a stride into one loop over strides and
    candidates.
    """
    grids = grid_propagators(motors, tape)
    strides, rows = jax.vmap(_stride)(grids), BLOCK // STRIDE
    measured, weights, over_last = _means_at_sample_start(tape)

    def advance(carry: Carry, block: Int[Array, ""]) -> Carry:
        grid = jnp.asarray(tape.grid)[block]
        _, drive = pick_grid(grids, tape, grid)
        propagator = jax.tree.map(lambda leaf: _repeat_rows(_pick(leaf, grid), rows), grids)
        samples = (tape.value[block], tape.load[block], measured[block], weights[block])
        state = _begun(tape, block, motors.initial_state(*tape.initial[tape.run[block]]), carry.state)
        stride = jax.tree.map(lambda leaf: leaf[grid], strides)
        end, starts = _stride_starts(stride, state, *samples[:2])
        # the samples of a stride along the first axis, then a row for each stride
        by_sample = jax.tree.map(lambda s: jnp.moveaxis(_in_strides(s), -1, 0)[..., None], samples)

        def sample(
            carry: Gathered,
            samples: tuple[
                Float[Array, "strides 1"],
                Float[Array, "strides 1"],
                Float[Array, "2 strides 1"],
                Float[Array, "2 strides 1"],
            ],
        ) -> tuple[Gathered, None]:
            value, load, measured, weight = samples
            acting = Input(drive, value, load)
            return _step_and_compare(motors, propagator, acting, carry, measured, weight, block, over_last), None

        (_, errors), _ = jax.lax.scan(sample, (starts, carry.output), by_sample, unroll=STRIDE)
        return Carry(end, errors)

    errors = _sums_over_blocks(motors, tape, advance, jnp.zeros((rows, len(motors.R))))
    # rows are summed only here: XLA would fuse the sum into the arithmetic, which would lose its vector instructions
    current, speed = (e.sum(0) for e in errors)
    return _infinite_if_failed(current), _infinite_if_failed(speed)


def _infinite_if_failed(errors: Float[Array, " population"]) -> Float[Array, " population"]:
    return jnp.where(jnp.isfinite(errors), errors, jnp.inf)


def _pick(grids: Float[Array, "grids ..."], grid: Int[Array, ""]) -> Float[Array, "..."]:
    """One grid's entry, by a matrix product: XLA would fuse indexing into the arithmetic, which would lose its vector
    instructions."""
    if len(grids) == 1:
        return grids[0]
    return jnp.tensordot(jnp.where(jnp.arange(len(grids)) == grid, 1.0, 0.0), grids, 1)


def _repeat_rows(leaf: Float[Array, "... population"], rows: int) -> Float[Array, "... rows population"]:
    return jnp.broadcast_to(leaf[..., None, :], (*leaf.shape[:-1], rows, leaf.shape[-1]))


def _errors_with_effects(motors: Motor, tape: Tape) -> Errors:
    """Errors of one share of motors with effects, sample by sample."""
    grids, steps = grid_propagators(motors, tape), steps_in_sample(motors, tape)
    delay = motors.speed_delay()
    measured, weights, over_last = _means_at_sample_start(tape)
    speeds, speed_weights = (jnp.asarray(x)[:, 1].reshape(-1) for x in (measured, weights))
    run_ends = BLOCK * jnp.searchsorted(jnp.asarray(tape.run), jnp.arange(tape.runs), side="right")

    def advance(carry: Carry, block: Int[Array, ""]) -> Carry:
        propagator, drive = pick_grid(grids, tape, tape.grid[block])

        def sample(
            carry: Gathered,
            samples: tuple[Float[Array, ""], Float[Array, ""], Float[Array, "2"], Float[Array, "2"], Int[Array, ""]],
        ) -> tuple[Gathered, None]:
            value, load, measured, weight, k = samples
            if delay is not None:  # what is seen later is compared with what was measured later
                late = k + jnp.round(delay / tape.sample_time[tape.grid[block]]).astype(int)
                inside = late < run_ends[tape.run[block]]
                late = jnp.minimum(late, len(speeds) - 1)
                measured = (measured[0], speeds[late])
                weight = (weight[0], jnp.where(inside, speed_weights[late], 0.0))
            acting = Input(drive, value, load)
            return _step_and_compare(motors, propagator, acting, carry, measured, weight, block, over_last, steps), None

        run = tape.run[block]
        current, speed = tape.initial[run]
        initial = motors.initial_state(current, speed, tape.load[block, 0], tape.angle[run])
        state = _begun(tape, block, initial, carry.state)
        samples = (
            tape.value[block],
            tape.load[block],
            measured[block].T,
            weights[block].T,
            block * BLOCK + jnp.arange(BLOCK),
        )
        (state, errors), _ = jax.lax.scan(sample, (state, carry.output), samples)
        return Carry(state, errors)

    current, speed = _sums_over_blocks(motors, tape, advance, jnp.zeros_like(motors.R))
    return _infinite_if_failed(current), _infinite_if_failed(speed)
