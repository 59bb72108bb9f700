"""Gradient tuning from many starts at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from ..compiled import compiled
from ..motor import Motor
from .gains import GainSpace
from .law import Model
from .objective import Task, exact_cost, score, smooth_cost

STARTS, SCREENED, ITERATIONS = 64, 512, 100
FINALISTS = (
    16  # go on with all the motors, after the starts have been followed on the first one alone
)
RATE = 0.06  # of the logarithms of the gains, falling to nothing
WIDTHS = 0.5, 0.05  # of the smooth metrics, at the beginning and at the end

Coordinates = Float[Array, "starts gains"]
Costs = Float[Array, " starts"]


def tuned(
    task: Task,
    space: GainSpace,
    motors: Motor,
    seed: int = 0,
    starts: int = STARTS,
    also: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of the gains that the starts led to, best first, and their exact costs.

    Gains are drawn evenly over the logarithms of their ranges; the best of them, and those given, are followed
    down the gradient by Adam, each keeping the best point it has seen.

    **Arguments**: `motors`, with a leading axis; all count, the worst of them more; `also`, starts of the caller's.
    """
    lower, upper = space.bounds()
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(lower, upper, (SCREENED, len(lower)))
    if also is not None:
        drawn[: len(also)] = np.clip(also, lower, upper)
    model = Model.of(space.motor, task.hardware.sample_time)
    nominal = jax.tree.map(lambda leaf: leaf[:1], motors)
    costs = _screen(task, space, model, nominal, jnp.asarray(drawn))
    coordinates = _best(jnp.asarray(drawn), costs, starts)
    coordinates, costs = _descend(task, space, model, nominal, coordinates)
    if motors.R.shape[0] > 1:
        finalists = _best(coordinates, costs, FINALISTS)
        coordinates, _ = _descend(task, space, model, motors, finalists)
    costs = _rank(task, space, model, motors, coordinates)
    return np.asarray(_best(coordinates, costs, starts)), np.sort(np.asarray(costs))


def _best(coordinates: Coordinates, costs: Costs, count: int) -> Float[Array, "best gains"]:
    return coordinates[jnp.argsort(costs)[:count]]


def _costs(task, space, model, motors, coordinates, width):
    def cost(x):
        return smooth_cost(task, model, motors, space.controller(x), width)

    return jnp.nan_to_num(jax.vmap(cost)(coordinates), nan=1e6, posinf=1e6)


@compiled
def _screen(task, space, model, motors, coordinates) -> Float[Array, " starts"]:
    return _costs(task, space, model, motors, coordinates, WIDTHS[0])


@compiled
def _rank(task, space, model, motors, coordinates) -> Float[Array, " starts"]:
    def cost(x):
        return exact_cost(task, score(task, model, motors, space.controller(x)))

    return jnp.nan_to_num(jax.vmap(cost)(coordinates), nan=1e6, posinf=1e6)


@compiled
def _descend(task, space, model, motors, start: Coordinates) -> tuple[Coordinates, Costs]:
    """All starts at once: the sum of their costs has each one's own gradient."""
    lower, upper = (jnp.asarray(bound) for bound in space.bounds())
    schedule = optax.cosine_decay_schedule(RATE, ITERATIONS)
    optimiser = optax.adam(schedule, b1=0.8, b2=0.95)

    def total(x, width):
        costs = _costs(task, space, model, motors, x, width)
        return jnp.sum(costs), costs

    def iteration(carry, k):
        x, state, best, lowest = carry
        width = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** jnp.minimum(2 * k / ITERATIONS, 1.0)
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
