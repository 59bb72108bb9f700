"""Step matrices, which stay the same from step to step: the exact step of a motor's linear part and the weights of
the rest; and the number of steps in a sample."""

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

StepLength = Float[Array, "*#batch"]  # s
Vector = tuple[Scalars, ...]  # current, speed, and the states of linear effects
NonlinearStates = dict[str, Scalars]  # the states that are not in the linear part, by name

# In a sample
MAX_STEPS = 32
# Of an effect's `fastest_rate`: a decay by no more than exp(-1) in a step
MAX_RATE_TIMES_STEP = 1.0


class Stages(NamedTuple):
    """Weights of ETDRK4 for whatever is not in the linear part."""

    half: Matrix  # exp(A h / 2)
    half_input: Matrix  # h / 2 phi_1(A h / 2)
    half_minus_one: Matrix  # (exp(A h / 2) - 1) half_input
    first: Matrix  # h (phi_1 - 3 phi_2 + 4 phi_3)
    middle: Matrix  # h (2 phi_2 - 4 phi_3)
    last: Matrix  # h (4 phi_3 - phi_2)


class Weights(NamedTuple):
    """Weights over one step for a motor with effects."""

    rate_response: Matrix  # h phi_1(A h): response to a constant rate
    A: Matrix  # of the linear part
    step: StepLength
    stages: Stages | None = None  # if the rest varies within a step
    # response to the torque that teeth begin or cease to pass within a step, per rad of compression; None without teeth
    contact: Float[Array, "powers n *#batch"] | None = None


class MeanPropagator(NamedTuple):
    """Matrices for the mean of the state over a step: those for its end, with phi_(k + 1) in place of every phi_k, and
    so as accurate. The last three are for a motor with `Stages`."""

    transition: Matrix  # phi_1(A h)
    inputs: Float[Array, "n 2 *#batch"]  # h phi_2(A h) B
    rate_response: Matrix  # h phi_2(A h)
    ramp: Matrix | None = None  # h (phi_3 - phi_2 / 2)(A h)
    first: Matrix | None = None  # h (phi_2 - 3 phi_3 + 4 phi_4)
    middle: Matrix | None = None  # h (2 phi_3 - 4 phi_4)
    last: Matrix | None = None  # h (4 phi_4 - phi_3)


class Instant(NamedTuple):
    """An instant within each sample."""

    propagator: Propagator  # one of the equal steps up to that instant
    share: Scalars  # of the sample up to that instant, 0 < share <= 1


class Propagator(NamedTuple):
    """Step matrices of a motor for one step length h.

    x(h) = transition x + inputs u is exact for the linear motor. With effects, h is one of the equal steps in a sample,
    and the inputs act through `weights`, like everything else that is not in the linear part.
    """

    transition: Matrix  # exp(A h)
    inputs: Float[Array, "n 2 *#batch"]  # h phi_1(A h) B
    weights: Weights | None = None
    without_contact: Propagator | None = None  # the same while the teeth do not touch
    # h (phi_2 - phi_1 / 2)(A h): effect of a drive's rise within a step, beyond that of its mean
    ramp: Matrix | None = None
    reading: Instant | None = None  # when the outputs are read, if not at the start of a sample
    # when a delayed sensor sees the speed, or the speed's mean ends, if not at a sample
    speed_seen: Instant | None = None
    mean: MeanPropagator | None = None  # for a speed that is reported as a mean


