"""The Gauss-Newton step of a fit, and the noise by which its outputs are weighted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...simulate import UNKNOWNS_PER_RUN
from ..noise.sensor_noise import MIN_RELATIVE_NOISE
from ..problem import Evaluation, Problem

# Predicted reduction of the sum of squares, in noise variances, below which no step is taken: the square of 0.045
# standard errors
TOLERANCE = 2e-3
# ... in fits that are only compared: far less than the differences that decide
TRIAL_TOLERANCE = 0.5
# Curvature added to every coordinate in a step, as a prior that knows each to within a factor of e or its scale, and to
# the initial state, as one that knows it to within what was measured: negligible for what the data determine, while
# what they do not determine, such as a current that has settled before it is read, stays where it is
RIDGE = 1.0


def squares_of_runs(problem: Problem, evaluation: Evaluation) -> Float[np.ndarray, " runs"]:
    """Sum of squared residuals of each run; infinite where its simulation fails."""
    with np.errstate(over="ignore", invalid="ignore"):
        of_block = np.square(np.asarray(evaluation.residuals)).sum((1, 2))
    sound = np.nan_to_num(of_block, nan=np.inf)
    return np.bincount(np.asarray(problem.tape.run), sound, problem.tape.runs)


def squares_of_outputs(problem: Problem, evaluation: Evaluation) -> Float[np.ndarray, "2"]:
    """Sum of squared residuals of each output in the training runs."""
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        return np.square(np.asarray(evaluation.residuals)[problem.fitted_blocks]).sum((0, 2))


def ridge_of(problem: Problem) -> Float[np.ndarray, " unknowns"]:
    """The curvature added to each unknown in a step: the coordinates, then the own unknowns of run after run."""
    rms = problem.measured_rms
    own = np.zeros((problem.tape.runs, UNKNOWNS_PER_RUN))
    own[:, :2] = np.where(rms > 0, 1 / np.where(rms > 0, rms, 1.0) ** 2, 0.0)
    return np.concatenate([np.full(len(problem.free), RIDGE), own.ravel()])


def gauss_newton_step(
    matrix: np.ndarray, fixed: set[int], ridge: Float[np.ndarray, " unknowns"]
) -> tuple[np.ndarray, float]:
    """The Gauss-Newton step, and the reduction of the sum of squares that it predicts.

    **Arguments**: `matrix`, as from `normal_matrix`; `fixed`, which unknowns stay fixed; `ridge`, as from `ridge_of`.
    """
    gradient, hessian = matrix[:-1, -1].copy(), matrix[:-1, :-1].copy()
    if not np.all(np.isfinite(matrix)):
        return np.zeros(len(gradient)), np.inf
    for k in fixed:
        gradient[k] = hessian[k, :] = hessian[:, k] = 0.0
    hessian[np.diag_indices_from(hessian)] += ridge
    lengths = np.sqrt(np.diag(hessian))
    moves = lengths > 0
    lengths = np.where(moves, lengths, 1.0)
    values, vectors = np.linalg.eigh(hessian / lengths[:, None] / lengths)
    along = vectors.T @ (gradient / lengths)
    visible = values > 1e-12 * values.max(initial=1e-300)
    along = np.where(visible, along, 0.0)
    shrunk = along / np.where(visible, values, 1.0)
    # an unknown that no residual depends on must not drift by rounding errors
    return -(vectors @ shrunk) / lengths * moves, float(along @ shrunk)


def residual_noise(
    problem: Problem, squares: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Standard deviation of the residuals of each output, and the old scale over the new; whitened ones keep theirs.

    It is at least `MIN_RELATIVE_NOISE` times the root mean square of the measurement: without noise, the likelihood is
    greatest where one output is met exactly, whatever becomes of the other.
    """
    if problem.whitening is not None:
        return np.asarray(problem.noise), np.ones(2)
    noise = np.asarray(problem.noise)
    ratio = np.sqrt(squares / np.maximum(problem.samples, 1.0))
    ratio = np.maximum(ratio, MIN_RELATIVE_NOISE * problem.measured_rms / noise)
    ratio = np.where(ratio == 0, 1.0, ratio)
    return noise * ratio, 1 / ratio
