"""A diffrax solver for motors whose input is held between samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from .exponential import Matrix
from .propagator import (
    Held,
    Mean,
    Propagator,
    Slow,
    Vector,
    Weights,
    linear_states,
    state_of,
    vector,
)
from .switches import computed_once, contact_correction, mended_mean, stick_or_reverse

Time = float | Float[Array | np.ndarray, ""]  # of the solver: a count of steps


class Input(NamedTuple):
    """The inputs of a motor over one step."""

    drive: Drive
    value: Scalars  # driving voltage V, current A or torque N m: held, or its mean if it varies linearly
    load: Scalars  # N m
    rise: Scalars | None = None  # change of the driving value over the step; None if it is held

    def at(self, share: Scalars | float) -> Scalars:
        """The driving value after this share of the step."""
        return self.value if self.rise is None else self.value + (share - 0.5) * self.rise

    def part(self, middle: Scalars | float, share: Scalars | float) -> Input:
        """The inputs over a part of the step: `middle` and length of the part as shares of the step."""
        if self.rise is None:
            return self
        return self._replace(value=self.at(middle), rise=share * self.rise)


def held_step(
    motor: Motor,
    along: Propagator,
    acting: Input,
    state: State,
    steps: int | Int[Array, ""] = 1,
) -> State:
    """The state one sample later, in `steps` equal steps, for one of which `along` is made.

    Exact for a motor whose effects leave it linear. Otherwise the linear part is exact and the rest is integrated by
    the four stages of ETDRK4. Throughout a step dry elements act in the direction of motion at its start, and teeth
    touch or not as they did then. A step in which a held state crosses zero, or teeth touch or part, is then corrected
    (see `switches`), so that friction sticks at exactly zero and a gear knocks without any smoothing.
    """
    return held_step_and_mean(motor, along, acting, state, steps)[0]


def held_step_and_mean(
    motor: Motor,
    along: Propagator,
    acting: Input,
    state: State,
    steps: int | Int[Array, ""] = 1,
) -> tuple[State, State | None]:
    """The state one sample later as by `held_step`, and its mean over this sample.

    The mean is as accurate as the state, except in a step in which something switches; None if `along` has no `mean`.
    """
    if along.weights is None:
        return _linear_step(motor, along, acting, state)
    if isinstance(steps, int) and steps == 1:
        return _step(motor, along, acting, state)

    def step(
        k: int | Int[Array, ""], walked: tuple[State, State | None]
    ) -> tuple[State, State | None]:
        now, total = walked
        after, mean = _step(motor, along, acting.part((k + 0.5) / steps, 1 / steps), now)
        return after, jax.tree.map(lambda so_far, more: so_far + more / steps, total, mean)

    nothing = None if along.mean is None else jax.tree.map(lambda x: 0.0 * x, state)
    return jax.lax.fori_loop(0, steps, step, (state, nothing))


def _linear_step(
    motor: Motor, along: Propagator, acting: Input, state: State
) -> tuple[State, State | None]:
    x, inputs = (state.current, state.speed), (acting.value, acting.load)
    bend = None if acting.rise is None else _bend(motor, acting, state)

    def reached(made_by: Propagator | Mean) -> Vector:
        driven = _times(made_by.inputs, inputs)
        if bend is not None:
            driven = _add(driven, _times(_known(made_by.ramp), bend))
        # onto the driven part: two fused multiply-adds, where adding two sums would take one more addition
        return _times(made_by.whole, x, driven)

    current, speed = reached(along)
    after = State(current, speed, state.extra)
    if along.mean is None:
        return after, None
    current, speed = reached(along.mean)
    return after, State(current, speed, state.extra)


def _bend(motor: Motor, acting: Input, state: State) -> Vector:
    """Change of the derivative from start to end of a step due to a drive that varies linearly."""
    low, high = (
        vector(motor, motor.derivative(state, acting.at(end), acting.load, acting.drive))
        for end in (0.0, 1.0)
    )
    return tuple(b - a for a, b in zip(low, high, strict=True))


def _known(matrix: Matrix | None) -> Matrix:
    assert matrix is not None, "a propagator made for less"
    return matrix


def _step(
    motor: Motor, along: Propagator, acting: Input, state: State
) -> tuple[State, State | None]:
    teeth = motor.toothed
    if teeth is not None:
        touching = teeth.teeth(state).touch
        along = jax.tree.map(
            lambda a, b: jnp.where(touching, a, b),
            along._replace(apart=None, look=None),
            along.apart,
        )
    weights = along.weights
    assert weights is not None
    motor = motor.with_effects(e.averaged_over_step(state, weights.step) for e in motor.effects)
    rate, after, mean = _unswitched(motor, along, weights, acting, state)
    x, begun, moved = vector(motor, state), vector(motor, rate), vector(motor, after)
    slow = _slow(motor, after)
    if teeth is not None and weights.contact is not None:
        mend = contact_correction(teeth, weights.step, weights.contact, state, rate, after)
        moved = _add(moved, mend)
    if motor.switches:
        now, still = motor.at(state), state._replace(current=0.0 * x[0], speed=0.0 * x[1])
        for row, holds, unit in (
            (1, "speed", 1 / now.J),
            (0, "current", acting.drive.voltage / now.L),
        ):
            hold, ahead = motor.grip(holds, still), motor.grip(holds, state_of(motor, moved, slow))
            if hold is not None and ahead is not None:
                push, decay = weights.push[:, row] * unit, -weights.linear[row, row] * weights.step
                # a branch, although most blocks need the correction: without it XLA recomputes the whole step for
                # each intermediate result, and a population takes twice as long
                moved = jax.lax.cond(
                    jnp.any(jnp.sign(x[row]) * moved[row] <= 0),
                    partial(stick_or_reverse, row),
                    lambda grips, before, after, *_: after,
                    *((hold, ahead), x, moved, begun[row] / unit, push, decay),
                )
    if mean is not None:
        mend = mended_mean(state.speed, after.speed, moved[1])
        mean = mean._replace(speed=mean.speed + mend)
    return state_of(motor, moved, slow), mean


def _unswitched(
    motor: Motor, along: Propagator, weights: Weights, acting: Input, state: State
) -> tuple[State, State, State | None]:
    """Derivative at the start of a step, and the state at its end and its mean if nothing switches within it."""
    h, linear, always = weights.step, weights.linear, jnp.all(weights.step > 0)
    mean, averaging = None, along.mean
    moving = (jnp.sign(state.current), jnp.sign(state.speed))
    x, slow = vector(motor, state), _slow(motor, state)

    def rates(x: Vector, slow: Slow, when: float) -> tuple[Vector, Slow]:
        now = state_of(motor, x, slow)
        rate = motor.derivative(now, acting.at(when), acting.load, acting.drive, moving)
        return vector(motor, rate), _slow(motor, rate)

    if weights.stages is None:
        begun, s0 = computed_once(rates(x, slow, 0.5), always)
        bend = None if acting.rise is None else _bend(motor, acting, state)
        moved = _add(x, _times(weights.push, begun))
        if bend is not None:
            moved = _add(moved, _times(_known(along.ramp), bend))
        if averaging is not None:
            means = _add(x, _times(averaging.push, begun))
            if bend is not None:
                means = _add(means, _times(_known(averaging.ramp), bend))
            mean = state_of(motor, means, slow)
        return state_of(motor, begun, s0), state_of(motor, moved, _shifted(slow, h, s0)), mean

    def rest(x: Vector, slow: Slow, when: float) -> tuple[Vector, Slow]:
        """Derivatives less those of the linear part, and derivatives of the states that are not in it."""
        rate, slow = rates(x, slow, when)
        return computed_once((_add(rate, _times(-linear, x)), slow), always)

    half, half_input, half_minus_one, first, middle, last = weights.stages
    moved, halfway = _times(along.whole, x), _times(half, x)
    n0, s0 = rest(x, slow, 0.0)
    n1, s1 = rest(_add(halfway, _times(half_input, n0)), _shifted(slow, h / 2, s0), 0.5)
    n2, s2 = rest(_add(halfway, _times(half_input, n1)), _shifted(slow, h / 2, s1), 0.5)
    end = _add(moved, _times(2 * half_input, n2), _times(half_minus_one, n0))
    n3, s3 = rest(end, _shifted(slow, h, s2), 1.0)

    def on_top(of: Vector, first: Matrix, middle: Matrix, last: Matrix) -> Vector:
        """The contributions of the stages, added to that of the linear part."""
        return _add(of, _times(first, n0), _times(middle, _add(n1, n2)), _times(last, n3))

    moved = on_top(moved, first, middle, last)
    if averaging is not None:
        by_stage = map(_known, (averaging.first, averaging.middle, averaging.last))
        mean = state_of(motor, on_top(_times(averaging.whole, x), *by_stage), slow)
    slow = _shifted(slow, h / 6, {k: s0[k] + 2 * (s1[k] + s2[k]) + s3[k] for k in slow})
    begun = state_of(motor, _add(n0, _times(linear, x)), s0)
    return begun, state_of(motor, moved, slow), mean


def _slow(motor: Motor, state: State) -> Slow:
    """The states that are not in the linear part."""
    linear = linear_states(motor)
    return {name: x for name, x in state.extra.items() if name not in linear}


def _shifted(slow: Slow, weight: Held, rates: Slow) -> Slow:
    return {name: slow[name] + weight * rates[name] for name in slow}


def _times(matrix: Matrix, x: Vector, onto: Vector | None = None) -> Vector:
    """Matrix times vector, plus `onto` if given."""

    def row(i: int) -> Scalars:
        products = [matrix[i, j] * x_j for j, x_j in enumerate(x)]
        return reduce(add, products) if onto is None else reduce(add, products[::-1], onto[i])

    return tuple(row(i) for i in range(len(matrix)))


def _add(*vectors: Vector) -> Vector:
    return tuple(reduce(add, entries) for entries in zip(*vectors, strict=True))


class Walk(NamedTuple):
    """What is carried through the solve: the motor's state, and the outputs or sums of errors so far."""

    state: Any
    seen: Any


class HeldInput(diffrax.AbstractSolver):
    """Advances one motor or a whole population with held inputs; its time counts steps.

    `advance(walk, step number) -> walk` applies `held_step`, over one sample or one block. Population and blocks are
    axes of the state, so that diffrax's loop condition stays a scalar; an outer `vmap` would copy every buffer at
    every step.
    """

    advance: Callable[[Walk, Int[Array, ""]], Walk]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return 4

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Walk, args: None) -> None:
        return None

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Walk, args: None) -> Walk:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Walk,
        args: None,
        solver_state: None,
        made_jump: bool | Bool[Array | np.ndarray, ""],
    ) -> tuple[Walk, None, dict[str, Walk], None, diffrax.RESULTS]:
        y1 = self.advance(y0, jnp.round(t0).astype(jnp.int32))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def walk(solver: HeldInput, start: Walk, steps: int, saveat: diffrax.SaveAt) -> Any:
    """Take `steps` steps through diffrax and return what `saveat` asks for."""
    # jitted, because diffrax traces its step twice, which takes half a second for a motor with effects
    traced_once = HeldInput(jax.jit(solver.advance))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: y),
        traced_once,
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
