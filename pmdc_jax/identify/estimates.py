"""Estimates of the parameters with their intervals and status."""

from __future__ import annotations

import numpy as np

from ..motor import PARAMETERS
from ..runtime.threads import map_in_threads
from .fit.refine import Optimum
from .identification import Estimate, Status
from .parameters import Parameters, unit_of
from .prepare import Prepared
from .problem import Problem
from .uncertainty.covariance import MIN_UNSEEN_STDERR, Information
from .uncertainty.identifiability import MIN_SHARE
from .uncertainty.profile import QUADRATIC_STDERR, profile_interval


def estimates_of(problem: Problem, best: Optimum, info: Information, prepared: Prepared) -> dict[str, Estimate]:
    """The estimate of each parameter, from the best fit and what the runs tell of it."""
    parameters, intervals = problem.parameters, _intervals(problem, best, info)
    coordinates = np.asarray(best.unknowns.coordinates)
    ties = dict(parameters.ties)
    names = [*PARAMETERS, *(n for n in parameters.names if n not in PARAMETERS)]
    estimates = {}
    for name in names:
        unit, source = unit_of(name), ties.get(name, name)
        if source in prepared.irrelevant and source not in prepared.known:
            estimates[name] = Estimate(None, None, None, unit, "not_identifiable")
            continue
        value = parameters.value(name, coordinates)
        if source in prepared.known:
            estimates[name] = Estimate(value, 0.0, (value, value), unit, "known")
            continue
        k = parameters.names.index(source)
        status = _status(k, parameters, best, info)
        if status != "identified":
            estimates[name] = Estimate(value, None, None, unit, status)
            continue
        spread = float(np.sqrt(info.covariance[k, k]))
        low, high = (parameters.in_SI(k, end) for end in intervals[k])
        stderr = spread * (value if parameters.logarithmic[k] else float(parameters.scale[k]))
        estimates[name] = Estimate(value, stderr, (low, high), unit, "tied" if name in ties else status)
    return estimates


def _intervals(problem: Problem, best: Optimum, info: Information) -> dict[int, tuple[float, float]]:
    """The 95 % intervals of the identified coordinates, in parallel on all cores."""
    coordinates = np.asarray(best.unknowns.coordinates)
    # teeth that meet at another moment change all that follows: the sum of squares jumps, and no profile is smooth
    jumps = problem.parameters(best.unknowns.coordinates).gear is not None

    def interval(k: int) -> tuple[float, float]:
        spread, reach = float(np.sqrt(info.covariance[k, k])), float(info.interval_factor[k])
        # the refits of a profile would not reach as far along an unseen direction as the truth may lie
        hidden = info.unseen_variance[k] > info.covariance[k, k] / 2
        quadratic = not problem.parameters.logarithmic[k] or spread < QUADRATIC_STDERR
        if quadratic or hidden or jumps:
            return coordinates[k] - reach * spread, coordinates[k] + reach * spread
        return profile_interval(problem, best.unknowns, k, spread, info.inflation[k], reach)

    places = range(len(coordinates))
    identified = [k for k in places if _status(k, problem.parameters, best, info) == "identified"]
    return dict(zip(identified, map_in_threads(interval, identified), strict=True))


def _status(k: int, parameters: Parameters, best: Optimum, info: Information) -> Status:
    if k in best.at_bound:
        return "at_bound"
    variance, unseen_variance = info.covariance[k, k], info.unseen_variance[k]
    if info.unseen_share[k] > MIN_SHARE or np.sqrt(variance) > MIN_UNSEEN_STDERR:
        return "not_identifiable"
    # a torque of either sign whose scale is unseen: a small one does not make up much of a direction
    size = 0.0 if parameters.logarithmic[k] else abs(float(best.unknowns.coordinates[k]))
    if size and np.sqrt(unseen_variance) > max(MIN_UNSEEN_STDERR * size, np.sqrt(variance / 2)):
        return "not_identifiable"
    return "identified"
