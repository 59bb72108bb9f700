"""A diffrax solver for motors whose input is held between samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..effects.base import Grip, Scalars, State
from ..motor import Drive, Motor
from .exponential import Matrix, phi_functions, product

if TYPE_CHECKING:
    from .tape import Tape

Held = Float[Array, "*batch"]
Pair = tuple[Scalars, Scalars]  # of current and speed


class Stages(NamedTuple):
    """Weights of ETDRK4 for whatever is not the linear motor."""

    half: Matrix  # exp(A h / 2)
    push: Matrix  # h / 2 phi_1(A h / 2)
    turn: Matrix  # (exp(A h / 2) - 1) push
    first: Matrix  # h (phi_1 - 3 phi_2 + 4 phi_3)
    middle: Matrix  # h (2 phi_2 - 4 phi_3)
    last: Matrix  # h (4 phi_3 - phi_2)
    step: Float[Array, "*batch"]  # s


class Propagator(NamedTuple):
    """Everything about a motor and a step length that does not change from step to step.

    x(h) = whole x + inputs u is exact for the linear motor; only effects need `stages`.
    """

    whole: Matrix  # exp(A h)
    inputs: Matrix  # h phi_1(A h) B
    stages: Stages | None = None


def propagator(motor: Motor, step: Float[Array, ""], drive: Drive) -> Propagator:
    """Exact step of the linear part over `step` seconds, and the stage weights for what the effects add.

    **Source**: ETDRK4, Cox, Matthews, Journal of Computational Physics 176 (2002), equations (26)-(29),
    doi:10.1006/jcph.2002.6995.
    """
    A, B = motor.state_space(drive)
    if not motor.effects:
        _, (phi0, phi1) = phi_functions(A * step, 1)
        return Propagator(phi0, step * product(phi1, B))
    (half0, half1, *_), (phi0, phi1, phi2, phi3) = phi_functions(A * step, 3)
    inputs = step * product(phi1, B)
    push = step / 2 * half1
    stages = Stages(
        half=half0,
        push=push,
        turn=product(half0, push) - push,
        first=step * (phi1 - 3 * phi2 + 4 * phi3),
        middle=step * (2 * phi2 - 4 * phi3),
        last=step * (4 * phi3 - phi2),
        step=step * jnp.ones_like(motor.R),
    )
    return Propagator(phi0, inputs, stages)


def held_step(
    motor: Motor, along: Propagator, drive: Drive, state: State, value: Held, load: Held
) -> State:
    """The state one held sample later.

    Linear motors: exact. With effects: ETDRK4, the linear part exact and the rest by four stages, in which
    dry elements act in the direction the sample began with; a sample in which a held state crosses zero is
    then mended by `_cross`, so that friction sticks at exactly zero without any smoothing.
    """
    x = (state.current, state.speed)
    moved = _times(along.whole, x)
    if along.stages is None:
        return State(*_add(moved, _times(along.inputs, (value, load))), state.extra)
    half, push, turn, first, middle, last, h = along.stages
    moving = (jnp.sign(state.current), jnp.sign(state.speed))
    A, _ = motor.state_space(drive)

    def rates(x, extra):
        rate = motor.derivative(State(x[0], x[1], extra), value, load, drive, moving)
        return _add((rate.current, rate.speed), _times(-A, x)), rate.extra

    halfway = _times(half, x)
    n0, e0 = rates(x, state.extra)
    n1, e1 = rates(_add(halfway, _times(push, n0)), _shifted(state.extra, h / 2, e0))
    n2, e2 = rates(_add(halfway, _times(push, n1)), _shifted(state.extra, h / 2, e1))
    end = _add(moved, _times(2 * push, n2), _times(turn, n0))
    n3, e3 = rates(end, _shifted(state.extra, h, e2))
    moved = _add(moved, _times(first, n0), _times(middle, _add(n1, n2)), _times(last, n3))
    extra = {
        name: state.extra[name] + h / 6 * (e0[name] + 2 * (e1[name] + e2[name]) + e3[name])
        for name in state.extra
    }
    whole_push = first + 2 * middle + last
    moved = _cross(1, motor.grip("speed", state), x, moved, whole_push[:, 1] * (1 / motor.J))
    v = drive.voltage
    moved = _cross(0, motor.grip("current", state), x, moved, whole_push[:, 0] * (v / motor.L))
    return State(*moved, extra)


def _cross(
    row: int, grip: Grip | None, before: Pair, after: Pair, push: Float[Array, "2 *batch"]
) -> Pair:
    """Mend a step in which the state that a dry element holds comes to zero.

    For a share of the step the state moved on as it did before; for the rest of it the element takes
    whatever, within its limits, ends the step at zero: if it can, the state sticks, at exactly zero.
    `push[:, ...]` is what a unit of driving torque (or voltage) over the whole step adds to the state.

    **Source**: time-stepping with set-valued forces, Moreau (1988), doi:10.1007/978-3-7091-2624-0_1, with the
    response of the exact linear step in place of h / J.
    """
    if grip is None:
        return after
    direction = jnp.sign(before[row])
    crosses = direction * after[row] <= 0
    # the guarded denominator keeps the derivative finite where the branch is not taken
    fall = jnp.where(crosses & (direction != 0), before[row] - after[row], 1.0)
    share = jnp.where(direction == 0, 0.0, before[row] / fall)
    left = push[row] * jnp.maximum(1.0 - share, 1e-12)
    # what already acts against the motion; then the same force, chosen anew, over what is left of the step
    acting = jnp.where(direction > 0, grip.forward, jnp.where(direction < 0, -grip.backward, 0.0))
    needed = acting + after[row] / left
    taken = jnp.clip(needed, -grip.backward, grip.forward)
    change = jnp.where(crosses, (acting - taken) * jnp.maximum(1.0 - share, 1e-12), 0.0)
    sticks = crosses & (taken == needed)
    mended = [after[k] + push[k] * change for k in range(2)]
    mended[row] = jnp.where(sticks, 0.0, mended[row])
    return mended[0], mended[1]


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
    """The propagator on every grid of the tape, stacked in front."""
    grids = [
        propagator(
            motor, tape.sample_time[g], Drive(*(jnp.asarray(share)[g] for share in tape.drive))
        )
        for g in range(tape.sample_time.shape[0])
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *grids)


def pick_grid(
    grids: Propagator, tape: Tape, grid: Int[Array | np.ndarray, "..."]
) -> tuple[Propagator, Drive]:
    """Propagator and drive of one grid, or of one grid for each block."""
    return jax.tree.map(lambda leaf: leaf[grid], (grids, tape.drive))


def _times(matrix: Matrix, x: Pair) -> Pair:
    first, second = (matrix[i, 0] * x[0] + matrix[i, 1] * x[1] for i in range(2))
    return first, second


def _add(*vectors: Pair) -> Pair:
    first, second = (reduce(add, entries) for entries in zip(*vectors, strict=True))
    return first, second


def _shifted(extra: dict, weight: Held, rates: dict) -> dict:
    return {name: extra[name] + weight * rates[name] for name in extra}
