"""Parameters that are not the same in all runs, such as the resistance of a winding that was warmer in some of them.

Each parameter of the motor is given a value of its own in every run, to first order: a score test of the hypothesis of
Chow, "Tests of equality between sets of coefficients in two linear regressions", Econometrica 28 (1960) 591-605.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from ..identify.identification import Estimate
from ..identify.parameters import unit_of
from ..identify.polish import fit_run_unknowns, squares_of_runs
from ..motor import PARAMETERS
from .assessment import FALSE_ALARM, Assessment
from .diagnosis import VaryingParameter
from .evidence import Block
from .model import Model
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
    gain: float  # decrease of the squared white residuals
    log_p: float  # natural logarithm of the p-value of such a gain by noise
    common: Float[np.ndarray, " parameters"]  # the search coordinates of all other parameters
    own: dict[int, float]  # its own coordinate in each of the runs that determine it
    errors: dict[int, float]  # their standard errors

    @property
    def range(self) -> float:
        """The largest coordinate of any run less the smallest."""
        return float(np.ptp([*self.own.values()])) if self.own else 0.0


def varying_parameter(model: Model, found: Assessment) -> VaryingParameter | None:
    """The parameter of the motor whose variation from run to run explains most of what a model leaves.

    None if no variation is significant, if a candidate or a curve explains more, if a parameter of an effect may vary
    instead, whose formula is then not quite the motor's, or if a simulation with the values found fits no better.
    """
    variations = sorted(_variations(model, found.screen), key=lambda v: -v.gain)
    limit = np.log(FALSE_ALARM / max(len(variations), 1))
    clear = [v for v in variations if v.log_p < limit and v.range > MIN_RANGE]
    if not clear or clear[0].gain < found.clearest.gain:
        return None
    best, *others = (v for v in clear if v.gain > ALTERNATIVE_SHARE * clear[0].gain)
    alternatives = tuple(v.name for v in others)
    if not {best.name, *alternatives} <= PARAMETERS.keys() or not _fits_better(model, best):
        return None
    return VaryingParameter(
        best.name,
        {
            model.given.training[run].name: _estimate(best.name, own, best.errors[run])
            for run, own in best.own.items()
        },
        min(1.0, len(variations) * float(np.exp(best.log_p))),
        alternatives,
    )


def _variations(model: Model, found: Screen) -> list[_Variation]:
    parameters = model.given.problem.parameters
    if len(model.given.training) < 2 or model.is_exact:
        return []
    return [
        _variation(model, found, name)
        for k, name in enumerate(parameters.names)
        if parameters.logarithmic[k] and k not in model.fit.at_bound
    ]


def _variation(model: Model, found: Screen, name: str) -> _Variation:
    block = own_in_every_run(model, name)
    fit = found.evidence.regress([block])
    gain = max(found.evidence.regress().squares - fit.squares, 0.0)
    freedom = len(model.given.training) - 1
    log_p = log_p_value(gain / dispersion_by_noise(found, block), freedom)
    common = np.asarray(model.fit.coordinates) + fit.parameter_changes
    changes, errors = fit.coefficients[0][:, 0], fit.errors[0][:, 0]
    known = errors > 0
    largest = np.ptp(changes[known]) if known.any() else 0.0
    runs = np.flatnonzero(known & (errors < MAX_ERROR_SHARE * largest)).tolist()
    own = {run: float(model.fit.coordinates[block.columns[0]] + changes[run]) for run in runs}
    return _Variation(name, gain, log_p, common, own, {run: float(errors[run]) for run in runs})


def own_in_every_run(model: Model, name: str) -> Block:
    """The block of a parameter with a value of its own in every run."""
    return Block((model.given.problem.parameters.names.index(name),), per_run=True)


def _fits_better(model: Model, found: _Variation) -> bool:
    """Whether the runs are simulated with less error if each has its own value: far from the common one, the first
    order may mislead."""
    problem = replace(model.given.problem, noise=jnp.asarray(model.fit.noise))
    place = problem.parameters.names.index(found.name)

    def squares(coordinates: np.ndarray) -> np.ndarray:
        unknowns = model.fit.unknowns._replace(coordinates=jnp.asarray(coordinates))
        return squares_of_runs(problem, fit_run_unknowns(problem, unknowns)[1])

    before, difference = squares(np.asarray(model.fit.coordinates)), 0.0
    for run, own in found.own.items():
        coordinates = found.common.copy()
        coordinates[place] = own
        of_tape = model.training[run]
        difference += squares(coordinates)[of_tape] - before[of_tape]
    return bool(difference < 0)


def _estimate(name: str, logarithm: float, error: float) -> Estimate:
    reach = stats.norm.ppf(0.975) * error
    value, low, high = (float(np.exp(logarithm + x)) for x in (0.0, -reach, reach))
    return Estimate(value, value * error, (low, high), unit_of(name), "identified")
