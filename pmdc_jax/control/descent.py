"""Gain tuning by gradient descent from many starts at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ..motor import Motor
from ..runtime.compiled import compiled
from .controllers import Number
from .gains import GainSpace
from .law import SampledMotor
from .objective import DESCENT, SELECTION, Task, cost, exact_score, smooth_score

RANDOM_DRAWS = 512  # sets of gains drawn at random and screened
STARTS = 64  # the best of them, start points of descents on the first motor alone
FINALISTS = 16  # the best results of these, start points of descents on all motors
ITERATIONS = 100  # of each descent
LEARNING_RATE = 0.06  # at first, in the logarithms of the gains; decays to zero
# of Adam's means of the gradient and of its square: its usual 0.9 and 0.999 remember too long for so few iterations
DECAY_RATES = 0.8, 0.95
INITIAL_WIDTH = 0.5  # of the smooth metrics, in bands
FINAL_WIDTH = 0.05  # their width in the second half of the iterations
DIVERGED_COST = 1e6  # cost of gains with which the simulated speed overflows

Coordinates = Float[Array, "starts gains"]
Costs = Float[Array, " starts"]


class Descent(NamedTuple):
    """Descents under way: current points, state of Adam, best point of each start so far, and costs of these."""

    coordinates: Coordinates
    optimiser_state: Any
    best: Coordinates
    lowest_costs: Costs


def best_coordinates(task: Task, space: GainSpace, motors: Motor, seed: int = 0, starts: int = STARTS) -> np.ndarray:
    """Coordinates of the best gains found from any start, (gains,).

    Gains are drawn log-uniformly over their ranges. From the best, Adam descends the smooth cost, and each start keeps
    its best point. The exact cost selects among these.

    **Arguments**: `motors`, with a leading axis, the nominal one first; the worst of them weigh more in the cost;
    `starts`, number of descents.
    """
    lower, upper = space.bounds()
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(lower, upper, (RANDOM_DRAWS, len(lower)))
    model = SampledMotor.of(space.motor, task.hardware.sample_time)
    nominal = jax.tree.map(lambda leaf: leaf[:1], motors)
    costs = _initial_smooth_costs(task, space, model, nominal, jnp.asarray(drawn))
    coordinates = _cheapest(jnp.asarray(drawn), costs, starts)
    coordinates, costs = _descend(task, space, model, nominal, coordinates)
    if motors.R.shape[0] > 1:
        finalists = _cheapest(coordinates, costs, FINALISTS)
        coordinates, _ = _descend(task, space, model, motors, finalists)
    costs = _exact_costs(task, space, model, motors, coordinates)
    return np.asarray(coordinates[jnp.argmin(costs)])


def _cheapest(coordinates: Coordinates, costs: Costs, count: int) -> Float[Array, "best gains"]:
    return coordinates[jnp.argsort(costs)[:count]]


def _smooth_costs(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, coordinates: Coordinates, width: Number
) -> Costs:
    def cost_at(x: Float[Array, " gains"]) -> Float[Array, ""]:
        return cost(task, smooth_score(task, model, motors, space.controller(x), width), DESCENT)

    return _penalise_divergence(jax.vmap(cost_at)(coordinates))


def _penalise_divergence(costs: Costs) -> Costs:
    """Costs with NaN and infinity replaced, so that gains with which the speed overflows rank last."""
    return jnp.nan_to_num(costs, nan=DIVERGED_COST, posinf=DIVERGED_COST)


@compiled
def _initial_smooth_costs(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, coordinates: Coordinates
) -> Costs:
    return _smooth_costs(task, space, model, motors, coordinates, INITIAL_WIDTH)


@compiled
def _exact_costs(task: Task, space: GainSpace, model: SampledMotor, motors: Motor, coordinates: Coordinates) -> Costs:
    def cost_at(x: Float[Array, " gains"]) -> Float[Array, ""]:
        return cost(task, exact_score(task, model, motors, space.controller(x)), SELECTION)

    return _penalise_divergence(jax.vmap(cost_at)(coordinates))


@compiled
def _descend(
    task: Task, space: GainSpace, model: SampledMotor, motors: Motor, start: Coordinates
) -> tuple[Coordinates, Costs]:
    """Descend from all starts at once: the gradient of the summed costs holds that of each start's own cost."""
    lower, upper = (jnp.asarray(bound) for bound in space.bounds())
    schedule = optax.cosine_decay_schedule(LEARNING_RATE, ITERATIONS)
    optimiser = optax.adam(schedule, *DECAY_RATES)

    def summed_costs(x: Coordinates, width: Number) -> tuple[Float[Array, ""], Costs]:
        costs = _smooth_costs(task, space, model, motors, x, width)
        return jnp.sum(costs), costs

    def iteration(descent: Descent, k: Int[Array, ""]) -> tuple[Descent, None]:
        x, state, best, lowest = descent
        narrowing = jnp.minimum(2 * k / ITERATIONS, 1.0)
        width = INITIAL_WIDTH * (FINAL_WIDTH / INITIAL_WIDTH) ** narrowing
        (_, costs), gradient = jax.value_and_grad(summed_costs, has_aux=True)(x, width)
        # costs of different iterations are comparable only once the width no longer changes
        keep = (costs < lowest) | (2 * k <= ITERATIONS)
        best = jnp.where(keep[:, None], x, best)
        lowest = jnp.where(keep, costs, lowest)
        updates, state = optimiser.update(jnp.nan_to_num(gradient), state)
        x = jnp.clip(jnp.asarray(optax.apply_updates(x, updates)), lower, upper)
        return Descent(x, state, best, lowest), None

    first = Descent(start, optimiser.init(start), start, jnp.full(start.shape[0], jnp.inf))
    last, _ = jax.lax.scan(iteration, first, jnp.arange(ITERATIONS))
    return last.best, last.lowest_costs
