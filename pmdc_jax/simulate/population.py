"""How well each of many candidate motors reproduces the runs: the hot loop of the genetic search."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..motor import Motor
from .solver import HeldInput, Walk, along_grids, held_step, pick_grid, steps_in_sample, walk
from .tape import BLOCK, Tape

# Samples of linear motors whose arithmetic XLA fuses into one kernel, measured: small populations gain from fewer
# kernels, large ones lose by recomputation, and so does every population with effects.
SMALL, UNROLL_SMALL, UNROLL_LARGE = 64, 8, 4


# Candidates a thread takes at least: below this, handing them over costs more than it saves.
SHARE = 64


def squared_errors(
    motors: Motor, tape: Tape
) -> tuple[Float[Array, " population"], Float[Array, " population"]]:
    """Sums of squared errors of current (A^2) and speed (rad^2/s^2) for a population, in free run.

    **Arguments**: `motors`, whose fields have the shape (population,). Every run starts at the tape's initial
    state; unknown loads are taken as zero. A motor whose simulation fails gets infinity, never NaN.
    """
    size = motors.R.shape[0]
    shares = max(1, min(os.cpu_count() or 1, size // SHARE))
    if shares == 1 or size % shares:  # unequal shares would be compiled once more
        return _squared_errors(motors, tape)
    double = jax.config.read("jax_enable_x64")

    def part(k: int):
        with jax.enable_x64(double):  # the setting belongs to the thread
            mine = slice(k * size // shares, (k + 1) * size // shares)
            return _squared_errors(jax.tree.map(lambda leaf: leaf[mine], motors), tape)

    # XLA walks a population on one core; the cores share it out among them
    with ThreadPoolExecutor(shares) as pool:
        current, speed = zip(*pool.map(part, range(shares)), strict=True)
    return jnp.concatenate(current), jnp.concatenate(speed)


@eqx.filter_jit
def _squared_errors(motors: Motor, tape: Tape):
    """One share: its blocks one after another, the whole population in the state."""
    grids, steps = along_grids(motors, tape), steps_in_sample(motors, tape)
    unroll = UNROLL_SMALL if motors.R.shape[0] <= SMALL else UNROLL_LARGE
    if motors.effects:
        unroll = 1

    delay = motors.speed_delay()
    speeds, weights = (jnp.asarray(x)[:, 1].reshape(-1) for x in (tape.measured, tape.weight))
    ends = BLOCK * jnp.searchsorted(jnp.asarray(tape.run), jnp.arange(tape.runs), side="right")

    def advance(carry, block):
        along, drive = pick_grid(grids, tape, tape.grid[block])

        def sample(carry, samples):
            state, errors = carry
            value, load, measured, weight, k = samples
            if delay is not None:  # what is seen later is compared with what was measured later
                late = k + jnp.round(delay / tape.sample_time[tape.grid[block]]).astype(int)
                inside = late < ends[tape.run[block]]
                late = jnp.minimum(late, len(speeds) - 1)
                measured = (measured[0], speeds[late])
                weight = (weight[0], jnp.where(inside, weights[late], 0.0))
            seen = motors.sensors(state)
            errors = tuple(
                e + weight[c] * (seen[c] - measured[c]) ** 2 for c, e in enumerate(errors)
            )
            after = held_step(motors, along, drive, state, value, load, steps)
            return (after, errors), None

        run = tape.run[block]
        current, speed = tape.initial[run]
        initial = motors.rest(current, speed, tape.load[block, 0], tape.angle[run])
        begins = tape.begins[block]
        state = jax.tree.map(lambda new, old: jnp.where(begins, new, old), initial, carry.state)
        samples = (
            tape.value[block],
            tape.load[block],
            tape.measured[block].T,
            tape.weight[block].T,
            block * BLOCK + jnp.arange(BLOCK),
        )
        (state, errors), _ = jax.lax.scan(sample, (state, carry.seen), samples, unroll=unroll)
        return Walk(state, errors)

    zero = jnp.zeros_like(motors.R)
    start = Walk(motors.rest(zero, zero), (zero, zero))
    saveat = diffrax.SaveAt(t1=True)
    errors = walk(HeldInput(advance), start, tape.value.shape[0], saveat).seen
    current, speed = (jnp.where(jnp.isfinite(e[0]), e[0], jnp.inf) for e in errors)
    return current, speed
