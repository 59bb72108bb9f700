"""How likely recordings are by a fit, whatever the colour of what it leaves: what tells of the sensors themselves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from .generalised_least_squares import series_of, training_runs
from .noise_model import Series, whitener
from .polish import Fit
from .prepare import Prepared

Samples = Float[np.ndarray, " samples"]

# Records are taken otherwise than they came if that is so much likelier, by the logarithm
LIKELIER = 30.0


def negative_log_likelihood(
    given: Prepared, fit: Fit, sensed: Callable[[Samples], Samples] = lambda speed: speed
) -> float:
    """Minus the logarithm of the likelihood of the training runs as recorded, but for a constant.

    That of Gaussian innovations: what is left of the residuals when an autoregression has foretold what it can.

    **Arguments**: `fit`, to these recordings or to some that were mended; `sensed`, what a sensor makes of the speed
    of a run. **Source**: Ljung, "System Identification", 2nd edition, section 7.4.
    """
    tape, seen, total = given.problem.tape, np.asarray(fit.evaluation.seen), 0.0
    for run in training_runs(given):
        measured = series_of(tape, run, np.asarray(tape.measured))
        simulated = series_of(tape, run, seen).values.copy()
        if 1 in measured.kind[1]:
            simulated[:, -1] = sensed(simulated[:, -1])
        residual = Series(measured.values - simulated, measured.known, measured.kind)
        white = whitener([residual])
        rest = white(0, residual).reshape(-1, simulated.shape[1])
        spread = np.linalg.slogdet(rest.T @ rest / len(rest))[1]
        total += len(rest) * (spread / 2 - np.linalg.slogdet(white.scales[0])[1])
    return float(total)
