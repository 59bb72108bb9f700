"""A fit in which one parameter has a value of its own in every run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...identify.fit.gauss_newton import RIDGE, gauss_newton_step, residual_noise, ridge_of, squares_of_outputs
from ...identify.problem import Evaluation, Problem, Unknowns, evaluate, normal_matrix, scaled, select_blocks
from ...identify.uncertainty.covariance import information
from ...simulate import UNKNOWNS_PER_RUN, RunUnknowns

# Gauss-Newton steps at most, and the decrease of the cost from which another one is taken
MAX_STEPS, MIN_DECREASE = 6, 1e-4


class FitByRun(NamedTuple):
    """Search coordinates and own unknowns of every run, and the simulation with them."""

    coordinates: Float[np.ndarray, "runs parameters"]
    runs: RunUnknowns
    evaluation: Evaluation


def fit_by_run(
    problem: Problem,
    k: int,
    coordinates: Float[np.ndarray, "runs parameters"],
    runs: RunUnknowns,
    fixed: Sequence[int] = (),
) -> FitByRun:
    """Fit coordinate `k` of each training run, the other coordinates, which all runs share, and the runs' own unknowns.

    Gauss-Newton steps from `coordinates` and `runs`, each output weighted by its own residuals, until one hardly lowers
    the cost, or does not. The coordinates in `fixed` stay as they are.
    """
    best = _simulated(problem, coordinates, runs)
    for _ in range(MAX_STEPS):
        trial = _simulated(problem, *_step(problem, best, k, {k, *fixed}))
        decrease = _cost(problem, best) - _cost(problem, trial)
        if not decrease > 0:  # nor where the trial cannot be simulated
            break
        best = trial
        if decrease < MIN_DECREASE:
            break
    return best


def errors_by_run(
    problem: Problem, fit: FitByRun, k: int, fixed: Sequence[int] = ()
) -> Float[np.ndarray, "2 training"]:
    """Standard error and half the 95 % interval of coordinate `k` of every training run; see `information`."""
    count, tape, fitted = fit.coordinates.shape[1], problem.tape, np.asarray(problem.fitted_runs)
    evaluation = _with_own_columns(problem, fit, k)
    free = np.array([*np.asarray(problem.free), *fitted])
    free[[k, *fixed]] = False
    info = information(evaluation.residuals, evaluation.jacobian, tape.run, free, int(fitted.sum()))
    errors = np.sqrt(np.diag(info.covariance))
    return np.stack([errors, info.interval_factor * errors])[:, count:][:, fitted]


def _simulated(problem: Problem, coordinates: Float[np.ndarray, "runs parameters"], runs: RunUnknowns) -> FitByRun:
    """Every run simulated with its own coordinates."""
    first, *others = np.unique(coordinates, axis=0)
    evaluation = evaluate(problem, Unknowns(jnp.asarray(first), runs))
    for own in others:
        blocks = (coordinates == own).all(1)[np.asarray(problem.tape.run)]
        reached = evaluate(problem, Unknowns(jnp.asarray(own), runs))
        evaluation = select_blocks(jnp.asarray(blocks), reached, evaluation)
    return FitByRun(coordinates, runs, evaluation)


def _step(
    problem: Problem, best: FitByRun, k: int, fixed: set[int]
) -> tuple[Float[np.ndarray, "runs parameters"], RunUnknowns]:
    """The coordinates and unknowns of every run after a Gauss-Newton step."""
    count, tape = best.coordinates.shape[1], problem.tape
    weighted = _with_own_columns(problem, best, k)
    matrix = np.asarray(normal_matrix(weighted, tape, problem.fitted_runs))
    ridge = np.insert(ridge_of(problem), count, np.full(tape.runs, RIDGE))
    flat, _ = gauss_newton_step(matrix, fixed, ridge)
    shared, own, unknowns = np.split(flat, [count, count + tape.runs])
    coordinates = best.coordinates + shared
    coordinates[:, k] += own
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    changes = zip(best.runs, unknowns.reshape(-1, UNKNOWNS_PER_RUN).T, strict=True)
    return np.clip(coordinates, low, high), RunUnknowns(*(x + change for x, change in changes))


def _with_own_columns(problem: Problem, fit: FitByRun, k: int) -> Evaluation:
    """The evaluation, each output weighted by its own residuals, with a column for coordinate `k` of each run after
    those of the coordinates; that of the common one is zero."""
    count, tape = fit.coordinates.shape[1], problem.tape
    _, stretch = residual_noise(problem, squares_of_outputs(problem, fit.evaluation))
    weighted = scaled(fit.evaluation, stretch)
    shared, unknowns = jnp.split(weighted.jacobian, [count], axis=-1)
    of_run = jnp.asarray(tape.run)[:, None] == jnp.arange(tape.runs)
    own = shared[..., k, None] * of_run[:, None, None, :]
    columns = [shared.at[..., k].set(0.0), own, unknowns]
    return weighted._replace(jacobian=jnp.concatenate(columns, axis=-1))


def _cost(problem: Problem, fit: FitByRun) -> float:
    """What maximum likelihood minimises: the sum of the logarithms of the outputs' noise."""
    noise, _ = residual_noise(problem, squares_of_outputs(problem, fit.evaluation))
    return float(np.log(noise).sum())
