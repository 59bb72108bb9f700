"""Profile likelihood intervals, for parameters in which the sum of squares is not quadratic."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..fit.gauss_newton import gauss_newton_step, ridge_of
from ..problem import Problem, Unknowns, evaluate, flatten, normal_matrix, unflatten

# For a coordinate (natural logarithm) with a smaller standard error the sum of squares is close enough to quadratic.
QUADRATIC_STDERR = 0.05
MAX_ROUNDS = 5  # of the search for each end of the interval
MAX_REFITS = 3  # Gauss-Newton steps of the other unknowns for each trial, at most
# Refits end when one more step would lower the sum of squares by less than this share of the rise that is sought
REFIT_TOLERANCE = 0.05
# An end is found where the root of the rise is within this share of the one sought: far less than an interval's own
# uncertainty
RISE_TOLERANCE = 0.02
# Factors within which the distance from the optimum changes from round to round, as the rise may be far from quadratic
CHANGE_RANGE = (0.3, 3.0)
# Least rise that is told from rounding errors
MIN_RISE = 1e-12


class _Point(NamedTuple):
    """A point on the profile: the normal matrix there, and the sum of squares predicted after one more step."""

    unknowns: Unknowns
    matrix: np.ndarray
    squares: float
    gain: float  # reduction by that step


def profile_interval(
    problem: Problem, best: Unknowns, index: int, spread: float, inflation: float, reach: float
) -> tuple[float, float]:
    """Ends of the profile likelihood interval of one coordinate.

    With the coordinate held at a trial value, all other unknowns are refitted; the interval ends where the sum of
    squares, over the noise variance, has risen by `reach`^2 times `inflation`.

    **Arguments**: `best`, the optimum; `index` of the coordinate; `spread`, its standard error, to start from;
    `inflation`, its variance over that for white residuals; `reach` in standard errors, 1.96 for 95 %.

    **Source**: Venzon, Moolgavkar, Applied Statistics 37 (1988), doi:10.2307/2347496; scaled for correlated
    residuals as a quasi-likelihood, McCullagh (1983).
    """
    lowest = _point(problem, best, index)
    centre, close = float(best.coordinates[index]), REFIT_TOLERANCE * reach**2 * inflation
    limits = (float(problem.parameters.lower[index]), float(problem.parameters.upper[index]))
    ends = []
    for sign, limit in zip((-1.0, 1.0), limits, strict=True):
        distance, point = reach * spread, lowest
        for _ in range(MAX_ROUNDS):
            trial = centre + sign * min(distance, abs(limit - centre))
            point = _refitted(problem, point, index, trial, close)
            rise = np.sqrt(max(point.squares - lowest.squares, MIN_RISE) / inflation)
            # the root of the rise grows linearly with distance where the sum of squares is quadratic
            distance = abs(trial - centre) * float(np.clip(reach / rise, *CHANGE_RANGE))
            if abs(rise / reach - 1) < RISE_TOLERANCE:
                break
        ends.append(centre + sign * min(distance, abs(limit - centre)))
    return ends[0], ends[1]


def _refitted(problem: Problem, point: _Point, index: int, value: float, close: float) -> _Point:
    """The point of the profile at a value of the coordinate, found from another point."""
    for _ in range(MAX_REFITS):
        point = _point(problem, _moved_along_profile(problem, point, index, value), index)
        if not close < point.gain < np.inf:
            break
    return point


def _moved_along_profile(problem: Problem, point: _Point, index: int, value: float) -> Unknowns:
    """The unknowns with the coordinate at a value and all others moved along the profile by a Gauss-Newton step."""
    unknowns, count = point.unknowns, len(point.unknowns.coordinates)
    delta, matrix = value - float(unknowns.coordinates[index]), point.matrix.copy()
    matrix[:-1, -1] += delta * matrix[:-1, index]
    step, _ = gauss_newton_step(matrix, {index}, ridge_of(problem))
    step[index] = delta
    moved = np.asarray(flatten(unknowns)) + step
    moved[:count] = np.clip(moved[:count], problem.parameters.lower, problem.parameters.upper)
    return unflatten(problem, jnp.asarray(moved))


def _point(problem: Problem, unknowns: Unknowns, index: int) -> _Point:
    evaluation = evaluate(problem, unknowns)
    matrix = np.array(normal_matrix(evaluation, problem.tape, problem.fitted_runs))
    gain = gauss_newton_step(matrix, {index}, ridge_of(problem))[1]
    simulated = np.isfinite(matrix[-1, -1]) and np.isfinite(gain)
    squares = float(matrix[-1, -1] - gain) if simulated else 1e300
    return _Point(unknowns, matrix, squares, gain)
