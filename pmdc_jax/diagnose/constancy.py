"""Parameters that are not the same in all runs, such as the resistance of a winding that was warmer in some of them.

Each parameter of the motor is given a value of its own in every run, to first order: a score test of the hypothesis of
Chow, "Tests of equality between sets of coefficients in two linear regressions", Econometrica 28 (1960) 591-605.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from ..identify.identification import Estimate
from ..identify.parameters import unit_of
from ..motor import PARAMETERS
from .assessment import FALSE_ALARM, Assessment
from .diagnosis import VaryingParameter
from .evidence import Block
from .model import Model
from .signals import Screen, dispersion_by_noise, log_p_value

# Least change of a parameter from run to run that counts: those of simulators and clocks look like smaller ones
MIN_CHANGE = 0.01
# A run determines a parameter if its standard error there is below this share of the change from run to run
MAX_ERROR_SHARE = 0.3
# Parameters that gain at least this share of what the best one does may vary in its place
ALTERNATIVE_SHARE = 0.9


class _Variation(NamedTuple):
    """One parameter with a value of its own in every run."""

    name: str
    gain: float  # decrease of the squared white residuals
    log_p: float  # natural logarithm of the p-value of such a gain by noise
    by_run: dict[str, Estimate]  # of the runs that determine it


def varying_parameter(model: Model, found: Assessment) -> VaryingParameter | None:
    """The parameter whose variation from run to run explains most of what a model leaves; None if no variation is
    significant, or if a candidate or a curve explains more."""
    variations = sorted(_variations(model, found.screen), key=lambda v: -v.gain)
    limit = np.log(FALSE_ALARM / max(len(variations), 1))
    clear = [v for v in variations if v.log_p < limit and _change(v) > MIN_CHANGE]
    if not clear or clear[0].gain < found.clearest.gain:
        return None
    best, *others = clear
    return VaryingParameter(
        best.name,
        best.by_run,
        min(1.0, len(variations) * float(np.exp(best.log_p))),
        tuple(v.name for v in others if v.gain > ALTERNATIVE_SHARE * best.gain),
    )


def share_beyond_variation(found: Screen, model: Model, name: str) -> float:
    """Share of a model's unfiltered squared residuals that remains where a parameter has a value in every run."""
    block = _own_in_every_run(model, name)
    return found.unfiltered.regress([block]).squares / found.unfiltered.regress().squares


def _variations(model: Model, found: Screen) -> list[_Variation]:
    several = len(model.given.training) > 1 and not model.is_exact
    names = model.given.problem.parameters.names if several else ()
    return [
        _variation(model, found, name)
        for k, name in enumerate(names)
        if name in PARAMETERS and k not in model.fit.at_bound
    ]


def _variation(model: Model, found: Screen, name: str) -> _Variation:
    block, runs = _own_in_every_run(model, name), model.given.training
    fit = found.evidence.regress([block])
    gain = max(found.evidence.regress().squares - fit.squares, 0.0)
    log_p = log_p_value(gain / dispersion_by_noise(found, block), len(runs) - 1)
    changes, errors = fit.coefficients[0][:, 0], fit.errors[0][:, 0]
    common = model.given.problem.parameters.value(name, np.asarray(model.fit.coordinates))
    by_run = {
        runs[run].name: _estimate(name, common, float(changes[run]), float(errors[run]))
        for run in _determined(changes, errors)
    }
    return _Variation(name, gain, log_p, by_run)


def _own_in_every_run(model: Model, name: str) -> Block:
    return Block((model.given.problem.parameters.names.index(name),), per_run=True)


def _determined(changes: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """The runs that determine the parameter (`MAX_ERROR_SHARE`)."""
    seen = errors > 0
    largest = np.ptp(changes[seen]) if seen.any() else 0.0
    return np.flatnonzero(seen & (errors < MAX_ERROR_SHARE * largest))


def _estimate(name: str, common: float, change: float, error: float) -> Estimate:
    """From the change of the logarithm in one run, and its standard error."""
    reach = stats.norm.ppf(0.975) * error
    value, low, high = (float(common * np.exp(change + x)) for x in (0.0, -reach, reach))
    return Estimate(value, value * error, (low, high), unit_of(name), "identified")


def _change(variation: _Variation) -> float:
    """The largest value of any run over the smallest, less one."""
    values = [one.value for one in variation.by_run.values() if one.value]
    return max(values) / min(values) - 1 if len(values) > 1 else 0.0
