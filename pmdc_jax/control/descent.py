"""Gradient tuning from many starts at once."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ..compiled import compiled
from ..motor import Motor
from .controllers import Number
from .gains import GainSpace
from .law import SampledMotor
from .objective import CHOICE, DESCENT, Task, cost, exact_score, smooth_score

SCREENED = 512  # gains drawn
STARTS = 64  # the best of them, which are followed on the first motor alone
FINALISTS = 16  # the best of those, which go on with all the motors
ITERATIONS = 100  # of each descent
RATE = 0.06  # first step in the logarithms of the gains; it falls to nothing
FIRST_WIDTH = 0.5  # of the smooth metrics at the beginning, in bands
LAST_WIDTH = 0.05  # from half of the iterations on
OVERFLOWN = 1e6  # cost of gains with which the speed overflows

Coordinates = Float[Array, "starts gains"]
Costs = Float[Array, " starts"]
# Where the starts have got to, Adam's state, the best points they have seen, and what these cost
Descent = tuple[Coordinates, Any, Coordinates, Costs]


def best_coordinates(
    task: Task,
    space: GainSpace,
    motors: Motor,
    seed: int = 0,
    starts: int = STARTS,
) -> np.ndarray:
    """Coordinates of the best gains that any of the starts led to, (gains,).

    Gains are drawn evenly over the logarithms of their ranges; the best of them are followed down the
    gradient by Adam, each keeping the best point it has seen.

    **Arguments**: `motors`, with a leading axis; all count, the worst of them more.
    """
    lower, upper = space.bounds()
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(lower, upper, (SCREENED, len(lower)))
    model = SampledMotor.of(space.motor, task.hardware.sample_time)
    nominal = jax.tree.map(lambda leaf: leaf[:1], motors)
    costs = _screen(task, space, model, nominal, jnp.asarray(drawn))
    coordinates = _best(jnp.asarray(drawn), costs, starts)
    coordinates, costs = _descend(task, space, model, nominal, coordinates)
    if motors.R.shape[0] > 1:
        finalists = _best(coordinates, costs, FINALISTS)
        coordinates, _ = _descend(task, space, model, motors, finalists)
    costs = _rank(task, space, model, motors, coordinates)
    return np.asarray(coordinates[jnp.argmin(costs)])


def _best(coordinates: Coordinates, costs: Costs, count: int) -> Float[Array, "best gains"]:
    return coordinates[jnp.argsort(costs)[:count]]


def _smooth_costs(
    task: Task,
    space: GainSpace,
    model: SampledMotor,
    motors: Motor,
    coordinates: Coordinates,
    width: Number,
) -> Costs:
    def of(x: Float[Array, " gains"]) -> Float[Array, ""]:
        return cost(task, smooth_score(task, model, motors, space.controller(x), width), DESCENT)

    return _finite(jax.vmap(of)(coordinates))


def _finite(costs: Costs) -> Costs:
    """So that gains with which the speed overflows come last."""
    return jnp.nan_to_num(costs, nan=OVERFLOWN, posinf=OVERFLOWN)


@compiled
def _screen(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, coordinates: Coordinates
) -> Costs:
    return _smooth_costs(task, space, model, motors, coordinates, FIRST_WIDTH)


@compiled
def _rank(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, coordinates: Coordinates
) -> Costs:
    def of(x: Float[Array, " gains"]) -> Float[Array, ""]:
        return cost(task, exact_score(task, model, motors, space.controller(x)), CHOICE)

    return _finite(jax.vmap(of)(coordinates))


@compiled
def _descend(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, start: Coordinates
) -> tuple[Coordinates, Costs]:
    """All starts at once: the sum of their costs has each one's own gradient."""
    lower, upper = (jnp.asarray(bound) for bound in space.bounds())
    schedule = optax.cosine_decay_schedule(RATE, ITERATIONS)
    optimiser = optax.adam(schedule, b1=0.8, b2=0.95)

    def total(x: Coordinates, width: Number) -> tuple[Float[Array, ""], Costs]:
        costs = _smooth_costs(task, space, model, motors, x, width)
        return jnp.sum(costs), costs

    def iteration(carry: Descent, k: Int[Array, ""]) -> tuple[Descent, None]:
        x, state, best, lowest = carry
        width = FIRST_WIDTH * (LAST_WIDTH / FIRST_WIDTH) ** jnp.minimum(2 * k / ITERATIONS, 1.0)
        (_, costs), gradient = jax.value_and_grad(total, has_aux=True)(x, width)
        # while the metrics still sharpen, costs of different iterations cannot be compared
        better = (costs < lowest) | (2 * k <= ITERATIONS)
        best = jnp.where(better[:, None], x, best)
        lowest = jnp.where(better, costs, lowest)
        updates, state = optimiser.update(jnp.nan_to_num(gradient), state)
        x = jnp.clip(jnp.asarray(optax.apply_updates(x, updates)), lower, upper)
        return (x, state, best, lowest), None

    first = (start, optimiser.init(start), start, jnp.full(start.shape[0], jnp.inf))
    (_, _, best, lowest), _ = jax.lax.scan(iteration, first, jnp.arange(ITERATIONS))
    return best, lowest
