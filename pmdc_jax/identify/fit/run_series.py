"""A fit as signals of each run in the order of time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..noise.noise_model import Series
from ..prepare import Prepared
from .generalised_least_squares import residuals_of, series_of
from .polish import Fit


class RunSeries(NamedTuple):
    """One training run, in A and rad/s."""

    shared: Series  # derivatives of the simulated outputs by the search coordinates
    own: Series  # ... and by the run's own unknowns (initial state, load, ...)
    residual: Series  # measured less simulated
    simulated: Series

    def without_own(self, rest: Float[np.ndarray, "samples outputs"]) -> Series:
        """What is left of the residuals, less what the run's own unknowns explain of it."""
        known, own = self.residual.known, self.own.values
        unknowns = np.linalg.lstsq(own[known].reshape(-1, own.shape[-1]), rest[known].ravel())[0]
        return self.residual._replace(values=rest - own @ unknowns)


def series_of_runs(prepared: Prepared, fit: Fit) -> list[RunSeries]:
    """A fit to plain residuals in every training run."""
    evaluation, tape = fit.evaluation, prepared.problem.tape
    J = np.asarray(evaluation.jacobian) * fit.noise[:, None, None]
    count = prepared.problem.free.shape[0]
    return [
        RunSeries(
            series_of(tape, run, J[..., :count]),
            series_of(tape, run, J[..., count:]),
            residual,
            series_of(tape, run, np.asarray(evaluation.simulated)),
        )
        for run, residual in zip(prepared.training_indices, residuals_of(prepared, fit), strict=True)
    ]
