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
from .between_samples import value_on_line
from .exponential import Matrix
from .propagator import MeanPropagator, NonlinearStates, Propagator, Vector, Weights, linear_states, state_of, vector
from .switches import computed_once, contact_correction, mean_correction, stick_or_reverse

Time = float | Float[Array | np.ndarray, ""]  # of the solver: a count of steps


class Input(NamedTuple):
    """The inputs of a motor over one step."""

    drive: Drive
    value: Scalars  # driving voltage V, current A or torque N m: held, or its mean if it varies linearly
    load: Scalars  # N m
    rise: Scalars | None = None  # change of the driving value over the step; None if it is held

    def at(self, share: Scalars | float) -> Scalars:
        """The driving value after this share of the step."""
        return value_on_line(self.value, self.rise, share)

    def part(self, middle: Scalars | float, share: Scalars | float) -> Input:
        """The inputs over a part of the step: `middle` and length of the part as shares of the step."""
        if self.rise is None:
            return self
        return self._replace(value=self.at(middle), rise=share * self.rise)


def held_step(
    motor: Motor, propagator: Propagator, acting: Input, state: State, steps: int | Int[Array, ""] = 1
) -> State:
    """The state one sample later, in `steps` equal steps, for one of which `propagator` is made.

    Exact for a motor whose effects leave it linear. Otherwise the linear part is exact and the rest is integrated by
    the four stages of ETDRK4. Throughout a step dry elements act in the direction of motion at its start, and teeth
    touch or not as they did then. A step in which a held state crosses zero, or teeth touch or part, is then corrected
    (see `switches`), so that friction sticks at exactly zero and a gear knocks without any smoothing.
    """
    return held_step_and_mean(motor, propagator, acting, state, steps)[0]


def held_step_and_mean(
    motor: Motor, propagator: Propagator, acting: Input, state: State, steps: int | Int[Array, ""] = 1
) -> tuple[State, State | None]:
    """The state one sample later as by `held_step`, and its mean over this sample.

    The mean is as accurate as the state, except in a step in which something switches; None if `propagator` has no
    `mean`.
    """
    if propagator.weights is None:
        return _linear_step(motor, propagator, acting, state)
    if isinstance(steps, int) and steps == 1:
        return _step(motor, propagator, acting, state)

    def step(k: int | Int[Array, ""], walked: tuple[State, State | None]) -> tuple[State, State | None]:
        now, total = walked
        after, mean = _step(motor, propagator, acting.part((k + 0.5) / steps, 1 / steps), now)
        return after, jax.tree.map(lambda so_far, more: so_far + more / steps, total, mean)

    nothing = None if propagator.mean is None else jax.tree.map(lambda x: 0.0 * x, state)
    return jax.lax.fori_loop(0, steps, step, (state, nothing))


def _linear_step(motor: Motor, propagator: Propagator, acting: Input, state: State) -> tuple[State, State | None]:
    x, inputs = (state.current, state.speed), (acting.value, acting.load)
    change = None if acting.rise is None else _rate_change(motor, acting, state)

    def reached(made_by: Propagator | MeanPropagator) -> Vector:
        driven = _times(made_by.inputs, inputs)
        if change is not None:
            driven = _add(driven, _times(_required(made_by.ramp), change))
        # onto the driven part: two fused multiply-adds, where adding two sums would take one more addition
        return _times(made_by.transition, x, driven)

    current, speed = reached(propagator)
    after = State(current, speed, state.extra)
    if propagator.mean is None:
        return after, None
    current, speed = reached(propagator.mean)
    return after, State(current, speed, state.extra)


def _rate_change(motor: Motor, acting: Input, state: State) -> Vector:
    """Change of the derivative from start to end of a step due to a drive that varies linearly."""
    low, high = (
        vector(motor, motor.derivative(state, acting.at(end), acting.load, acting.drive)) for end in (0.0, 1.0)
    )
    return tuple(b - a for a, b in zip(low, high, strict=True))


def _required(matrix: Matrix | None) -> Matrix:
    assert matrix is not None, "a propagator made for less"
    return matrix