@eqx.filter_jit  # one trace serves all grids
def make_propagator(
    motor: Motor, step: StepLength, drive: Drive, linear_drive: bool = False, averaged: bool = False
) -> Propagator:
    """Exact step of the linear part over `step` seconds, and the weights for what the effects add.

    With teeth it is made for teeth that touch, and its `without_contact` for those that do not. `linear_drive` asks for
    the matrices of a drive that varies linearly instead of being held, `averaged` for those of the mean of the state.
    """
    A, B = _linear_part(motor, drive)
    propagator = _by_linear_part(motor, step, A, B, linear_drive, averaged)
    teeth = motor.gear
    if teeth is None:
        return propagator
    assert teeth.contact_state is not None
    open_teeth = motor.with_effects(e.without_contact() for e in motor.effects)
    A_without, _ = _linear_part(open_teeth, drive)
    without_contact = _by_linear_part(motor, step, A_without, B, linear_drive, averaged)
    push = (A - A_without)[:, 2 + linear_states(motor).index(teeth.contact_state)]
    without_contact = _with_contact_response(without_contact, contact_response(A, push, step))
    return _with_contact_response(propagator, contact_response(A_without, push, step))._replace(
        without_contact=without_contact
    )


def _with_contact_response(propagator: Propagator, contact: Float[Array, "powers n *#batch"]) -> Propagator:
    assert propagator.weights is not None
    return propagator._replace(weights=propagator.weights._replace(contact=contact))


def _by_linear_part(
    motor: Motor, step: StepLength, A: Matrix, B: Float[Array, "n 2 *#batch"], linear_drive: bool, averaged: bool
) -> Propagator:
    """The propagator of a motor whose linear part is A and B.

    **Source**: ETDRK4, Cox, Matthews, Journal of Computational Physics 176 (2002), equations (26)-(29),
    doi:10.1006/jcph.2002.6995.
    """
    staged = not motor.affine
    ramps = linear_drive and not staged  # stages evaluate the drive as it rises
    (half0, half1, *_), phi = phi_functions(A * step, (3 if staged else 1 + ramps) + averaged)
    stages = weights = None
    if staged:
        half_input = step / 2 * half1
        half_minus_one = product(half0, half_input) - half_input
        stages = Stages(half0, half_input, half_minus_one, *_etdrk4_weights(step, phi))
    if motor.effects:
        weights = Weights(step * phi[1], A, step * jnp.ones_like(motor.R), stages)
    return Propagator(
        phi[0],
        step * product(phi[1], B),
        weights,
        ramp=_ramp(step, phi) if ramps else None,
        mean=_mean(step, phi[1:], B, ramps, staged) if averaged else None,
    )


def _ramp(step: StepLength, phi: Sequence[Matrix]) -> Matrix:
    """Weight of a drive's rise within a step, beyond the effect of its mean."""
    return step * (phi[2] - phi[1] / 2)


def _etdrk4_weights(step: StepLength, phi: Sequence[Matrix]) -> tuple[Matrix, Matrix, Matrix]:
    """Weights of the stages of ETDRK4: the first, the two in the middle, and the last."""
    first = step * (phi[1] - 3 * phi[2] + 4 * phi[3])
    return first, step * (2 * phi[2] - 4 * phi[3]), step * (4 * phi[3] - phi[2])


def _mean(
    step: StepLength, phi: Sequence[Matrix], B: Float[Array, "n 2 *#batch"], ramps: bool, staged: bool
) -> MeanPropagator:
    """Matrices for the mean over a step; `phi` begins with phi_1 instead of phi_0."""
    rate_response = step * phi[1]
    ramp = _ramp(step, phi) if ramps else None
    stages = _etdrk4_weights(step, phi) if staged else ()
    return MeanPropagator(phi[0], product(rate_response, B), rate_response, ramp, *stages)


def _linear_part(motor: Motor, drive: Drive) -> tuple[Matrix, Float[Array, "n 2 *#batch"]]:
    """A and B of the linear motor, extended by the states of its linear effects."""
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


def grid_propagators(motor: Motor, tape: Tape) -> Propagator:
    """The propagators of one step on every grid of the tape, stacked along the first axis."""
    steps, delay, reading = steps_in_sample(motor, tape), motor.speed_delay(), tape.reading

    def of_grid(sample: Float[Array, ""], drive: Drive, later: Float[Array, ""] | None) -> Propagator:
        options = (tape.rise is not None, tape.averaging is not None)

        def instant(share: Scalars) -> Instant:
            share = jnp.asarray(share) * jnp.ones_like(motor.R)
            return Instant(make_propagator(motor, share * sample / steps, drive, *options), share)

        propagator = make_propagator(motor, sample / steps, drive, *options)
        if reading is not None:
            propagator = propagator._replace(reading=instant(reading))
        if delay is not None or later is not None:
            behind = samples_behind(delay, sample, reading, later)
            propagator = propagator._replace(speed_seen=instant(1 - (behind - jnp.floor(behind))))
        return propagator

    return jax.vmap(of_grid)(*jax.tree.map(jnp.asarray, (tape.sample_time, tape.drive, tape.later)))


