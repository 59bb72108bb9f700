"""What switches within a step: dry elements that come to rest, teeth that touch or part.

A step is taken as if all went on as it began, and then mended: until the switch the motor moved as it did, and what
is new from then on pushes for what is left of the step.
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

# Shares of a step at which it is known what a push does that lasts so long: those of Chebyshev
SHARES = (1 - np.cos(np.pi * (np.arange(6) + 0.5) / 6)) / 2
TO_POWERS = np.linalg.inv(np.vander(SHARES, increasing=True))


def computed_once(values: T, always: Bool[Array, ""]) -> T:
    """The same values, behind a branch that is always taken: XLA, which would compute them anew for each of all that
    depends on them, computes them once. A play of teeth is simulated in half the time. An accelerator, which would
    have to ask the processor what to do, computes them anew."""

    def behind_a_branch(values: T) -> T:
        return jax.lax.cond(always, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)

    return jax.lax.platform_dependent(values, cpu=behind_a_branch, default=lambda v: v)


def contact_response(
    A: Matrix, push: Float[Array, "n *#batch"], step: Float[Array, ""]
) -> Float[Array, "powers n *#batch"]:
    """What a constant push does that lasts for a share of the step until its end, over that share: the coefficients
    of h phi_1(share A h) push as a polynomial of the share."""
    at = SHARES.reshape(-1, *[1] * A[0, 0].ndim)
    _, (_, phi1) = phi_functions(step * at * A[:, :, None], 1)
    pushed = step * (phi1 * push[None, :, None]).sum(1)
    return jnp.einsum("pn,in...->pi...", TO_POWERS, pushed)


def contact_correction(
    effect: AbstractEffect,
    step: Scalars,
    contact: Float[Array, "powers n *#batch"],
    before: State,
    rate: State,
    after: State,
) -> tuple[Scalars, ...]:
    """What the end of a step changes by where teeth touch or part within it.

    When they do is found by the parabola through what decides it, at both ends of the step, with its slope at the
    begin; and so is how the torque goes on that they then begin or cease to pass.

    **Arguments**: `contact`, what that torque does to the motor as it then is; `rate`, of the state at the begin;
    `after`, how the step ends if they do not.
    """
    start = effect.teeth(before)
    touched = start.touch
    side = jnp.where(touched, start.side, effect.teeth(after).side)

    def stand(state: State) -> Float[Array, "2 *#batch"]:
        teeth = effect.teeth(state, side)
        return jnp.stack([teeth.overlap, teeth.compression])

    first, slope = jax.jvp(stand, (before,), (rate,))
    last, slope = stand(after), slope * step
    bend = last - first - slope
    # teeth touch once both rise through zero, and part once the push falls through it
    way = jnp.where(touched, -1.0, 1.0)
    goes = (way * first < 0) & (way * last > 0)
    root = jnp.sqrt(jnp.where(goes, slope**2 - 4 * bend * first, 1.0))
    whens = jnp.where(goes, -2 * way * first / jnp.where(goes, way * slope + root, 1.0), 0.0)
    when = jnp.where(touched, whens[1], jnp.max(whens, axis=0))
    switches = jnp.where(touched, jnp.any(last <= 0, axis=0), jnp.all(last > 0, axis=0))
    left = 1 - when
    new = jnp.where(switches, way * side, 0.0)
    torque = new * (first[1] + when * (slope[1] + when * bend[1]))
    rise, bend = new * (slope[1] + 2 * when * bend[1]), new * 2 * bend[1]
    # a push that goes on as a parabola: the polynomial of a constant one, integrated once for its slope, twice for
    # its bend
    sizes, power = [], left
    for p in range(1, len(contact) + 1):
        sizes.append(power * (torque + left / (p + 1) * (rise + left / (p + 2) * bend)))
        power = power * left
    sizes = computed_once(sizes, jnp.all(step > 0))
    by_state = jnp.moveaxis(contact, 1, 0)
    return tuple(
        reduce(add, (size * term for size, term in zip(sizes, terms, strict=True)))
        for terms in by_state
    )


def stick_or_reverse(
    row: int,
    grips: tuple[Grip, Grip],
    before: tuple[Scalars, ...],
    after: tuple[Scalars, ...],
    begun: Scalars,
    push: Float[Array, "n *#batch"],
    decay: Scalars,
) -> tuple[Scalars, ...]:
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
    taken = jnp.where(direction == 0, needed - _breakaway_excess(hold, begun, needed), taken)
    change = jnp.where(crosses, (acting - taken) * rest, 0.0)
    sticks = crosses & (taken == needed)
    # the other states follow this one, so they answer with the square of the time that is left
    mended = [x + push[k] * change * rest for k, x in enumerate(after)]
    mended[row] = jnp.where(sticks, 0.0, after[row] + push[row] * change)
    return tuple(mended)


def mended_mean(before: Scalars, unmended: Scalars, mended: Scalars) -> Scalars:
    """By how much the mean speed over a step changes as its end is mended.

    The change grows on a straight line from where the speed would come to zero; the same from half the step on, where
    something else switches.

    **Arguments**: the speed as the step begins, and as it ends without and with what switches.
    """
    crosses = before * unmended <= 0
    fall = jnp.where(crosses & (before != 0), before - unmended, 1.0)
    left = jnp.where(crosses, 1.0 - before / fall, 0.5)
    return left / 2 * (mended - unmended)


def _breakaway_excess(hold: Grip, begun: Scalars, mean: Scalars) -> Scalars:
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
