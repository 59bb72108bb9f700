"""A diffrax solver for motors whose input is held between samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import Grip, Scalars, State
from ..motor import Drive, Motor
from .exponential import Matrix, phi_functions, product

if TYPE_CHECKING:
    from .tape import Tape

Held = Float[Array, "*#batch"]
T = TypeVar("T")
Vector = tuple[Scalars, ...]  # current, speed, and the states of linear effects

# Steps into which a sample is divided at most
FINEST = 32
# Over one step what is not in the linear part lets a state fall by no more than exp(-1)
STIFF = 1.0


class Stages(NamedTuple):
    """Weights of ETDRK4 for whatever is not linear."""

    half: Matrix  # exp(A h / 2)
    push: Matrix  # h / 2 phi_1(A h / 2)
    turn: Matrix  # (exp(A h / 2) - 1) push
    first: Matrix  # h (phi_1 - 3 phi_2 + 4 phi_3)
    middle: Matrix  # h (2 phi_2 - 4 phi_3)
    last: Matrix  # h (4 phi_3 - phi_2)


class Weights(NamedTuple):
    """By what the rest of a motor with effects acts over one step."""

    push: Matrix  # h phi_1(A h)
    linear: Matrix  # A
    step: Float[Array, "*#batch"]  # s
    stages: Stages | None = None  # where the rest changes within a step


class Propagator(NamedTuple):
    """Everything about a motor and a step length that does not change from step to step.

    x(h) = whole x + inputs u is exact for the linear motor. With effects the step is one of the equal parts of
    a sample, and the inputs are part of the rest, for which there are `weights`.
    """

    whole: Matrix  # exp(A h)
    inputs: Float[Array, "n 2 *#batch"]  # h phi_1(A h) B
    weights: Weights | None = None


def propagator(motor: Motor, step: Float[Array, ""], drive: Drive) -> Propagator:
    """Exact step of the linear part over `step` seconds, and the weights for what the effects add.

    **Source**: ETDRK4, Cox, Matthews, Journal of Computational Physics 176 (2002), equations (26)-(29),
    doi:10.1006/jcph.2002.6995.
    """
    A, B = _linear_part(motor, drive)
    if motor.affine:
        _, (phi0, phi1) = phi_functions(A * step, 1)
        inputs = step * product(phi1, B)
        if not motor.effects:
            return Propagator(phi0, inputs)
        return Propagator(phi0, inputs, Weights(step * phi1, A, step * jnp.ones_like(motor.R)))
    (half0, half1, *_), (phi0, phi1, phi2, phi3) = phi_functions(A * step, 3)
    push = step / 2 * half1
    stages = Stages(
        half=half0,
        push=push,
        turn=product(half0, push) - push,
        first=step * (phi1 - 3 * phi2 + 4 * phi3),
        middle=step * (2 * phi2 - 4 * phi3),
        last=step * (4 * phi3 - phi2),
    )
    weights = Weights(step * phi1, A, step * jnp.ones_like(motor.R), stages)
    return Propagator(phi0, step * product(phi1, B), weights)


def _linear_part(motor: Motor, drive: Drive) -> tuple[Matrix, Float[Array, "n 2 *#batch"]]:
    """A and B of the linear motor, with the states of its linear effects."""
    A, B = motor.state_space(drive)
    linear = tuple(e for effect in motor.effects if (e := effect.linear()) is not None)
    if not linear:
        return A, B
    core = eqx.tree_at(lambda m: m.effects, motor, linear)
    zero, one = jnp.zeros_like(motor.R), jnp.ones_like(motor.R)
    count = 2 + len(core.states)
    columns = []
    for k in range(count):
        state = _state(core, tuple(one if j == k else zero for j in range(count)), {})
        columns.append(jnp.stack(_vector(core, core.derivative(state, zero, zero, drive))))
    A = jnp.stack(columns, 1)
    return A, jnp.concatenate([B, jnp.zeros_like(A[2:, :2])])


def steps_in_sample(motor: Motor, tape: Tape) -> int | Int[Array, ""]:
    """Into how many equal steps a sample is divided, so that none is longer than the effects allow."""
    allowed = [e.longest_step for e in motor.effects if e.holds or not e.affine]
    if not allowed:
        return 1
    least = min(max(round(tape.longest / min(allowed)), 1), FINEST)
    current = jnp.max(jnp.abs(jnp.asarray(tape.measured)[:, 0]))
    rates = [rate for e in motor.effects if (rate := e.stiffens(motor, current)) is not None]
    if not rates:
        return least
    # of a population, as most of it needs: what a wild one needs would hold up all
    needed = jnp.ceil(jnp.median(reduce(jnp.maximum, rates)) * tape.longest / STIFF)
    return jnp.clip(jnp.nan_to_num(needed, nan=FINEST), least, FINEST).astype(int)


def held_step(
    motor: Motor,
    along: Propagator,
    drive: Drive,
    state: State,
    value: Scalars,
    load: Scalars,
    steps: int | Int[Array, ""] = 1,
) -> State:
    """The state one held sample later, in `steps` equal steps, for one of which `along` is made.

    Motors whose effects leave them linear: exact. Otherwise the linear part is exact and the rest goes by the
    four stages of ETDRK4, in which dry elements act in the direction the step began with; a step in which a
    held state crosses zero is then mended by `_cross`, so that friction sticks at exactly zero without any
    smoothing.
    """
    whole, inputs, weights = along
    if weights is None:
        # the state last: two fused multiply-adds, where a sum of sums would take an addition more
        current, speed = _times(whole, (state.current, state.speed), _times(inputs, (value, load)))
        return State(current, speed, state.extra)
    if isinstance(steps, int) and steps == 1:
        return _step(motor, whole, weights, drive, state, value, load)
    return jax.lax.fori_loop(
        0, steps, lambda _, now: _step(motor, whole, weights, drive, now, value, load), state
    )


def _step(
    motor: Motor,
    whole: Matrix,
    weights: Weights,
    drive: Drive,
    state: State,
    value: Scalars,
    load: Scalars,
) -> State:
    all_push, linear, h, stages = weights
    moving = (jnp.sign(state.current), jnp.sign(state.speed))
    x, slow = _vector(motor, state), _slow(motor, state)
    moved = _times(whole, x)

    def rates(x, slow):
        """What the linear part leaves over, and the rates of the states that are not in it."""
        rate = motor.derivative(_state(motor, x, slow), value, load, drive, moving)
        left = _add(_vector(motor, rate), _times(-linear, x)), _slow(motor, rate)
        return left if stages is None else _once(left, jnp.all(h > 0))

    n0, s0 = rates(x, slow)
    if stages is None:
        moved, slow = _add(moved, _times(all_push, n0)), _shifted(slow, h, s0)
    else:
        half, push, turn, first, middle, last = stages
        halfway = _times(half, x)
        n1, s1 = rates(_add(halfway, _times(push, n0)), _shifted(slow, h / 2, s0))
        n2, s2 = rates(_add(halfway, _times(push, n1)), _shifted(slow, h / 2, s1))
        end = _add(moved, _times(2 * push, n2), _times(turn, n0))
        n3, s3 = rates(end, _shifted(slow, h, s2))
        moved = _add(moved, _times(first, n0), _times(middle, _add(n1, n2)), _times(last, n3))
        slow = _shifted(slow, h / 6, {k: s0[k] + 2 * (s1[k] + s2[k]) + s3[k] for k in slow})
    if motor.sticks:
        now, still = motor.at(state), state._replace(current=0.0 * x[0], speed=0.0 * x[1])
        begun = _add(n0, _times(linear, x))
        for row, holds, unit in ((1, "speed", 1 / now.J), (0, "current", drive.voltage / now.L)):
            hold, ahead = motor.grip(holds, still), motor.grip(holds, _state(motor, moved, slow))
            if hold is not None and ahead is not None:
                push, decay = all_push[:, row] * unit, -linear[row, row] * h
                # a branch, though most blocks have something to mend: without it XLA computes the whole step anew
                # for each intermediate result, and a population takes twice as long
                moved = jax.lax.cond(
                    jnp.any(jnp.sign(x[row]) * moved[row] <= 0),
                    partial(_cross, row),
                    lambda grips, before, after, *_: after,
                    *((hold, ahead), x, moved, begun[row] / unit, push, decay),
                )
    return _state(motor, moved, slow)


def _once(values: T, always: Bool[Array, ""]) -> T:
    """The same values, behind a branch that is always taken: XLA, which would compute them anew for each of all that
    depends on them, computes them once. A play of teeth is simulated in three quarters of the time."""
    return jax.lax.cond(always, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)


def _cross(
    row: int,
    grips: tuple[Grip, Grip],
    before: Vector,
    after: Vector,
    begun: Scalars,
    push: Float[Array, "n *#batch"],
    decay: Held,
) -> Vector:
    """Mend a step in which the state that a dry element holds comes to zero, or is there.

    For a part of the step the state moved on as it did before; for the rest of it the element takes
    whatever, within its limits, ends the step at zero: if it can, the state sticks, at exactly zero.
    `grips` are those at zero and where the step would end; `begun` is the driving torque (or voltage) at the start
    of the step; `push` is what a unit of it over the whole step adds to the state, which by itself falls by
    exp(-`decay`).

    **Source**: time-stepping with set-valued forces, Moreau (1988), doi:10.1007/978-3-7091-2624-0_1, with the
    response of the exact linear step in place of h / J.
    """
    direction = jnp.sign(before[row])
    crosses = direction * after[row] <= 0
    # the guarded denominator keeps the derivative finite where the branch is not taken
    fall = jnp.where(crosses & (direction != 0), before[row] - after[row], 1.0)
    share = jnp.where(direction == 0, 0.0, before[row] / fall)
    # what a push from then on does, over what it does in the whole step: the state moves on an exponential
    rest = jnp.maximum((1.0 - share) / (1.0 + jnp.expm1(-decay) * share), 1e-12)
    # what already acts against the motion; then the same force, chosen anew, over what is left of the step
    hold, (backward, forward) = grips[0], jax.tree.map(lambda a, b: (a + b) / 2, *grips)
    acting = jnp.where(direction > 0, forward, jnp.where(direction < 0, -backward, 0.0))
    needed = acting + after[row] / (push[row] * rest)
    taken = jnp.where(needed > hold.forward, forward, needed)
    taken = jnp.where(needed < -hold.backward, -backward, taken)
    taken = jnp.where(direction == 0, needed - _loose(hold, begun, needed), taken)
    change = jnp.where(crosses, (acting - taken) * rest, 0.0)
    sticks = crosses & (taken == needed)
    # the other states follow this one, so they answer with the square of the time that is left
    mended = [x + push[k] * change * rest for k, x in enumerate(after)]
    mended[row] = jnp.where(sticks, 0.0, after[row] + push[row] * change)
    return tuple(mended)


def _loose(hold: Grip, begun: Scalars, mean: Scalars) -> Scalars:
    """What is left over, as a mean over the step, of a force beyond what holds a state at zero.

    The force goes on a straight line from what it has `begun` with, through its `mean` at half the step; where it
    comes to exceed the limit the state breaks loose, and not before.
    """
    end = 2 * mean - begun
    toward = jnp.sign(end)
    limit = jnp.where(end > 0, hold.forward, hold.backward)
    beyond = jnp.maximum(toward * end - limit, 0.0)
    rise = jnp.where(beyond > 0, toward * (end - begun), 1.0)
    at_once = jnp.maximum(toward * mean - limit, 0.0)
    later = beyond**2 / (2 * jnp.where(rise > 0, rise, 1.0))
    return toward * jnp.where(toward * begun < limit, later, at_once)


class Walk(NamedTuple):
    """Carried through the solve: the motor's state, and what is seen or gathered on the way."""

    state: Any
    seen: Any


