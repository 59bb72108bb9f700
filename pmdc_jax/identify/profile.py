"""Profile likelihood intervals, where a parabola is a poor picture of the sum of squares."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from .polish import gauss_newton_step
from .problem import Problem, Unknowns, evaluate, normal_matrix

# A coordinate (natural logarithm) surer than this is as good as quadratic: its profile is not drawn.
QUADRATIC = 0.05
ROUNDS = 5  # of the search for each end of the interval
REFITS = 2  # Gauss-Newton steps of the other unknowns at each trial


def profile_interval(
    problem: Problem, best: Unknowns, index: int, spread: float, inflation: float, reach: float
) -> tuple[float, float]:
    """Ends of the interval of one coordinate in which the refitted sum of squares stays low.

    With the coordinate held at a trial value everything else is refitted; the interval ends where the sum of
    squares, over the noise variance, has risen by `reach`^2 times `inflation`.

    **Arguments**: `index` of the coordinate; `spread`, its standard error, to start from; `inflation`, how much
    larger its variance is than white residuals would give; `reach`, 1.96 for 95 %.

    **Source**: Venzon, Moolgavkar, Applied Statistics 37 (1988), doi:10.2307/2347496; scaled for correlated
    residuals as a quasi-likelihood, McCullagh (1983).
    """
    centre = float(best.coordinates[index])
    limits = (float(problem.parameters.lower[index]), float(problem.parameters.upper[index]))
    lowest = _refitted(problem, best, index, centre)[1]
    ends = []
    for sign, limit in zip((-1.0, 1.0), limits, strict=True):
        distance, unknowns = reach * spread, best
        for _ in range(ROUNDS):
            trial = centre + sign * min(distance, abs(limit - centre))
            unknowns, squares = _refitted(problem, unknowns, index, trial)
            rise = np.sqrt(max(squares - lowest, 1e-12) / inflation)
            # the root of the rise is a straight line where the picture is quadratic
            distance = abs(trial - centre) * min(max(reach / rise, 0.3), 3.0)
            if abs(rise / reach - 1) < 0.02:
                break
        ends.append(centre + sign * min(distance, abs(limit - centre)))
    return ends[0], ends[1]


def _refitted(
    problem: Problem, start: Unknowns, index: int, value: float
) -> tuple[Unknowns, float]:
    """All other unknowns refitted, and the sum of squares there, as the last step foretells it."""
    unknowns = start._replace(coordinates=start.coordinates.at[index].set(value))
    count, squares = len(start.coordinates), np.inf
    for _ in range(REFITS):
        matrix = np.array(
            normal_matrix(evaluate(problem, unknowns), problem.tape, problem.fitted_runs)
        )
        step, gain = gauss_newton_step(matrix, {index}, count)
        squares = matrix[-1, -1] - gain
        moved = np.asarray(unknowns.coordinates) + step[:count]
        inside = np.clip(moved, problem.parameters.lower, problem.parameters.upper)
        unknowns = Unknowns(
            jnp.asarray(inside),
            unknowns.local + jnp.asarray(step[count:]).reshape(unknowns.local.shape),
        )
    return unknowns, float(squares) if np.isfinite(squares) else 1e300