def _step(motor: Motor, propagator: Propagator, acting: Input, state: State) -> tuple[State, State | None]:
    teeth = motor.gear
    if teeth is not None:
        touching = teeth.teeth(state).touch
        propagator = jax.tree.map(
            lambda a, b: jnp.where(touching, a, b),
            propagator._replace(without_contact=None, reading=None, speed_seen=None),
            propagator.without_contact,
        )
    weights = propagator.weights
    assert weights is not None
    motor = motor.with_effects(e.averaged_over_step(state, weights.step) for e in motor.effects)
    advance = _affine_step if weights.stages is None else _etdrk4_step
    rate, after, mean = advance(motor, propagator, weights, acting, state)
    end = vector(motor, after)
    if teeth is not None and weights.contact is not None:
        correction = contact_correction(teeth, weights.step, weights.contact, state, rate, after)
        end = _add(end, correction)
    corrected = state_of(motor, end, _nonlinear_states(motor, after))
    if motor.switches:
        corrected = _correct_dry_elements(motor, weights, acting, state, rate, corrected)
    if mean is not None:
        mean = mean._replace(
            current=mean.current + mean_correction(state.current, after.current, corrected.current),
            speed=mean.speed + mean_correction(state.speed, after.speed, corrected.speed),
        )
    return corrected, mean


def _correct_dry_elements(
    motor: Motor, weights: Weights, acting: Input, state: State, rate: State, after: State
) -> State:
    """The end of a step, corrected where speed or current reaches zero; `state` and `rate` are those at its start."""
    start, start_rate = vector(motor, state), vector(motor, rate)
    end, nonlinear = vector(motor, after), _nonlinear_states(motor, after)
    now = motor.at(state)
    at_rest = state._replace(current=0.0 * state.current, speed=0.0 * state.speed)
    for row, holds, unit in ((1, "speed", 1 / now.J), (0, "current", acting.drive.voltage / now.L)):
        grip_at_rest = motor.grip(holds, at_rest)
        grip_at_end = motor.grip(holds, state_of(motor, end, nonlinear))
        if grip_at_rest is not None and grip_at_end is not None:
            response = weights.rate_response[:, row] * unit
            decay = -weights.A[row, row] * weights.step
            # a branch, although most blocks need the correction: without it XLA recomputes the whole step for
            # each intermediate result, and a population takes twice as long
            end = jax.lax.cond(
                jnp.any(jnp.sign(start[row]) * end[row] <= 0),
                partial(stick_or_reverse, row),
                lambda grips, before, after, *_: after,
                *((grip_at_rest, grip_at_end), start, end, start_rate[row] / unit, response, decay),
            )
    return state_of(motor, end, nonlinear)


# Derivative at the start of a step, and the state at its end and its mean, if nothing switches within it
Unswitched = tuple[State, State, State | None]


def _affine_step(motor: Motor, propagator: Propagator, weights: Weights, acting: Input, state: State) -> Unswitched:
    """A step of a motor that its effects leave linear."""
    x, nonlinear = vector(motor, state), _nonlinear_states(motor, state)
    rates = _rates(motor, acting, state, x, nonlinear, 0.5)
    x_rate, other_rates = computed_once(rates, jnp.all(weights.step > 0))
    change = None if acting.rise is None else _rate_change(motor, acting, state)
    end = _add(x, _times(weights.rate_response, x_rate))
    if change is not None:
        end = _add(end, _times(_required(propagator.ramp), change))
    after = state_of(motor, end, _shifted(nonlinear, weights.step, other_rates))
    mean, averaging = None, propagator.mean
    if averaging is not None:
        means = _add(x, _times(averaging.rate_response, x_rate))
        if change is not None:
            means = _add(means, _times(_required(averaging.ramp), change))
        mean = state_of(motor, means, nonlinear)
    return state_of(motor, x_rate, other_rates), after, mean