def samples_behind(
    delay: Scalars | None, sample_time: Scalars, reading: Scalars | None, later: Scalars | None
) -> Scalars:
    """How many samples before each one its speed was seen, or the mean of its speed ended; negative for after it.

    **Arguments**: `delay` of the sensor, s; `sample_time`, s; `reading` and `later`, as of a `Tape`.
    """
    behind = 0.0 if delay is None else delay / sample_time
    for ahead in (reading, later):
        behind = behind if ahead is None else behind - ahead
    return jnp.asarray(behind)


def pick_grid(grids: Propagator, tape: Tape, grid: Int[Array | np.ndarray, "..."]) -> tuple[Propagator, Drive]:
    """Propagator and drive of one grid, or of one grid for each block."""
    return jax.tree.map(lambda leaf: leaf[grid], (grids, tape.drive))


def steps_in_sample(motor: Motor, tape: Tape) -> int | Int[Array, ""]:
    """Number of equal steps in a sample of the tape."""
    current = jnp.max(jnp.abs(jnp.asarray(tape.measured)[:, 0]))
    return steps_within(motor, jnp.max(jnp.asarray(tape.sample_time)), current, tape.longest)


def steps_within(motor: Motor, seconds: Scalars, current: Scalars, longest: float) -> int | Int[Array, ""]:
    """Number of equal steps in this time, at most `MAX_STEPS`, so that none is longer than the effects allow at
    currents up to `current` in A; `seconds` is at most `longest`, for which programs are compiled."""
    resolved = [e for e in motor.effects if e.holds or e.contact_state or not e.affine]
    if not resolved:
        return 1
    always_resolves = min(e.longest_step for e in resolved)
    rates = [rate for e in motor.effects if (rate := e.fastest_rate(motor, current)) is not None]
    if not rates and longest <= always_resolves:
        return 1
    # rounded up, but for rounding errors
    least = jnp.clip(jnp.ceil(seconds / always_resolves - 1e-6), 1, MAX_STEPS)
    longer = [step for e in resolved if (step := e.longer_step(motor)) is not None]
    # the median of a population: an outlier that needs far more steps would slow down all of it
    if len(longer) == len(resolved):
        needed = seconds / jnp.median(reduce(jnp.minimum, longer))
        # a power of two, which a slightly different motor of a fit needs, too
        needed = 2 ** jnp.ceil(jnp.log2(jnp.nan_to_num(needed, nan=MAX_STEPS)))
        least = jnp.clip(needed, 1, least)
    if rates:
        needed = jnp.ceil(jnp.median(reduce(jnp.maximum, rates)) * seconds / MAX_RATE_TIMES_STEP)
        least = jnp.clip(jnp.nan_to_num(needed, nan=MAX_STEPS), least, MAX_STEPS)
    return least.astype(int)


def linear_states(motor: Motor) -> list[str]:
    """States that effects add to the linear part."""
    linear = {name for e in motor.effects if e.linear() is not None for name in e.states}
    return sorted(linear)


def vector(motor: Motor, state: State) -> Vector:
    """Current, speed and the states that effects add to the linear part."""
    return (state.current, state.speed, *(state.extra[name] for name in linear_states(motor)))


def state_of(motor: Motor, x: Vector, nonlinear: NonlinearStates) -> State:
    """The state from its `vector` and the states that are not in the linear part."""
    return State(x[0], x[1], nonlinear | dict(zip(linear_states(motor), x[2:], strict=True)))
