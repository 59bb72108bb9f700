"""A population around a fit: where a slope leads no further than the next of many optima."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..motor import PARAMETERS
from ..simulate import Tape
from .parameters import Parameters
from .polish import Fit, polish
from .problem import Problem
from .refine import Optimum
from .search import search

# Evaluated as fast as a smaller one: what takes long is to go through the samples one after another
POPULATION, GENERATIONS = 64, 20
# Candidates, the best one first, of which one is to have derivatives in all runs
RANKS = (0, 1, 3, 7, 15, 31)
# So many samples, if not those of one run, tell a few parameters from others
ENOUGH = 2**13


def best_nearby(problem: Problem, fit: Fit, factors: Mapping[str, float], seed: int) -> Optimum:
    """The best point of a search (`search`) among some parameters around those of a fit, while all others stay.

    **Arguments**: `factors`, by parameter: it is sought within so many times and one over so many times what it is.
    **Returns**: the best point at which the problem can be evaluated; that of the fit, if there is none.
    """
    parameters, coordinates = problem.parameters, np.array(fit.coordinates)
    values = {name: parameters.value(name, coordinates) for name in parameters.names}
    bounds = {name: (value, value) for name, value in values.items() if name in PARAMETERS}
    for name, factor in factors.items():
        effect, _, field = name.partition(".")
        its = next(e for e in parameters.effects if e.name == effect).ranges[field]
        bounds[name] = (
            max(values[name] / factor, its.lower),
            min(values[name] * factor, its.upper),
        )
    known = {name: float(value) for name, value in parameters.known.items()}
    known |= {name: value for name, value in values.items() if name not in factors}
    sought = Parameters.of(bounds, parameters.effects, known, parameters.ties)
    # a fit that cannot be simulated leaves none
    noise = np.where(np.isfinite(fit.noise), fit.noise, problem.noise)
    found = search(
        sought,
        _telling_runs(problem, fit),
        noise,
        seed=seed,
        population=POPULATION,
        generations=GENERATIONS,
    )
    places = [parameters.names.index(name) for name in sought.names]
    for rank in RANKS:
        coordinates[places] = found.candidates[rank]
        unknowns = fit.unknowns._replace(coordinates=jnp.asarray(coordinates))
        best = Optimum(unknowns, np.inf, (), False)
        if np.isfinite(polish(problem, best, steps=0).fitness):
            return best
    return fit.optimum


def _telling_runs(problem: Problem, fit: Fit) -> Tape:
    """The few runs of which a fit leaves most, each begun and loaded as its own unknowns say."""
    tape, unknowns = problem.tape, fit.unknowns
    run = np.asarray(tape.run)[problem.fitted_blocks]
    residuals = np.nan_to_num(np.asarray(fit.evaluation.residuals)[problem.fitted_blocks])
    runs, of_run, blocks = np.unique(run, return_inverse=True, return_counts=True)
    left = np.bincount(of_run, np.square(residuals).sum((1, 2))) / blocks
    order = np.argsort(-left, kind="stable")
    samples = np.cumsum(blocks[order]) * tape.value.shape[1]
    telling = runs[order[: max(1, np.searchsorted(samples, ENOUGH, side="right"))]]
    offset = jnp.where(tape.load_unknown, unknowns.runs.load_offset, 0.0)[tape.run]
    begun = replace(
        tape,
        load=tape.load + offset[:, None],
        initial=jnp.stack([unknowns.runs.current, unknowns.runs.speed], 1),
    )
    return begun.of_runs(telling.tolist())
