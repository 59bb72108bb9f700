"""Parameters that are not the same in all runs, such as the resistance of a winding that was warmer in some of them.

Each parameter of the motor is given a value of its own in every run, to first order: a score test of the hypothesis of
Chow, "Tests of equality between sets of coefficients in two linear regressions", Econometrica 28 (1960) 591-605. The
one that explains most is then fitted in full simulation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...identify.fit.gauss_newton import squares_of_runs
from ...identify.fit.likelihood import negative_log_likelihood_of
from ...identify.fit.run_unknowns import fit_run_unknowns
from ...identify.identification import Estimate
from ...identify.parameters import unit_of
from ...identify.run_fits import run_fits
from ...identify.uncertainty.covariance import information_of
from ...identify.uncertainty.identifiability import sees_torque_scale
from ...motor import PARAMETERS
from ...simulate import RunUnknowns
from ..diagnosis import VaryingParameter
from ..model import Model
from .assessment import FALSE_ALARM, Assessment
from .fit_by_run import FitByRun, errors_by_run, fit_by_run
from .regression import Block
from .signals import Screen, dispersion_by_noise, log_p_value

# Least range of a parameter's logarithm over the runs that counts: errors of simulators and clocks look like less
MIN_RANGE = 0.01
# A run determines a parameter if its standard error there is below this share of the range over all runs
MAX_ERROR_SHARE = 0.3
# Parameters that gain at least this share of what the best one does may vary in its place
ALTERNATIVE_SHARE = 0.7


class _Variation(NamedTuple):
    """One parameter with a value of its own in every run."""

    name: str
    gain: float  # to first order: decrease of the squared white residuals
    log_p: float  # natural logarithm of the p-value of such a gain by noise
    common: Float[np.ndarray, " parameters"]  # the search coordinates of all other parameters
    own: dict[int, float]  # its own coordinate in each of the runs that determine it

    @property
    def range(self) -> float:
        """The largest coordinate of any run less the smallest."""
        return float(np.ptp([*self.own.values()])) if self.own else 0.0


def varying_parameter(model: Model, assessment: Assessment) -> VaryingParameter | None:
    """The parameter of the motor whose variation from run to run explains most of what a model leaves.

    None if no variation is significant, if a candidate or a curve explains more, if a parameter of an effect may vary
    instead, whose formula is then not quite the motor's, or if a simulation with the values found fits no better.
    """
    variations = sorted(_variations(model, assessment.screen), key=lambda v: -v.gain)
    limit = np.log(FALSE_ALARM / max(len(variations), 1))
    clear = [v for v in variations if v.log_p < limit and v.range > MIN_RANGE]
    if not clear or clear[0].gain < assessment.clearest.gain:
        return None
    best, *others = (v for v in clear if v.gain > ALTERNATIVE_SHARE * clear[0].gain)
    alternatives = tuple(v.name for v in others)
    if not {best.name, *alternatives} <= PARAMETERS.keys():
        return None
    fit = _fit(model, best)
    if fit is None:
        return None
    by_run = _estimates_by_run(model, best, fit)
    if len(by_run) < 2:
        return None
    prepared, simulated = model.prepared, np.asarray(fit.evaluation.simulated)
    fits = run_fits(prepared.runs, prepared.roles, prepared.problem.tape, simulated, fit.runs)
    return VaryingParameter(
        best.name,
        by_run,
        min(1.0, len(variations) * float(np.exp(best.log_p))),
        alternatives,
        {run.name: fits[run.name] for run in prepared.training},
        negative_log_likelihood_of(prepared, fit.evaluation),
    )


def _variations(model: Model, screen: Screen) -> list[_Variation]:
    parameters = model.problem.parameters
    if len(model.prepared.training) < 2 or model.is_exact:
        return []
    return [
        _variation(model, screen, name)
        for k, name in enumerate(parameters.names)
        if parameters.logarithmic[k] and k not in model.fit.at_bound
    ]


def _variation(model: Model, screen: Screen, name: str) -> _Variation:
    block = _own_in_every_run(model, name)
    fit = screen.evidence.regress([block])
    gain = max(screen.evidence.regress().squares - fit.squares, 0.0)
    freedom = len(model.prepared.training) - 1
    log_p = log_p_value(gain / dispersion_by_noise(screen, block), freedom)
    common = np.array(model.fit.coordinates)
    free = [k for k in range(len(common)) if k not in model.fit.at_bound]
    common[free] += fit.parameter_changes[free]
    changes, errors = fit.coefficients[0][:, 0], fit.errors[0][:, 0]
    known = errors > 0
    largest = np.ptp(changes[known]) if known.any() else 0.0
    runs = np.flatnonzero(known & (errors < MAX_ERROR_SHARE * largest)).tolist()
    own = {run: float(model.fit.coordinates[block.columns[0]] + changes[run]) for run in runs}
    return _Variation(name, gain, log_p, common, own)


def _own_in_every_run(model: Model, name: str) -> Block:
    """The block of a parameter with a value of its own in every run."""
    return Block((_place(model, name),), per_run=True)


def _fit(model: Model, variation: _Variation) -> FitByRun | None:
    """The model with a value of one parameter for every run, in full simulation from the first-order estimate; None if
    that estimate makes the runs that determine it worse: far from the common value, the first order may mislead."""
    problem = model.problem
    place, tape = _place(model, variation.name), problem.tape
    coordinates = np.tile(variation.common, (tape.runs, 1))
    coordinates[:, place] = np.mean([*variation.own.values()])
    runs, difference = model.fit.unknowns.runs, 0.0
    before = _squares(model, np.asarray(model.fit.coordinates))[1]
    for run, own in variation.own.items():
        of_tape = model.prepared.training_indices[run]
        coordinates[of_tape, place] = own
        fitted, squares = _squares(model, coordinates[of_tape])
        runs = jax.tree.map(lambda all_runs, new, k=of_tape: all_runs.at[k].set(new[k]), runs, fitted)
        difference += squares[of_tape] - before[of_tape]
    if difference >= 0:
        return None
    return fit_by_run(problem, place, coordinates, runs, model.fit.at_bound)


def _squares(
    model: Model, coordinates: Float[np.ndarray, " parameters"]
) -> tuple[RunUnknowns, Float[np.ndarray, " runs"]]:
    """The best own unknowns of every run for these coordinates, and the sums of squares with them."""
    problem = replace(model.problem, noise=jnp.asarray(model.fit.noise))
    unknowns = model.fit.unknowns._replace(coordinates=jnp.asarray(coordinates))
    fitted, evaluation = fit_run_unknowns(problem, unknowns)
    return fitted.runs, squares_of_runs(problem, evaluation)


def _estimates_by_run(model: Model, variation: _Variation, fit: FitByRun) -> dict[str, Estimate]:
    """The parameter in each run that determines it."""
    prepared, place, fixed = model.prepared, _place(model, variation.name), [*model.fit.at_bound]
    parameters, coordinates = prepared.problem.parameters, fit.coordinates
    unseen = information_of(prepared.problem, model.fit).unseen
    if not sees_torque_scale(unseen, parameters.names):  # Kt = Kb, as in the identified motor
        Kb, Kt = (parameters.value(name, coordinates[0]) for name in ("Kb", "Kt"))
        coordinates = parameters.with_torques_scaled(coordinates, Kb / Kt)
        fixed.append(parameters.names.index("Kt"))
    own = coordinates[model.prepared.training_indices, place]
    errors, reaches = errors_by_run(prepared.problem, fit, place, fixed)
    return {
        run.name: _estimate(variation.name, *of_run)
        for run, *of_run in zip(prepared.training, own, errors, reaches, strict=True)
        if of_run[1] < MAX_ERROR_SHARE * variation.range
    }


def _estimate(name: str, logarithm: float, error: float, reach: float) -> Estimate:
    value, low, high = (float(np.exp(logarithm + x)) for x in (0.0, -reach, reach))
    return Estimate(value, value * error, (low, high), unit_of(name), "identified")


def _place(model: Model, name: str) -> int:
    return model.problem.parameters.names.index(name)
