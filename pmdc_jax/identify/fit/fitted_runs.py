"""Runs together with the fit to them: what a correction takes and returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..prepare import Prepared
from ..problem import Problem
from .gauss_newton import TOLERANCE
from .polish import Fit, polish
from .refine import Optimum


class FittedRuns(NamedTuple):
    """Prepared runs, corrected or as recorded, and the fit to them."""

    prepared: Prepared
    fit: Fit

    @classmethod
    def polished(cls, prepared: Prepared, start: Optimum, tolerance: float = TOLERANCE) -> FittedRuns:
        """The runs, and the fit to them that `polish` finds from a start."""
        return cls(prepared, polish(prepared.problem, start, tolerance=tolerance))

    @property
    def problem(self) -> Problem:
        """The least-squares problem of the runs."""
        return self.prepared.problem

    def residuals(self, run: int) -> Float[np.ndarray, "samples 2"]:
        """Measured less simulated current and speed of a run, A and rad/s; NaN where nothing was measured."""
        tape = self.problem.tape
        signals = (np.asarray(x) for x in (tape.measured, self.fit.evaluation.simulated, tape.weight))
        measured, simulated, weight = (tape.samples_of(run, x, len(self.prepared.runs[run])) for x in signals)
        return np.where(weight > 0, measured - simulated, np.nan)