class HeldInput(diffrax.AbstractSolver):
    """Advances the motor, or a whole population of it, by held samples; time counts steps.

    `advance(walk, step number) -> walk` applies `held_step`. Population and blocks lie inside the state, so
    that diffrax's loop condition stays a scalar; `vmap` outside would copy every buffer at every step.
    """

    advance: Callable[[Walk, Int[Array, ""]], Walk]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 4

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = self.advance(y0, jnp.round(t0).astype(jnp.int32))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def walk(solver: HeldInput, start: Walk, steps: int, saveat: diffrax.SaveAt) -> Any:
    """Take `steps` steps through diffrax and return what `saveat` asks for."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: y),
        solver,
        t0=0.0,
        t1=float(steps),
        dt0=1.0,
        y0=start,
        saveat=saveat,
        stepsize_controller=diffrax.ConstantStepSize(),
        max_steps=steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    return solution.ys


def along_grids(motor: Motor, tape: Tape) -> Propagator:
    """The propagator of one step on every grid of the tape, stacked in front."""
    steps = steps_in_sample(motor, tape)
    grids = [
        propagator(
            motor,
            tape.sample_time[g] / steps,
            Drive(*(jnp.asarray(share)[g] for share in tape.drive)),
        )
        for g in range(tape.sample_time.shape[0])
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *grids)


def pick_grid(
    grids: Propagator, tape: Tape, grid: Int[Array | np.ndarray, "..."]
) -> tuple[Propagator, Drive]:
    """Propagator and drive of one grid, or of one grid for each block."""
    return jax.tree.map(lambda leaf: leaf[grid], (grids, tape.drive))


def _times(matrix: Matrix, x: Vector, onto: Vector | None = None) -> Vector:
    """Matrix times vector, on top of another vector where one is given."""

    def row(i: int) -> Scalars:
        products = [matrix[i, j] * x_j for j, x_j in enumerate(x)]
        return reduce(add, products) if onto is None else reduce(add, products[::-1], onto[i])

    return tuple(row(i) for i in range(len(matrix)))


def _add(*vectors: Vector) -> Vector:
    return tuple(reduce(add, entries) for entries in zip(*vectors, strict=True))


def _linear_states(motor: Motor) -> list[str]:
    """States that effects add to the linear part."""
    linear = {name for e in motor.effects if e.linear() is not None for name in e.states}
    return sorted(linear)


def _vector(motor: Motor, state: State) -> Vector:
    return (state.current, state.speed, *(state.extra[name] for name in _linear_states(motor)))


def _slow(motor: Motor, state: State) -> dict[str, Scalars]:
    """The states that are not in the linear part."""
    linear = _linear_states(motor)
    return {name: x for name, x in state.extra.items() if name not in linear}


def _state(motor: Motor, x: Vector, slow: dict[str, Scalars]) -> State:
    return State(x[0], x[1], slow | dict(zip(_linear_states(motor), x[2:], strict=True)))


def _shifted(slow: dict, weight: Held, rates: dict) -> dict:
    return {name: slow[name] + weight * rates[name] for name in slow}
