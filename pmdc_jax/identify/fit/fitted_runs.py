"""Runs together with the fit to them: what a correction takes and returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...recordings.recording import OVER_LAST
from ..prepare import Prepared
from ..problem import Problem
from .gauss_newton import TOLERANCE
from .polish import Fit, polish
from .refine import Optimum

# How much smaller an inductance is tried, in natural logarithms
L_REDUCTION = 3.0


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


def refitted(prepared: Prepared, fit: Fit, inductance: float | None = None, tolerance: float = TOLERANCE) -> FittedRuns:
    """The runs, and the best fit to them that starts from `fit`, or from there with a smaller inductance: a large one
    may have compensated part of a sample of delay.

    **Arguments**: `inductance`, H, if it is known about which, to start from; `tolerance`, as of `polish`.
    """
    parameters = prepared.problem.parameters
    starts = [fit.optimum]
    if "L" in parameters.names:
        L = parameters.names.index("L")
        along_L = np.eye(len(parameters.names))[L]
        if inductance is not None:
            change = np.log(inductance) - float(fit.coordinates[L])
            starts = [fit.optimum.moved(parameters, change * along_L)]
        elif prepared.averaging == OVER_LAST or prepared.timing.current_mean:
            smaller = fit.optimum.moved(parameters, -L_REDUCTION * along_L)
            if smaller.unknowns.coordinates[L] < fit.coordinates[L]:  # not at its bound
                starts.append(smaller)
    ends = [FittedRuns.polished(prepared, start, tolerance) for start in starts]
    return min(ends, key=lambda end: end.fit.cost)
