"""Population search around a fit, where a gradient leads only to the nearest of many local optima."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ...identify.fit.polish import Fit, fit_at
from ...identify.fit.refine import Optimum
from ...identify.parameters import Parameters
from ...identify.problem import Problem
from ...identify.search.evolution import global_search
from ...motor import PARAMETERS
from ...simulate import Tape

# As fast to evaluate as a smaller one: the time goes into walking through the samples one after another
POPULATION, GENERATIONS = 64, 20
# Ranks of the candidates, best first, that are tried until one can be evaluated with derivatives in all runs
TRIED_RANKS = (0, 1, 3, 7, 15, 31)
# Samples that suffice to determine a few parameters (at least one run is used)
MAX_SAMPLES = 2**13


def best_nearby(problem: Problem, fit: Fit, factors: Mapping[str, float], seed: int) -> Optimum:
    """The best point of a population search over some parameters around those of a fit, with all others fixed.

    **Arguments**: `factors`, by name of the effect parameter: it is sought between its value over the factor and its
    value times the factor, within the range of its table; `seed` of the search.
    **Returns**: the best point at which the problem can be evaluated; that of the fit, if there is none.
    """
    parameters, coordinates = problem.parameters, np.array(fit.coordinates)
    every = (*PARAMETERS, *parameters.known, *parameters.names)
    values = {name: parameters.value(name, coordinates) for name in every}
    bounds = {name: (values[name], values[name]) for name in PARAMETERS}
    for name, factor in factors.items():
        effect, _, field = name.partition(".")
        limits = next(e for e in parameters.effects if e.name == effect).ranges[field]
        bounds[name] = (max(values[name] / factor, limits.lower), min(values[name] * factor, limits.upper))
    known = {name: value for name, value in values.items() if name not in factors}
    free = Parameters.of(bounds, parameters.effects, known)
    # a fit that cannot be simulated has no finite noise
    noise = np.where(np.isfinite(fit.noise), fit.noise, problem.noise)
    search_result = global_search(
        free, _worst_fitted_runs(problem, fit), noise, seed=seed, population=POPULATION, generations=GENERATIONS
    )
    places = [parameters.names.index(name) for name in free.names]
    for rank in TRIED_RANKS:
        coordinates[places] = search_result.candidates[rank]
        unknowns = fit.unknowns._replace(coordinates=jnp.asarray(coordinates))
        best = fit_at(problem, Optimum(unknowns, np.inf, ())).optimum
        if np.isfinite(best.fitness):
            return best
    return fit.optimum


def _worst_fitted_runs(problem: Problem, fit: Fit) -> Tape:
    """The few runs with the largest residuals per block, with the initial state and load of their own unknowns."""
    tape, unknowns = problem.tape, fit.unknowns
    run = np.asarray(tape.run)[problem.fitted_blocks]
    residuals = np.nan_to_num(np.asarray(fit.evaluation.residuals)[problem.fitted_blocks])
    runs, of_run, blocks = np.unique(run, return_inverse=True, return_counts=True)
    mean_squares = np.bincount(of_run, np.square(residuals).sum((1, 2))) / blocks
    order = np.argsort(-mean_squares, kind="stable")
    samples = np.cumsum(blocks[order]) * tape.value.shape[1]
    worst = runs[order[: max(1, np.searchsorted(samples, MAX_SAMPLES, side="right"))]]
    offset = jnp.where(tape.load_unknown, unknowns.runs.load_offset, 0.0)[tape.run]
    from_fit = replace(
        tape, load=tape.load + offset[:, None], initial=jnp.stack([unknowns.runs.current, unknowns.runs.speed], 1)
    )
    return from_fit.of_runs(worst.tolist())
