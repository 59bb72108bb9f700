"""Autoregressive models of coloured residuals: one for all runs, or one for each where their colours differ.

**Source**: Lütkepohl, "New Introduction to Multiple Time Series Analysis" (2005), sections 3.2 and 4.3; Corsi, Journal
of Financial Econometrics 7 (2009) 174, doi:10.1093/jjfinec/nbp001 (coefficients that groups of lags share).
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Lags that are tried, none above `CHUNK`, by the last ones of groups with the same coefficients: each lag alone, up to
# several orders, or few groups, for slow noise far below that of a sensor. The Bayesian information criterion chooses.
LAGS = (*(range(1, order + 1) for order in (1, 2, 4, 8, 12, 20, 30)), (30,), (1, 30), (1, 4, 12, 30))
# Rows at least for each coefficient of an output
MIN_ROWS_PER_COEFFICIENT = 20


def autoregressions(
    lagged: Sequence[Float[np.ndarray, "_ columns"]], groupings: Sequence[Sequence[int]], outputs: int
) -> list[Float[np.ndarray, "order outputs outputs"]]:
    """The coefficients A_k of r(t) = sum_k A_k r(t - k) + white noise, for each run: those of all runs together, or its
    own, as the Bayesian information criterion decides.

    **Arguments**: `lagged`, of each run the residuals, and those one sample before, two before, ...; `groupings` of the
    lags, those of `LAGS` for which there are enough rows.
    """
    lags = lagged[0].shape[1] // outputs
    rms = np.sqrt(np.mean(np.square(np.concatenate(lagged)), axis=0))[:outputs] + 1e-300
    runs = [_Products.of(rows / np.tile(rms, lags), outputs) for rows in lagged]
    long = [k for k, run in enumerate(runs) if run.rows >= least_rows(groupings[0], outputs)]
    shared = _autoregression([runs[k] for k in long] or runs, groupings)
    own = {k: _autoregression([runs[k]], groupings) for k in long}
    differ = sum(of_run.criterion for of_run in own.values()) < shared.criterion
    chosen = [own.get(k, shared) if differ else shared for k in range(len(runs))]
    return [A.reshape(-1, outputs, outputs).transpose(0, 2, 1) * rms[:, None] / rms for A, _ in chosen]


def least_rows(lags: Sequence[int], outputs: int) -> int:
    """Fewest rows from which a filter is fitted: with fewer it would follow the noise of this very record."""
    return MIN_ROWS_PER_COEFFICIENT * lags[-1] * outputs


class _Products(NamedTuple):
    """Sums of the products of the residuals of a run, and of those before them, over the variance of that run, because
    noise may differ between runs."""

    sums: Float[np.ndarray, "columns columns"]
    rows: int
    outputs: int

    @classmethod
    def of(cls, lagged: Float[np.ndarray, "rows columns"], outputs: int) -> _Products:
        variance = np.mean(np.square(lagged)) + 1e-300 if len(lagged) else 1.0
        return cls(lagged.T @ lagged / variance, len(lagged), outputs)

    def misfit(self, A: Float[np.ndarray, "lags outputs"]) -> float:
        """Twice the negative log-likelihood of coefficients, up to a constant."""
        errors = np.concatenate([np.eye(self.outputs), -A])
        sums = self.sums[: len(errors), : len(errors)]
        return self.rows * float(np.linalg.slogdet(errors.T @ sums @ errors / self.rows)[1])


class _Autoregression(NamedTuple):
    """Coefficients by lag and output, for each output, and their Bayesian information criterion."""

    coefficients: Float[np.ndarray, "lags outputs"]
    criterion: float


def _autoregression(runs: Sequence[_Products], groupings: Sequence[Sequence[int]]) -> _Autoregression:
    """The autoregression that some runs share, with the lags of the lowest criterion.

    **Arguments**: `groupings`, of lags, as of `LAGS`.
    """
    outputs, rows = runs[0].outputs, sum(run.rows for run in runs)
    sums = np.sum([run.sums for run in runs], axis=0)
    past = sums[outputs:, :outputs]
    none = np.zeros((0, outputs))
    tried = [_Autoregression(none, _criterion(runs, none, 0))]
    for lags in groupings:
        if rows < least_rows(lags, outputs):
            continue
        groups = np.kron(_groups(lags), np.eye(outputs))
        products = groups.T @ sums[outputs : outputs + len(groups), outputs : outputs + len(groups)] @ groups
        ridge = 1e-9 * np.trace(products) * np.eye(len(products)) / len(products)
        A = groups @ np.linalg.solve(products + ridge, groups.T @ past[: len(groups)])
        tried.append(_Autoregression(A, _criterion(runs, A, len(lags))))
    return min(tried, key=attrgetter("criterion"))


def _criterion(runs: Sequence[_Products], A: Float[np.ndarray, "lags outputs"], groups: int) -> float:
    """The Bayesian information criterion of coefficients that are alike in groups of lags."""
    rows = sum(run.rows for run in runs)
    return sum(run.misfit(A) for run in runs if run.rows) + groups * A.shape[1] ** 2 * float(np.log(rows))


def _groups(lags: Sequence[int]) -> Float[np.ndarray, "lags groups"]:
    """Which lags are in which group: each from the end of the one before to its own."""
    group = np.searchsorted(lags, np.arange(lags[-1]) + 1)
    return np.eye(len(lags))[group]
