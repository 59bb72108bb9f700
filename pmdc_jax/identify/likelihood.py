"""How likely recordings are by a fit, whatever the colour of what it leaves: what tells of the sensors themselves."""

from __future__ import annotations

import numpy as np

from .generalised_least_squares import series_of, training_runs
from .noise_model import Series, whitener
from .polish import Fit
from .prepare import Prepared

# Records are taken otherwise than they came if that is so much likelier, by the logarithm
LIKELIER = 30.0


def negative_log_likelihood(given: Prepared, fit: Fit) -> float:
    """Minus the logarithm of the likelihood of the training runs as recorded, but for a constant.

    That of Gaussian innovations: what is left of the residuals when an autoregression has foretold what it can.

    **Arguments**: `fit`, to these recordings or to some that were mended.
    **Source**: Ljung, "System Identification", 2nd edition, section 7.4.
    """
    tape, seen, total = given.problem.tape, np.asarray(fit.evaluation.seen), 0.0
    for run in training_runs(given):
        measured = series_of(tape, run, np.asarray(tape.measured))
        simulated = series_of(tape, run, seen).values
        residual = Series(measured.values - simulated, measured.known, measured.kind)
        white = whitener([residual])
        rest = white(0, residual).reshape(-1, simulated.shape[1])
        spread = np.linalg.slogdet(rest.T @ rest / len(rest))[1]
        total += len(rest) * (spread / 2 - np.linalg.slogdet(white.scales[0])[1])
    return float(total)
