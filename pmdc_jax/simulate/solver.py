"""A diffrax solver for motors whose input is held between samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from .exponential import Matrix, phi_functions, product
from .switches import computed_once, contact_correction, contact_response, stick_or_reverse

if TYPE_CHECKING:
    from .tape import Tape

Held = Float[Array, "*#batch"]
Time = float | Float[Array | np.ndarray, ""]  # of the solver: it counts steps
Vector = tuple[Scalars, ...]  # current, speed, and the states of linear effects
Slow = dict[str, Scalars]  # the states that are not in the linear part, by name

# Steps into which a sample is divided at most
FINEST = 32
# Over one step what is not in the linear part lets a state fall by no more than exp(-1)
STIFF = 1.0


class Input(NamedTuple):
    """What acts on a motor over a step."""

    drive: Drive
    value: Scalars  # of what drives, V, A or N m: held, or the mean of a straight line
    load: Scalars  # N m
    rise: Scalars | None = None  # of the value in all, where it is not held

    def at(self, share: Scalars | float) -> Scalars:
        """The value after such a share of the step."""
        return self.value if self.rise is None else self.value + (share - 0.5) * self.rise

    def part(self, middle: Scalars | float, share: Scalars | float) -> Input:
        """What acts over such a share of the step, about its `middle`."""
        if self.rise is None:
            return self
        return self._replace(value=self.at(middle), rise=share * self.rise)


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


@eqx.filter_jit  # one trace serves all grids
def propagator(motor: Motor, step: Held, drive: Drive, straight: bool = False) -> Propagator:
    """Exact step of the linear part over `step` seconds, and the weights for what the effects add; of teeth that touch,
    and beside it of such that do not. `straight` asks for what a drive needs that is not held."""
    A, B = _linear_part(motor, drive)
    along = _by_linear_part(motor, step, A, B, straight)
    teeth = motor.toothed
    if teeth is None:
        return along
    assert teeth.contact_state is not None
    open_teeth = motor.with_effects(e.without_contact() for e in motor.effects)
    A_apart, _ = _linear_part(open_teeth, drive)
    apart = _by_linear_part(motor, step, A_apart, B, straight)
    push = (A - A_apart)[:, 2 + _linear_states(motor).index(teeth.contact_state)]
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
) -> Propagator:
    """The propagator of a motor whose linear part is A and B.

    **Source**: ETDRK4, Cox, Matthews, Journal of Computational Physics 176 (2002), equations (26)-(29),
    doi:10.1006/jcph.2002.6995.
    """
    if motor.affine:
        _, (phi0, phi1, *phi2) = phi_functions(A * step, 2 if straight else 1)
        inputs = step * product(phi1, B)
        ramp = step * (phi2[0] - phi1 / 2) if straight else None
        weights = None
        if motor.effects:
            weights = Weights(step * phi1, A, step * jnp.ones_like(motor.R))
        return Propagator(phi0, inputs, weights, ramp=ramp)
    (half0, half1, *_), (phi0, phi1, phi2, phi3) = phi_functions(A * step, 3)
    half_input = step / 2 * half1
    stages = Stages(
        half=half0,
        half_input=half_input,
        half_minus_one=product(half0, half_input) - half_input,
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
    core = motor.with_effects(linear)
    zero, one = jnp.zeros_like(motor.R), jnp.ones_like(motor.R)
    count = 2 + len(core.states)
    columns = []
    for k in range(count):
        state = _state(core, tuple(one if j == k else zero for j in range(count)), {})
        columns.append(jnp.stack(_vector(core, core.derivative(state, zero, zero, drive))))
    A = jnp.stack(columns, 1)
    return A, jnp.concatenate([B, jnp.zeros_like(A[2:, :2])])


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


def held_step(
    motor: Motor,
    along: Propagator,
    acting: Input,
    state: State,
    steps: int | Int[Array, ""] = 1,
) -> State:
    """The state one sample later, in `steps` equal steps, for one of which `along` is made.

    Motors whose effects leave them linear: exact. Otherwise the linear part is exact and the rest goes by the
    four stages of ETDRK4, in which dry elements act in the direction the step began with, and teeth touch or not as
    they then did. A step in which a held state crosses zero, or teeth touch or part, is then mended (`switches`), so
    that friction sticks at exactly zero and a gear knocks without any smoothing.
    """
    if along.weights is None:
        # the state last: two fused multiply-adds, where a sum of sums would take an addition more
        driven = _times(along.inputs, (acting.value, acting.load))
        if acting.rise is not None:
            driven = _add(driven, _bend(motor, along, acting, state))
        current, speed = _times(along.whole, (state.current, state.speed), driven)
        return State(current, speed, state.extra)
    if isinstance(steps, int) and steps == 1:
        return _step(motor, along, acting, state)

    def step(k: int | Int[Array, ""], now: State) -> State:
        return _step(motor, along, acting.part((k + 0.5) / steps, 1 / steps), now)

    return jax.lax.fori_loop(0, steps, step, state)


def _bend(motor: Motor, along: Propagator, acting: Input, state: State) -> Vector:
    """What a drive that rises on a straight line does in a step, beyond what its mean does."""
    assert along.ramp is not None, "a propagator for held drives"
    low, high = (
        _vector(motor, motor.derivative(state, acting.at(end), acting.load, acting.drive))
        for end in (0.0, 1.0)
    )
    return _times(along.ramp, tuple(b - a for a, b in zip(low, high, strict=True)))


def _step(motor: Motor, along: Propagator, acting: Input, state: State) -> State:
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
    rate, after = _unswitched(motor, along, weights, acting, state)
    x, begun, moved = _vector(motor, state), _vector(motor, rate), _vector(motor, after)
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
            hold, ahead = motor.grip(holds, still), motor.grip(holds, _state(motor, moved, slow))
            if hold is not None and ahead is not None:
                push, decay = weights.push[:, row] * unit, -weights.linear[row, row] * weights.step
                # a branch, though most blocks have something to mend: without it XLA computes the whole step anew
                # for each intermediate result, and a population takes twice as long
                moved = jax.lax.cond(
                    jnp.any(jnp.sign(x[row]) * moved[row] <= 0),
                    partial(stick_or_reverse, row),
                    lambda grips, before, after, *_: after,
                    *((hold, ahead), x, moved, begun[row] / unit, push, decay),
                )
    return _state(motor, moved, slow)


def _unswitched(
    motor: Motor, along: Propagator, weights: Weights, acting: Input, state: State
) -> tuple[State, State]:
    """The rate at which a step begins, and how it ends if dry elements and teeth go on as they began."""
    h, linear, always = weights.step, weights.linear, jnp.all(weights.step > 0)
    moving = (jnp.sign(state.current), jnp.sign(state.speed))
    x, slow = _vector(motor, state), _slow(motor, state)

    def rates(x: Vector, slow: Slow, when: float) -> tuple[Vector, Slow]:
        now = _state(motor, x, slow)
        rate = motor.derivative(now, acting.at(when), acting.load, acting.drive, moving)
        return _vector(motor, rate), _slow(motor, rate)

    if weights.stages is None:
        begun, s0 = computed_once(rates(x, slow, 0.5), always)
        moved = _add(x, _times(weights.push, begun))
        if acting.rise is not None:
            moved = _add(moved, _bend(motor, along, acting, state))
        return _state(motor, begun, s0), _state(motor, moved, _shifted(slow, h, s0))

    def rest(x: Vector, slow: Slow, when: float) -> tuple[Vector, Slow]:
        """What the linear part leaves over, and the rates of the states that are not in it."""
        rate, slow = rates(x, slow, when)
        return computed_once((_add(rate, _times(-linear, x)), slow), always)

    half, half_input, half_minus_one, first, middle, last = weights.stages
    moved, halfway = _times(along.whole, x), _times(half, x)
    n0, s0 = rest(x, slow, 0.0)
    n1, s1 = rest(_add(halfway, _times(half_input, n0)), _shifted(slow, h / 2, s0), 0.5)
    n2, s2 = rest(_add(halfway, _times(half_input, n1)), _shifted(slow, h / 2, s1), 0.5)
    end = _add(moved, _times(2 * half_input, n2), _times(half_minus_one, n0))
    n3, s3 = rest(end, _shifted(slow, h, s2), 1.0)
    moved = _add(moved, _times(first, n0), _times(middle, _add(n1, n2)), _times(last, n3))
    slow = _shifted(slow, h / 6, {k: s0[k] + 2 * (s1[k] + s2[k]) + s3[k] for k in slow})
    return _state(motor, _add(n0, _times(linear, x)), s0), _state(motor, moved, slow)


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
    # diffrax traces its step twice, and that of a motor with effects takes half a second
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


def along_grids(motor: Motor, tape: Tape) -> Propagator:
    """The propagator of one step on every grid of the tape, stacked in front."""
    steps, delay = steps_in_sample(motor, tape), motor.speed_delay()

    def of_grid(g: int) -> Propagator:
        sample = jnp.asarray(tape.sample_time)[g]
        drive = Drive(*(jnp.asarray(share)[g] for share in tape.drive))
        straight = tape.rise is not None
        along = propagator(motor, sample / steps, drive, straight)
        if delay is None:
            return along
        samples = jnp.asarray(delay / sample)
        share = 1 - (samples - jnp.floor(samples))
        part = propagator(motor, share * sample / steps, drive, straight)
        return along._replace(look=Look(part, share))

    grids = map(of_grid, range(tape.sample_time.shape[0]))
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


def _slow(motor: Motor, state: State) -> Slow:
    """The states that are not in the linear part."""
    linear = _linear_states(motor)
    return {name: x for name, x in state.extra.items() if name not in linear}


def _state(motor: Motor, x: Vector, slow: Slow) -> State:
    return State(x[0], x[1], slow | dict(zip(_linear_states(motor), x[2:], strict=True)))


def _shifted(slow: Slow, weight: Held, rates: Slow) -> Slow:
    return {name: slow[name] + weight * rates[name] for name in slow}
