"""Switching within a step: dry elements that come to rest, teeth that touch or part.

A step is first taken as if nothing switched, and then corrected: up to the switch its motion is right, and from then
on the change of the force acts for the rest of the step.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects.base import AbstractEffect, Grip, Scalars, State
from .exponential import Matrix, phi_functions

T = TypeVar("T")

# Durations of a push, as shares of a step, at which its response is evaluated: Chebyshev nodes
SHARES = (1 - np.cos(np.pi * (np.arange(6) + 0.5) / 6)) / 2
POWERS_FROM_NODES = np.linalg.inv(np.vander(SHARES, increasing=True))


def computed_once(values: T, always: Bool[Array, ""]) -> T:
    """The same values, behind a branch that is always taken, so that XLA on CPU computes them once.

    Without it XLA recomputes them for everything that depends on them; with it a gear with backlash is simulated in
    half the time. On an accelerator, where a branch has to wait for the host, the values are left as they are.
    """

    def behind_a_branch(values: T) -> T:
        return jax.lax.cond(always, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)

    return jax.lax.platform_dependent(values, cpu=behind_a_branch, default=lambda v: v)


def contact_response(
    A: Matrix, push: Float[Array, "n *#batch"], step: Float[Array, ""]
) -> Float[Array, "powers n *#batch"]:
    """Response, at the end of a step, to a constant push over the last `share` of it, divided by that share: the
    coefficients of h phi_1(share A h) push as a polynomial in the share."""
    at = SHARES.reshape(-1, *[1] * A[0, 0].ndim)
    _, (_, phi1) = phi_functions(step * at * A[:, :, None], 1)
    pushed = step * (phi1 * push[None, :, None]).sum(1)
    return jnp.einsum("pn,in...->pi...", POWERS_FROM_NODES, pushed)


def contact_correction(
    effect: AbstractEffect,
    step: Scalars,
    contact: Float[Array, "powers n *#batch"],
    before: State,
    rate: State,
    after: State,
) -> tuple[Scalars, ...]:
    """Correction to the end of a step in which teeth touch or part.

    The instant of switching, and the torque that the teeth begin or cease to pass from then on, come from parabolas
    through overlap and compression at both ends of the step, with their slopes at its start.

    **Arguments**: `step`, s; `contact`, the response to that torque of the motor as it is after the switch (see
    `contact_response`); `before`, `rate`, the state at the start and its derivative; `after`, the state at the end if
    nothing switched.
    """
    start = effect.teeth(before)
    touched = start.touch
    side = jnp.where(touched, start.side, effect.teeth(after).side)

    def overlap_and_compression(state: State) -> Float[Array, "2 *#batch"]:
        teeth = effect.teeth(state, side)
        return jnp.stack([teeth.overlap, teeth.compression])

    first, slope = jax.jvp(overlap_and_compression, (before,), (rate,))
    last, slope = overlap_and_compression(after), slope * step
    quadratic = last - first - slope
    instant = _instant_of_switch(first, slope, last, touched)
    switches = jnp.where(touched, jnp.any(last <= 0, axis=0), jnp.all(last > 0, axis=0))
    sign = jnp.where(switches, jnp.where(touched, -side, side), 0.0)
    torque = sign * (first[1] + instant * (slope[1] + instant * quadratic[1]))
    torque_slope = sign * (slope[1] + 2 * instant * quadratic[1])
    sizes = _response_to_parabola(len(contact), torque, torque_slope, sign * 2 * quadratic[1], 1 - instant)
    sizes = computed_once(sizes, jnp.all(step > 0))
    by_state = jnp.moveaxis(contact, 1, 0)
    return tuple(reduce(add, (size * term for size, term in zip(sizes, terms, strict=True))) for terms in by_state)


def _instant_of_switch(
    first: Float[Array, "2 *#batch"],
    slope: Float[Array, "2 *#batch"],
    last: Float[Array, "2 *#batch"],
    touched: Bool[Array | np.ndarray, "*#batch"],
) -> Scalars:
    """The share of a step after which teeth touch or part, by parabolas of overlap and compression over it: from their
    first value and slope, per step, to the last value.

    They touch once both have risen through zero, and part once compression falls through it. If only overlap has
    fallen, compression has done so and risen again: such a graze is taken to part at the start.
    """
    direction = jnp.where(touched, -1.0, 1.0)
    crosses = (direction * first < 0) & (direction * last > 0)
    quadratic = last - first - slope
    root = jnp.sqrt(jnp.where(crosses, slope**2 - 4 * quadratic * first, 1.0))
    denominator = jnp.where(crosses, direction * slope + root, 1.0)
    instants = jnp.where(crosses, -2 * direction * first / denominator, 0.0)
    return jnp.where(touched, instants[1], jnp.max(instants, axis=0))


def _response_to_parabola(
    powers: int, torque: Scalars, slope: Scalars, curvature: Scalars, remaining: Scalars
) -> list[Scalars]:
    """The sizes of a response to powers of the time (see `contact_response`) after a torque that varies as a parabola:
    the response to a constant one, integrated once for its slope and twice for its curvature.

    **Arguments**: `remaining`, the share of the step for which the torque acts; `slope` and `curvature` per step.
    """
    sizes, power = [], remaining
    for p in range(1, powers + 1):
        by_slope = slope + remaining / (p + 2) * curvature
        sizes.append(power * (torque + remaining / (p + 1) * by_slope))
        power = power * remaining
    return sizes


def stick_or_reverse(
    row: int,
    grips: tuple[Grip, Grip],
    before: tuple[Scalars, ...],
    after: tuple[Scalars, ...],
    start_force: Scalars,
    response: Float[Array, "n *#batch"],
    decay: Scalars,
) -> tuple[Scalars, ...]:
    """Correct a step in which the state that a dry element acts on reaches zero, or starts there.

    Until it reaches zero, the state moves as computed. For the rest of the step the element exerts whatever force,
    within its limits, brings the state to zero at the end: if the limits allow it, the state sticks at exactly zero.

    **Arguments**: `row`, the index of the state; `grips`, the limits at zero and at the end of the step; `before`,
    `after`, the state vector at both ends of the uncorrected step; `start_force`, the driving torque (N m) or voltage
    (V) at the start; `response`, what a unit of it over the whole step adds to the state vector; `decay`, the decay
    rate of the state times the step.

    **Source**: time-stepping with set-valued forces, Moreau (1988), doi:10.1007/978-3-7091-2624-0_1, with the
    response of the exact linear step in place of h / J.
    """
    direction = jnp.sign(before[row])
    crosses = direction * after[row] <= 0
    share = _share_until_zero(before[row], after[row], crosses)
    # response to a push over the rest of the step, relative to one over the whole step: the motion is exponential
    rest_response = jnp.maximum((1.0 - share) / (1.0 + jnp.expm1(-decay) * share), 1e-12)
    # the force that has opposed the motion so far, and the one that would bring the state to zero at the end; beyond
    # the limits at zero the state slides on, with the mean of the limits at both ends
    at_rest, (backward, forward) = grips[0], jax.tree.map(lambda a, b: (a + b) / 2, *grips)
    opposing = jnp.where(direction > 0, forward, jnp.where(direction < 0, -backward, 0.0))
    needed = opposing + after[row] / (response[row] * rest_response)
    exerted = jnp.where(needed > at_rest.forward, forward, needed)
    exerted = jnp.where(needed < -at_rest.backward, -backward, exerted)
    exerted = jnp.where(direction == 0, needed - _breakaway_excess(at_rest, start_force, needed), exerted)
    change = jnp.where(crosses, (opposing - exerted) * rest_response, 0.0)
    sticks = crosses & (exerted == needed)
    # the other states respond only through this one, so with the square of the remaining time
    corrected = [x + response[k] * change * rest_response for k, x in enumerate(after)]
    corrected[row] = jnp.where(sticks, 0.0, after[row] + response[row] * change)
    return tuple(corrected)


def mean_correction(before: Scalars, uncorrected: Scalars, corrected: Scalars) -> Scalars:
    """Change of the mean speed, or current, over a step due to the correction of its end.

    The change grows linearly from the instant at which it reaches zero, or from the middle of the step where something
    else switches.

    **Arguments**: the value at the start of the step, and at its end without and with the correction.
    """
    # by the sign, because the product of two currents that have nearly decayed underflows to zero
    crosses = jnp.sign(before) * uncorrected <= 0
    remaining = jnp.where(crosses, 1.0 - _share_until_zero(before, uncorrected, crosses), 0.5)
    return remaining / 2 * (corrected - uncorrected)


def _share_until_zero(before: Scalars, after: Scalars, crosses: Bool[Array, "..."]) -> Scalars:
    """The share of a step after which a state reaches zero, on a straight line, where it `crosses` that; elsewhere 0.

    So for a state that falls by next to nothing, as a current does that decays for long: the derivative divides by the
    square of the fall, which must not underflow.
    """
    fall = before - after
    divides = crosses & (jnp.abs(fall) > jnp.sqrt(jnp.finfo(fall.dtype).tiny))
    return jnp.where(divides, before / jnp.where(divides, fall, 1.0), 0.0)


def _breakaway_excess(at_rest: Grip, start: Scalars, mean: Scalars) -> Scalars:
    """Mean over the step of a force on a state at rest, as far as it exceeds what holds the state there.

    The force varies linearly, from `start` at the start through `mean` in the middle of the step; the state breaks
    loose at the instant at which the force exceeds the limit.
    """
    end = 2 * mean - start
    toward = jnp.sign(end)
    limit = jnp.where(end > 0, at_rest.forward, at_rest.backward)
    beyond = jnp.maximum(toward * end - limit, 0.0)
    rise = jnp.where(beyond > 0, toward * (end - start), 1.0)
    at_once = jnp.maximum(toward * mean - limit, 0.0)
    later = beyond**2 / (2 * jnp.where(rise > 0, rise, 1.0))
    return toward * jnp.where(toward * start < limit, later, at_once)
