"""Final Gauss-Newton iterations of a fit, each output weighted by the standard deviation of its own residuals."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Parameters
from ..problem import (
    Evaluation,
    Problem,
    Unknowns,
    evaluate,
    flatten,
    normal_matrix,
    predicted_starts,
    scaled,
    unflatten,
    whitened,
)
from .gauss_newton import TOLERANCE, gauss_newton_step, residual_noise, ridge_of, squares_of_outputs
from .refine import Optimum

# The polish stops if the cost fell by less than MIN_COST_DECREASE over the last PATIENCE steps: dry elements leave
# kinks, at which the linearised model predicts a larger reduction than there is
PATIENCE, MIN_COST_DECREASE = 5, 1e-5
# Reduction predicted for a step, over the tolerance, up to which it is not taken if the last one was of no use
MAX_PREDICTED = 20.0
# Gauss-Newton steps at most
MAX_STEPS = 20
# A step that raises the cost, by more than rounding does, is divided by this until a share so small is left of it that
# the direction itself must be wrong
MAX_ROUNDING, SHORTENING, MIN_STEP_SHARE = 1e-9, 4, 1e-3
# From this evaluation on a polish is given up where it would be of no use even if the squares fell so many times
# further than the next step is predicted to reduce them
FIRST_TO_GIVE_UP, OPTIMISM = 3, 3.0
# Upper bound of viscous friction over what is usual (see `search_bounds`)
UPPER_OVER_USUAL_F = 10.0


class Fit(NamedTuple):
    """A motor fitted to the runs: the optimum, the simulation there, and the noise estimated from the residuals."""

    optimum: Optimum
    evaluation: Evaluation
    noise: Float[np.ndarray, "2"]  # standard deviations of current A and speed rad/s
    cost: float  # what the polish minimises (see `_WeightedPoint`)

    @property
    def unknowns(self) -> Unknowns:
        """The unknowns at the optimum."""
        return self.optimum.unknowns

    @property
    def coordinates(self) -> Float[Array, " parameters"]:
        """The search coordinates at the optimum."""
        return self.optimum.unknowns.coordinates

    @property
    def fitness(self) -> float:
        """The squared residuals in noise variances over `Problem.most_samples`: for a perfect model
        `Problem.perfect_fitness`, and infinite where the simulation fails."""
        return self.optimum.fitness

    @property
    def at_bound(self) -> tuple[int, ...]:
        """The coordinates that are held at a bound."""
        return self.optimum.at_bound


def polish(
    problem: Problem,
    start: Optimum,
    steps: int = MAX_STEPS,
    tolerance: float = TOLERANCE,
    at_start: Evaluation | None = None,
    give_up_above: float = np.inf,
) -> Fit:
    """Gauss-Newton iterations in which each output is weighted by the standard deviation of its own residuals.

    It ends where no step within the bounds is predicted to lower the squares by more than `tolerance`, or by little
    more where the last one did not, or where none lowers them. A coordinate at a bound is released where the gradient
    points back inside.

    **Arguments**: `start`; `steps`, at most; `tolerance`, in noise variances; `at_start`, the evaluation there, if
    known; `give_up_above`, the sum of whitened squares from which on the fit is of no use: it is given up once it will
    hardly fall so far.
    """
    ridge = ridge_of(problem)
    fixed, held = set(start.at_bound), None  # at a bound now, and as the last step was made
    best = trial = _evaluate_weighted(problem, start.unknowns, at_start, start.starts)
    step, share, gain = np.zeros(len(flatten(start.unknowns))), 1.0, np.inf
    costs = [best.cost]
    for _ in range(steps):
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] < MIN_COST_DECREASE:
            break
        if not np.isfinite(best.cost):
            break  # a failed simulation has no gradient
        if trial.cost <= best.cost + MAX_ROUNDING:
            fell = (best.cost - trial.cost) * float(np.sum(problem.samples))
            best, share = trial, 1.0
            fixed = _still_held(problem, best, fixed)
            step, gain = _step_from(problem, best, fixed, ridge)
            predicted = gain / _residual_variance(problem, best)
            if predicted <= tolerance:
                break
            if fell <= tolerance and predicted <= MAX_PREDICTED * tolerance and fixed == held:
                break
            held = frozenset(fixed)
            if len(costs) >= FIRST_TO_GIVE_UP and best.matrix[-1, -1] - OPTIMISM * gain > give_up_above:
                break
        elif share > MIN_STEP_SHARE:
            share /= SHORTENING  # the last step was too long
        else:
            break
        unknowns, stopped = _moved_within_bounds(problem, best.unknowns, share * step)
        fixed |= stopped
        change = np.asarray(flatten(unknowns)) - np.asarray(flatten(best.unknowns))
        trial = _evaluate_weighted(problem, unknowns, starts=predicted_starts(problem, best.evaluation, change))
        costs.append(min(trial.cost, best.cost))
    distance = float(np.sqrt(gain / _residual_variance(problem, best)))
    starts = np.asarray(best.evaluation.starts)
    optimum = Optimum(best.unknowns, best.fitness, tuple(sorted(fixed)), distance, starts)
    return Fit(optimum, best.evaluation, best.noise, best.cost)


def fit_at(problem: Problem, point: Optimum) -> Fit:
    """The fit that stays at a point: its evaluation and its noise."""
    return polish(problem, point, steps=0)


def _step_from(
    problem: Problem, best: _WeightedPoint, fixed: set[int], ridge: Float[np.ndarray, " unknowns"]
) -> tuple[np.ndarray, float]:
    """The Gauss-Newton step from a point, and the gain that it predicts.

    Viscous friction that is next to nothing, as where another effect was missing before, would stay so if the ridge
    held it within a factor of e: it may grow to what is usual.
    """
    parameters, plain = problem.parameters, gauss_newton_step(best.matrix, fixed, ridge)
    if "f" not in parameters.names:
        return plain
    f = parameters.names.index("f")
    over_usual = float(best.unknowns.coordinates[f] - parameters.upper[f]) + np.log(UPPER_OVER_USUAL_F)
    if over_usual >= 0:
        return plain
    weaker = ridge.copy()
    weaker[f] *= np.exp(2 * over_usual)
    growing = gauss_newton_step(best.matrix, fixed, weaker)
    return growing if growing[0][f] > 0 else plain


def _still_held(problem: Problem, best: _WeightedPoint, fixed: set[int]) -> set[int]:
    """The coordinates that stay at a bound, because the gradient does not point back inside."""
    # rounding may have moved them a little
    middle = np.asarray(problem.parameters.lower + problem.parameters.upper) / 2
    at_lower = np.asarray(best.unknowns.coordinates) < middle
    return {k for k in fixed if (best.matrix[k, -1] > 0) == at_lower[k]}


def _moved_within_bounds(problem: Problem, unknowns: Unknowns, step: np.ndarray) -> tuple[Unknowns, set[int]]:
    """The unknowns a step further on, within their bounds, and the coordinates that a bound stopped."""
    parameters = problem.parameters
    low, high = np.asarray(parameters.lower), np.asarray(parameters.upper)
    moved = np.asarray(flatten(unknowns)) + _damped_log_step(parameters, step)
    inside = np.clip(moved[: len(low)], low, high)
    stopped = np.flatnonzero(inside != moved[: len(low)])
    moved[: len(low)] = inside
    return unflatten(problem, jnp.asarray(moved)), set(stopped.tolist())


def _damped_log_step(parameters: Parameters, step: np.ndarray) -> np.ndarray:
    """A step s in which a positive parameter grows linearly, p (1 + s), instead of by exp(s): one that is nearly zero,
    such as friction hidden by another effect, would otherwise grow without limit."""
    rises = np.zeros(len(step), bool)
    rises[: len(parameters.names)] = parameters.logarithmic
    return np.where(rises & (step > 0), np.log1p(np.maximum(step, 0.0)), step)


class _WeightedPoint(NamedTuple):
    """An evaluated point, each output weighted by its own residuals."""

    unknowns: Unknowns
    evaluation: Evaluation
    noise: np.ndarray
    matrix: np.ndarray
    # what maximum likelihood minimises: the sum of the logarithms of the outputs' noise; for whitened residuals, the
    # logarithm of their sum of squares
    cost: float
    fitness: float


def _residual_variance(problem: Problem, best: _WeightedPoint) -> float:
    """Mean square of the weighted residuals. Unless they are whitened it is at least 1, the noise they are weighted by:
    fitted to a simulation without noise they are next to nothing."""
    mean = best.matrix[-1, -1] / max(float(np.sum(problem.samples)), 1.0)
    return max(mean, 1e-300 if problem.whitening is not None else 1.0)


def reweighted(problem: Problem, fit: Fit) -> Evaluation:
    """The evaluation at a fit to plain residuals, weighted as in a problem with another noise."""
    return whitened(problem, scaled(fit.evaluation, fit.noise / np.asarray(problem.noise)))


def _evaluate_weighted(
    problem: Problem,
    unknowns: Unknowns,
    known: Evaluation | None = None,
    starts: Float[np.ndarray, "blocks states"] | None = None,
) -> _WeightedPoint:
    evaluation = evaluate(problem, unknowns, starts) if known is None else known
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        squares = squares_of_outputs(problem, evaluation)
        noise, stretch = residual_noise(problem, squares)
        weighted = scaled(evaluation, stretch)
        matrix = np.array(normal_matrix(weighted, problem.tape, problem.fitted_runs))
        if problem.whitening is not None:
            cost = float(np.log(np.maximum(squares.sum(), 1e-300)))
        else:
            over = squares * stretch**2 / np.maximum(problem.samples, 1.0)
            cost = float(np.log(np.maximum(noise, 1e-300)).sum() + over.sum() / 2)
    fitness = float(squares.sum()) / problem.most_samples
    # a failed simulation is infinitely bad, and so is one whose derivatives fail: nothing can be told from it
    succeeded = np.isfinite(cost) and np.isfinite(fitness) and np.all(np.isfinite(matrix))
    cost, fitness = (cost, fitness) if succeeded else (np.inf, np.inf)
    return _WeightedPoint(unknowns, weighted, noise, matrix, cost, fitness)
