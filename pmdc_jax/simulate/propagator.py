"""What does not change from step to step of a motor whose input is held: how its linear part moves, exactly, by what
weights the rest acts, and how long a step may be."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from .exponential import Matrix, phi_functions, product
from .switches import contact_response

if TYPE_CHECKING:
    from .tape import Tape

Held = Float[Array, "*#batch"]
Vector = tuple[Scalars, ...]  # current, speed, and the states of linear effects
Slow = dict[str, Scalars]  # the states that are not in the linear part, by name

# Steps into which a sample is divided at most
FINEST = 32
# Over one step what is not in the linear part lets a state fall by no more than exp(-1)
STIFF = 1.0


class Stages(NamedTuple):
    """Weights of ETDRK4 for whatever is not linear."""

    half: Matrix  # exp(A h / 2)
    half_input: Matrix  # h / 2 phi_1(A h / 2)
    half_minus_one: Matrix  # (exp(A h / 2) - 1) half_input
    first: Matrix  # h (phi_1 - 3 phi_2 + 4 phi_3)
    middle: Matrix  # h (2 phi_2 - 4 phi_3)
    last: Matrix  # h (4 phi_3 - phi_2)


class Weights(NamedTuple):
    """By what the rest of a motor with effects acts over one step."""

    push: Matrix  # h phi_1(A h)
    linear: Matrix  # A
    step: Float[Array, "*#batch"]  # s
    stages: Stages | None = None  # where the rest changes within a step
    # what the torque does that teeth begin or cease to pass within a step, in rad of twist, where there are teeth
    contact: Float[Array, "powers n *#batch"] | None = None


class Mean(NamedTuple):
    """By what the mean of a state over a step is made: all that makes its end, with phi_(k + 1) for every phi_k, and so
    as exact. The last three of a motor whose rest changes within a step."""

    whole: Matrix  # phi_1(A h)
    inputs: Float[Array, "n 2 *#batch"]  # h phi_2(A h) B
    push: Matrix  # h phi_2(A h)
    ramp: Matrix | None = None  # h (phi_3 - phi_2 / 2)(A h)
    first: Matrix | None = None  # h (phi_2 - 3 phi_3 + 4 phi_4)
    middle: Matrix | None = None  # h (2 phi_3 - 4 phi_4)
    last: Matrix | None = None  # h (4 phi_4 - phi_3)


class Look(NamedTuple):
    """To where within every sample a late sensor looks."""

    along: Propagator  # a step up to there
    share: Held  # of the sample, more than 0 and at most all of it


class Propagator(NamedTuple):
    """Everything about a motor and a step length that does not change from step to step.

    x(h) = whole x + inputs u is exact for the linear motor. With effects the step is one of the equal parts of
    a sample, and the inputs are part of the rest, for which there are `weights`.
    """

    whole: Matrix  # exp(A h)
    inputs: Float[Array, "n 2 *#batch"]  # h phi_1(A h) B
    weights: Weights | None = None
    apart: Propagator | None = None  # the same while teeth do not touch
    # h (phi_2 - phi_1 / 2)(A h): by what a drive acts that rises within a step, beyond what its mean does
    ramp: Matrix | None = None
    look: Look | None = None  # where a sensor is late
    mean: Mean | None = None  # where a speed is reported as a mean


@eqx.filter_jit  # one trace serves all grids
def propagator(
    motor: Motor, step: Held, drive: Drive, straight: bool = False, averaged: bool = False
) -> Propagator:
    """Exact step of the linear part over `step` seconds, and the weights for what the effects add; of teeth that touch,
    and beside it of such that do not. `straight` asks for what a drive needs that is not held, `averaged` for the mean
    of the state."""
    A, B = _linear_part(motor, drive)
    along = _by_linear_part(motor, step, A, B, straight, averaged)
    teeth = motor.toothed
    if teeth is None:
        return along
    assert teeth.contact_state is not None
    open_teeth = motor.with_effects(e.without_contact() for e in motor.effects)
    A_apart, _ = _linear_part(open_teeth, drive)
    apart = _by_linear_part(motor, step, A_apart, B, straight, averaged)
    push = (A - A_apart)[:, 2 + linear_states(motor).index(teeth.contact_state)]
    apart = _with_contact_response(apart, contact_response(A, push, step))
    return _with_contact_response(along, contact_response(A_apart, push, step))._replace(
        apart=apart
    )


def _with_contact_response(
    along: Propagator, contact: Float[Array, "powers n *#batch"]
) -> Propagator:
    assert along.weights is not None
    return along._replace(weights=along.weights._replace(contact=contact))


def _by_linear_part(
    motor: Motor,
    step: Held,
    A: Matrix,
    B: Float[Array, "n 2 *#batch"],
    straight: bool,
    averaged: bool,
) -> Propagator:
    """The propagator of a motor whose linear part is A and B.

    **Source**: ETDRK4, Cox, Matthews, Journal of Computational Physics 176 (2002), equations (26)-(29),
    doi:10.1006/jcph.2002.6995.
    """
    staged = not motor.affine
    ramps = straight and not staged  # stages see how a drive rises
    (half0, half1, *_), phi = phi_functions(A * step, (3 if staged else 1 + ramps) + averaged)
    stages = weights = None
    if staged:
        half_input = step / 2 * half1
        half_minus_one = product(half0, half_input) - half_input
        stages = Stages(half0, half_input, half_minus_one, *_rest(step, phi))
    if motor.effects:
        weights = Weights(step * phi[1], A, step * jnp.ones_like(motor.R), stages)
    return Propagator(
        phi[0],
        step * product(phi[1], B),
        weights,
        ramp=_ramp(step, phi) if ramps else None,
        mean=_mean(step, phi[1:], B, ramps, staged) if averaged else None,
    )


def _ramp(step: Held, phi: Sequence[Matrix]) -> Matrix:
    """By what a drive acts that rises within a step, beyond what its mean does."""
    return step * (phi[2] - phi[1] / 2)


def _rest(step: Held, phi: Sequence[Matrix]) -> tuple[Matrix, Matrix, Matrix]:
    """By what the stages of ETDRK4 act: the first one, those in the middle, and the last."""
    first = step * (phi[1] - 3 * phi[2] + 4 * phi[3])
    return first, step * (2 * phi[2] - 4 * phi[3]), step * (4 * phi[3] - phi[2])


def _mean(
    step: Held,
    phi: Sequence[Matrix],
    B: Float[Array, "n 2 *#batch"],
    ramps: bool,
    staged: bool,
) -> Mean:
    """The mean over a step, by `phi` from phi_1 on in place of phi_0."""
    push = step * phi[1]
    ramp = _ramp(step, phi) if ramps else None
    return Mean(phi[0], product(push, B), push, ramp, *(_rest(step, phi) if staged else ()))


def _linear_part(motor: Motor, drive: Drive) -> tuple[Matrix, Float[Array, "n 2 *#batch"]]:
    """A and B of the linear motor, with the states of its linear effects."""
    A, B = motor.state_space(drive)
    linear = tuple(e for effect in motor.effects if (e := effect.linear()) is not None)
    if not linear:
        return A, B
    core = motor.with_effects(linear)
    zero, one = jnp.zeros_like(motor.R), jnp.ones_like(motor.R)
    count = 2 + len(core.states)
    columns = []
    for k in range(count):
        state = state_of(core, tuple(one if j == k else zero for j in range(count)), {})
        columns.append(jnp.stack(vector(core, core.derivative(state, zero, zero, drive))))
    A = jnp.stack(columns, 1)
    return A, jnp.concatenate([B, jnp.zeros_like(A[2:, :2])])


def along_grids(motor: Motor, tape: Tape) -> Propagator:
    """The propagator of one step on every grid of the tape, stacked in front."""
    steps, delay = steps_in_sample(motor, tape), motor.speed_delay()

    def of_grid(g: int) -> Propagator:
        sample = jnp.asarray(tape.sample_time)[g]
        drive = Drive(*(jnp.asarray(share)[g] for share in tape.drive))
        how = (tape.rise is not None, tape.averaging is not None)
        along = propagator(motor, sample / steps, drive, *how)
        if delay is None:
            return along
        samples = jnp.asarray(delay / sample)
        share = 1 - (samples - jnp.floor(samples))
        part = propagator(motor, share * sample / steps, drive, *how)
        return along._replace(look=Look(part, share))

    grids = map(of_grid, range(tape.sample_time.shape[0]))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *grids)


def pick_grid(
    grids: Propagator, tape: Tape, grid: Int[Array | np.ndarray, "..."]
) -> tuple[Propagator, Drive]:
    """Propagator and drive of one grid, or of one grid for each block."""
    return jax.tree.map(lambda leaf: leaf[grid], (grids, tape.drive))


def steps_in_sample(motor: Motor, tape: Tape) -> int | Int[Array, ""]:
    """Into how many equal steps the samples of a tape are divided."""
    current = jnp.max(jnp.abs(jnp.asarray(tape.measured)[:, 0]))
    return steps_within(motor, tape.longest, current)


def steps_within(motor: Motor, seconds: float, current: Scalars) -> int | Int[Array, ""]:
    """Into how many equal steps that time is divided, so that none is longer than the effects allow at currents up to
    `current` in A."""
    allowed = [e.longest_step for e in motor.effects if e.holds or e.contact_state or not e.affine]
    if not allowed:
        return 1
    least = min(max(round(seconds / min(allowed)), 1), FINEST)
    rates = [rate for e in motor.effects if (rate := e.fastest_rate(motor, current)) is not None]
    if not rates:
        return least
    # of a population, as most of it needs: what a wild one needs would hold up all
    needed = jnp.ceil(jnp.median(reduce(jnp.maximum, rates)) * seconds / STIFF)
    return jnp.clip(jnp.nan_to_num(needed, nan=FINEST), least, FINEST).astype(int)


def linear_states(motor: Motor) -> list[str]:
    """States that effects add to the linear part."""
    linear = {name for e in motor.effects if e.linear() is not None for name in e.states}
    return sorted(linear)


def vector(motor: Motor, state: State) -> Vector:
    """Current, speed and the states that effects add to the linear part."""
    return (state.current, state.speed, *(state.extra[name] for name in linear_states(motor)))


def state_of(motor: Motor, x: Vector, slow: Slow) -> State:
    """The state of such a vector and of the states that are not in the linear part."""
    return State(x[0], x[1], slow | dict(zip(linear_states(motor), x[2:], strict=True)))
