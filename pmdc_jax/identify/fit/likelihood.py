"""Likelihood of recordings under a fit with coloured residuals, which decides on corrections for their sensors."""

from __future__ import annotations

import numpy as np

from ..noise.noise_model import Series, fit_whitener
from ..noise.sensor_noise import ratio_to_noise
from ..prepare import Prepared
from ..problem import Evaluation
from .fitted_runs import FittedRuns
from .generalised_least_squares import series_of

# Root mean square of residuals, over the white noise of the sensor, up to which they are nothing but that noise
MAX_NOISE_RATIO = 1.3
# Gain in log-likelihood from which a recording is interpreted in another way than by default
MIN_LOG_LIKELIHOOD_GAIN = 30.0


def negative_log_likelihood(fitted: FittedRuns) -> float:
    """Negative log-likelihood of the training runs, up to a constant; see `negative_log_likelihood_of`."""
    return negative_log_likelihood_of(fitted.prepared, fitted.fit.evaluation)


def negative_log_likelihood_of(prepared: Prepared, evaluation: Evaluation) -> float:
    """Negative log-likelihood of the training runs, beside a simulation of them, up to a constant.

    Of Gaussian innovations: the one-step prediction errors of an autoregressive model of the residuals.

    **Source**: Ljung, "System Identification", 2nd edition, section 7.4.
    """
    tape, simulated, total = prepared.problem.tape, np.asarray(evaluation.simulated), 0.0
    for run in prepared.training_indices:
        measured = series_of(tape, run, np.asarray(tape.measured))
        expected = series_of(tape, run, simulated).values
        if not np.isfinite(expected).all():
            return np.inf  # it diverges
        residual = Series(measured.values - expected, measured.known, measured.kind)
        white = fit_whitener([residual])
        rest = white(0, residual).reshape(-1, expected.shape[1])
        spread = np.linalg.slogdet(rest.T @ rest / len(rest))[1]
        total += len(rest) * (spread / 2 - np.linalg.slogdet(white.scales[0])[1])
    return float(total)


def leaves_only_noise(fitted: FittedRuns) -> bool:
    """Whether a fit leaves nothing of the training runs but the white noise of the sensors."""
    prepared, training = fitted.prepared, fitted.prepared.training_indices
    tape = prepared.problem.tape
    measured = [tape.samples_of(k, np.asarray(tape.measured), len(prepared.runs[k])) for k in training]
    pairs = list(zip(measured, map(fitted.residuals, training), strict=True))
    return all(
        ratio_to_noise((signal[:, c], left[:, c]) for signal, left in pairs) <= MAX_NOISE_RATIO for c in range(2)
    )