def _etdrk4_step(motor: Motor, propagator: Propagator, weights: Weights, acting: Input, state: State) -> Unswitched:
    """A step by the four stages of ETDRK4."""
    assert weights.stages is not None
    half, half_input, half_minus_one, first, middle, last = weights.stages
    h, always = weights.step, jnp.all(weights.step > 0)
    x, nonlinear = vector(motor, state), _nonlinear_states(motor, state)

    def rest(x: Vector, nonlinear: NonlinearStates, when: float) -> tuple[Vector, NonlinearStates]:
        """Derivatives less those of the linear part, and derivatives of the states that are not in it."""
        rate, other_rates = _rates(motor, acting, state, x, nonlinear, when)
        return computed_once((_add(rate, _times(-weights.A, x)), other_rates), always)

    linear_end, halfway = _times(propagator.transition, x), _times(half, x)
    n0, s0 = rest(x, nonlinear, 0.0)
    n1, s1 = rest(_add(halfway, _times(half_input, n0)), _shifted(nonlinear, h / 2, s0), 0.5)
    n2, s2 = rest(_add(halfway, _times(half_input, n1)), _shifted(nonlinear, h / 2, s1), 0.5)
    end = _add(linear_end, _times(2 * half_input, n2), _times(half_minus_one, n0))
    n3, s3 = rest(end, _shifted(nonlinear, h, s2), 1.0)

    def with_stages(linear: Vector, first: Matrix, middle: Matrix, last: Matrix) -> Vector:
        """The contribution of the linear part plus those of the stages."""
        return _add(linear, _times(first, n0), _times(middle, _add(n1, n2)), _times(last, n3))

    end = with_stages(linear_end, first, middle, last)
    mean, averaging = None, propagator.mean
    if averaging is not None:
        by_stage = map(_required, (averaging.first, averaging.middle, averaging.last))
        means = with_stages(_times(averaging.transition, x), *by_stage)
        mean = state_of(motor, means, nonlinear)
    simpson = {k: s0[k] + 2 * (s1[k] + s2[k]) + s3[k] for k in nonlinear}
    after = state_of(motor, end, _shifted(nonlinear, h / 6, simpson))
    return state_of(motor, _add(n0, _times(weights.A, x)), s0), after, mean


def _rates(
    motor: Motor, acting: Input, start: State, x: Vector, nonlinear: NonlinearStates, when: float
) -> tuple[Vector, NonlinearStates]:
    """Derivatives at a share `when` of a step, with dry elements acting in the direction of motion at its start."""
    now = state_of(motor, x, nonlinear)
    moving = (jnp.sign(start.current), jnp.sign(start.speed))
    rate = motor.derivative(now, acting.at(when), acting.load, acting.drive, moving)
    return vector(motor, rate), _nonlinear_states(motor, rate)


def _nonlinear_states(motor: Motor, state: State) -> NonlinearStates:
    """The states that are not in the linear part."""
    linear = linear_states(motor)
    return {name: x for name, x in state.extra.items() if name not in linear}


def _shifted(nonlinear: NonlinearStates, weight: Scalars, rates: NonlinearStates) -> NonlinearStates:
    return {name: nonlinear[name] + weight * rates[name] for name in nonlinear}


def _times(matrix: Matrix, x: Vector, onto: Vector | None = None) -> Vector:
    """Matrix times vector, plus `onto` if given."""

    def row(i: int) -> Scalars:
        products = [matrix[i, j] * x_j for j, x_j in enumerate(x)]
        return reduce(add, products) if onto is None else reduce(add, products[::-1], onto[i])

    return tuple(row(i) for i in range(len(matrix)))


def _add(*vectors: Vector) -> Vector:
    return tuple(reduce(add, entries) for entries in zip(*vectors, strict=True))


class Carry(NamedTuple):
    """What is carried through the solve: the motor's state, and the outputs or sums of errors so far."""

    state: Any
    output: Any


class StepSolver(diffrax.AbstractSolver):
    """Advances one motor or a whole population with held inputs; its time counts steps.

    `advance(carry, step number) -> carry` applies `held_step`, over one sample or one block. Population and blocks are
    axes of the state, so that diffrax's loop condition stays a scalar; an outer `vmap` would copy every buffer at
    every step.
    """

    advance: Callable[[Carry, Int[Array, ""]], Carry]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return 4

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Carry, args: None) -> None:
        return None

    def func(self, terms: diffrax.AbstractTerm, t0: Time, y0: Carry, args: None) -> Carry:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Carry,
        args: None,
        solver_state: None,
        made_jump: bool | Bool[Array | np.ndarray, ""],
    ) -> tuple[Carry, None, dict[str, Carry], None, diffrax.RESULTS]:
        y1 = self.advance(y0, jnp.round(t0).astype(jnp.int32))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def take_steps(solver: StepSolver, start: Carry, steps: int, saveat: diffrax.SaveAt) -> Any:
    """Take `steps` steps through diffrax and return what `saveat` asks for."""
    # jitted, because diffrax traces its step twice, which takes half a second for a motor with effects
    traced_once = StepSolver(jax.jit(solver.advance))
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
