"""Runs that begin while the winding is still warm from the run before."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..fit.fitted_runs import FittedRuns
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, negative_log_likelihood
from ..fit.polish import Fit
from ..fit.refine import Optimum
from ..prepare import Prepared
from ..problem import Problem

# A run tells how warm it begins if it alone determines R with a relative standard error below this
MAX_STDERR = 0.02


def with_initial_temperatures(cold: FittedRuns) -> FittedRuns:
    """The runs with the initial rise of the resistance fitted in all but the coolest one, and the fit to them; both
    unchanged unless that is clearly likelier than that all begin cold, or if it is fitted already."""
    informative = _informative_runs(cold.problem, cold.fit)
    if len(informative) < 2 or np.any(np.asarray(cold.problem.begins_warm)[informative]):
        return cold
    coolest = int(informative[0])
    warm = _with_cold_run(cold.prepared, cold.fit.optimum, informative, coolest)
    rises = np.asarray(warm.fit.unknowns.runs.resistance_rise)
    if (below := int(informative[np.argmin(rises[informative])])) != coolest:
        again = _with_cold_run(cold.prepared, _relative_to(warm, float(rises[below])), informative, below)
        warm = min(warm, again, key=lambda fitted: fitted.fit.cost)
    gain = negative_log_likelihood(cold) - negative_log_likelihood(warm)
    return warm if gain > MIN_LOG_LIKELIHOOD_GAIN else cold


def _informative_runs(problem: Problem, fit: Fit) -> Int[np.ndarray, " informative"]:
    """The training runs that tell how warm they begin."""
    names = problem.parameters.names
    if not problem.has_temperature or "R" not in names:
        return np.zeros(0, int)
    by_R = np.asarray(fit.evaluation.jacobian)[..., names.index("R")]
    of_block = np.square(by_R).sum((1, 2))
    of_run = np.bincount(np.asarray(problem.tape.run), of_block, problem.tape.runs)
    return np.flatnonzero((of_run > 1 / MAX_STDERR**2) & np.asarray(problem.fitted_runs))


def _with_cold_run(
    prepared: Prepared, start: Optimum, informative: Int[np.ndarray, " informative"], cold: int
) -> FittedRuns:
    """The informative runs with an initial rise, except one that begins cold; and the fit to them."""
    warm = prepared.problem.begins_warm.at[informative].set(True).at[cold].set(False)
    return FittedRuns.polished(prepared.with_problem(begins_warm=warm), start)


def _relative_to(warm: FittedRuns, rise: float) -> Optimum:
    """The optimum with R and the initial rises relative to the temperature at which a run with this rise begins."""
    parameters, fit = warm.problem.parameters, warm.fit
    coordinates = np.array(fit.coordinates)
    coordinates[parameters.names.index("R")] += np.log1p(rise)
    runs = fit.unknowns.runs
    rises = (1 + runs.resistance_rise) / (1 + rise) - 1
    relative = fit.unknowns._replace(coordinates=jnp.asarray(coordinates), runs=runs._replace(resistance_rise=rises))
    return fit.optimum._replace(unknowns=relative)
