"""Runs that begin while the winding is still warm from the run before."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, negative_log_likelihood
from ..fit.polish import Fit, polish
from ..prepare import Prepared
from ..problem import Problem

# A run tells how warm it begins if it alone determines R with a relative standard error below this
MAX_STDERR = 0.02


def with_initial_temperatures(prepared: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with the initial rise of the resistance fitted in all but the coolest one, and the fit to them; both
    unchanged unless that is clearly likelier than that all begin cold."""
    telling = _runs_that_tell(prepared.problem, fit)
    if len(telling) < 2:
        return prepared, fit
    coolest = int(telling[0])
    warm = _with_cold_run(prepared, fit, telling, coolest)
    rises = np.asarray(warm[1].unknowns.runs.rise)
    if (below := int(telling[np.argmin(rises[telling])])) != coolest:
        again = _with_cold_run(prepared, _relative_to(warm, float(rises[below])), telling, below)
        warm = min(warm, again, key=lambda pair: pair[1].cost)
    gain = negative_log_likelihood(prepared, fit) - negative_log_likelihood(*warm)
    return warm if gain > MIN_LOG_LIKELIHOOD_GAIN else (prepared, fit)


def _runs_that_tell(problem: Problem, fit: Fit) -> Int[np.ndarray, " telling"]:
    """The training runs that tell how warm they begin."""
    names = problem.parameters.names
    if not problem.has_temperature or "R" not in names:
        return np.zeros(0, int)
    by_R = np.asarray(fit.evaluation.jacobian)[..., names.index("R")]
    of_block = np.square(by_R).sum((1, 2))
    of_run = np.bincount(np.asarray(problem.tape.run), of_block, problem.tape.runs)
    return np.flatnonzero((of_run > 1 / MAX_STDERR**2) & np.asarray(problem.fitted_runs))


def _with_cold_run(
    prepared: Prepared, fit: Fit, telling: Int[np.ndarray, " telling"], cold: int
) -> tuple[Prepared, Fit]:
    """The runs that tell with an initial rise, except one that begins cold; and the fit to them."""
    warm = prepared.problem.begins_warm.at[telling].set(True).at[cold].set(False)
    prepared = prepared.with_problem(begins_warm=warm)
    return prepared, polish(prepared.problem, fit.optimum)


def _relative_to(warm: tuple[Prepared, Fit], rise: float) -> Fit:
    """The fit with R and the initial rises relative to the temperature at which a run with this rise begins."""
    prepared, fit = warm
    parameters, unknowns = prepared.problem.parameters, fit.unknowns
    coordinates = np.array(fit.coordinates)
    coordinates[parameters.names.index("R")] += np.log1p(rise)
    runs = unknowns.runs
    rises = (1 + runs.rise) / (1 + rise) - 1
    moved = unknowns._replace(coordinates=jnp.asarray(coordinates), runs=runs._replace(rise=rises))
    return fit._replace(optimum=fit.optimum._replace(unknowns=moved))
