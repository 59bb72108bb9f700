"""Score test for dry friction in a fit without it: most motors have some, and f compensates for it.

The response of the outputs to a constant torque against the simulated motion is one more column of the regression at
the end of the fit, on rows filtered so that its residuals are white. No motor is fitted again.

**Source**: Rao, Proceedings of the Cambridge Philosophical Society 44 (1948), doi:10.1017/S0305004100023987.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..recordings.recording import OVER_LAST
from ..simulate import UNKNOWNS_PER_RUN
from .fit.generalised_least_squares import residuals_of, series_of, series_of_samples
from .fit.polish import Fit
from .identification import Identification
from .load_response import load_filter, load_response
from .noise.noise_model import Series, Whitener, fit_whitener, scaling_whitener
from .prepare import Prepared

# Standard errors above zero from which friction is significant
MIN_Z_SCORE = 5.0
# Shift of a parameter, in its own standard errors, from which it is said to compensate for friction
MIN_BIAS = 2.0
# The effect to suggest
FRICTION = "coulomb_friction"
# Least eigenvalue of a normalised normal matrix, over the largest, of a direction that the rows determine
RANK_TOLERANCE = 1e-9


class MissingFriction(NamedTuple):
    """Dry friction that a fit lacks."""

    friction_Nm: float
    z_score: float  # its value in standard errors
    # without friction in the model, of the logarithms of positive parameters, and of others in SI
    bias: Float[np.ndarray, " parameters"]


def missing_friction(prepared: Prepared, fit: Fit) -> MissingFriction | None:
    """The dry friction that a fit to the training runs lacks; None if it has some already or lacks none clearly."""
    problem, count = prepared.problem, len(prepared.problem.free)
    if any(effect.holds == "speed" for effect in problem.parameters.effects):
        return None
    rows = _regression_columns(prepared, fit)
    residuals = [series._replace(values=series.values[..., -1]) for series in rows]
    regression = _regress(rows, scaling_whitener(residuals), count)
    if regression.z_score(count) <= MIN_Z_SCORE:  # too large rather than too small where the noise is coloured
        return None
    regression = _regress(rows, fit_whitener(regression.residuals), count)
    z_score = regression.z_score(count)
    if not z_score > MIN_Z_SCORE:
        return None
    bias = regression.coefficients[:count] * problem.parameters.scale
    return MissingFriction(float(regression.coefficients[count]), z_score, np.asarray(bias))


def friction_messages(missing: MissingFriction | None, identification: Identification) -> Iterator[str]:
    """A message on the friction that a fit lacks, if a parameter compensates for it by more than `MIN_BIAS` of its
    standard errors, or if the residuals are far larger than the noise, so that no standard error is reliable."""
    if missing is None or identification.covariance is None:
        return
    # of the free parameters, which come before the tied ones
    errors = np.sqrt(np.diag(identification.covariance))[: len(missing.bias)]
    bias = np.abs(missing.bias) / np.where(errors > 0, errors, np.inf)
    worst = int(np.argmax(bias))
    if bias[worst] > MIN_BIAS:
        wrong = f", and without it {identification.covariance_names[worst]} is biased by more than its standard error"
    elif identification.missed:
        wrong = ""
    else:
        return
    yield (
        f"dry friction of about {missing.friction_Nm:.2g} N m would explain part of the residuals "
        f"({missing.z_score:.0f} standard errors){wrong}: add `--effect {FRICTION}`, or run `pmdc diagnose` to find "
        "what is missing"
    )


def _regression_columns(prepared: Prepared, fit: Fit) -> list[Series]:
    """Columns of the regression for each training run, in A and rad/s: the derivatives with respect to the motor's
    parameters, the response to 1 N m of dry friction, the derivatives with respect to the run's own unknowns, and last
    the residual."""
    problem, tape = prepared.problem, prepared.problem.tape
    motor, count = problem.parameters(fit.coordinates), len(problem.free)
    of_grid = {tape.grid_of(run): run for run in prepared.training_indices}
    filters = {grid: load_filter(motor, tape, run) for grid, run in of_grid.items()}
    J = np.asarray(fit.evaluation.jacobian) * fit.noise[:, None, None]
    rows = []
    for run, residual in zip(prepared.training_indices, residuals_of(prepared, fit), strict=True):
        speed = np.asarray(fit.evaluation.simulated)[tape.blocks_of(run), 1].ravel()
        friction = load_response(filters[tape.grid_of(run)], np.sign(speed))
        if (averaging := prepared.runs[run].averaging) is not None:
            friction[:, 1] = averaging.applied_to(friction[:, 1], tape.span_of(run))
        if prepared.runs[run].current_averaged:
            friction[:, 0] = OVER_LAST.applied_to(friction[:, 0])
        derivatives = series_of(tape, run, J).values
        of_friction = series_of_samples(tape, run, friction).values
        columns = (derivatives[..., :count], of_friction, derivatives[..., count:], residual.values)
        sized = [c if c.ndim == 3 else c[..., None] for c in columns]
        rows.append(residual._replace(values=np.concatenate(sized, -1)))
    return rows


class _Regression(NamedTuple):
    """Least squares of the residuals on the columns shared by all runs and on each run's own."""

    coefficients: Float[np.ndarray, " shared"]
    # for residuals of unit variance, as a whitener scales them
    standard_errors: Float[np.ndarray, " shared"]
    residuals: list[Series]  # of the regression, before whitening

    def z_score(self, k: int) -> float:
        """A coefficient in standard errors; zero where no row depends on it."""
        error = self.standard_errors[k]
        return float(self.coefficients[k] / error) if error > 0 else 0.0


def _regress(rows: Sequence[Series], whiten: Whitener, count: int) -> _Regression:
    shared = [*range(count + 1), -1]  # the motor's columns, that of friction, and the residual
    own = slice(count + 1, count + 1 + UNKNOWNS_PER_RUN)
    normal, projections = np.zeros((len(shared), len(shared))), []
    for run, series in enumerate(rows):
        white = whiten(run, series)
        of_all, of_run = white[:, shared], white[:, own]
        projection = _inverse(of_run.T @ of_run) @ of_run.T @ of_all
        orthogonal = of_all - of_run @ projection
        normal += orthogonal.T @ orthogonal
        projections.append(projection)
    inverse = _inverse(normal[:-1, :-1])
    coefficients = inverse @ normal[:-1, -1]
    residuals = [
        series._replace(
            values=series.values[..., -1]
            - series.values[..., shared[:-1]] @ coefficients
            - series.values[..., own] @ (projection[:, -1] - projection[:, :-1] @ coefficients)
        )
        for series, projection in zip(rows, projections, strict=True)
    ]
    return _Regression(coefficients, np.sqrt(np.maximum(np.diag(inverse), 0.0)), residuals)


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The inverse on the directions that the rows determine."""
    lengths = np.sqrt(np.diag(matrix))
    units = np.outer(*2 * [np.where(lengths > 0, lengths, 1.0)])
    return np.linalg.pinv(matrix / units, RANK_TOLERANCE, hermitian=True) / units
