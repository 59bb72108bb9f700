"""The colour of the noise: an autoregressive model of the residuals, and the filter that whitens them.

The residuals of a free run are coloured even if the sensor noise is white, since the motor filters the fluctuations
of its torque. Tests for white noise would mistake that for an effect. Residuals, and the columns that they are
regressed on, are therefore passed through the whitening filter, and each run is weighted by its own innovations.

**Source**: Ljung, "System Identification", 2nd edition, section 7.4 (prediction errors); Lütkepohl, "New
Introduction to Multiple Time Series Analysis" (2005), sections 3.2 and 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from attrs import frozen
from jaxtyping import Bool, Float

from .whitening import band_matrix, with_history

# Filters that are tried, by the last lags, none above `CHUNK`, of groups of lags with the same coefficients: each lag
# alone, up to several orders, or few groups for slow noise far below that of a sensor. The Bayesian information
# criterion chooses.
FILTERS = (*(range(1, order + 1) for order in (1, 2, 4, 8, 12, 20, 30)), (30,), (1, 30), (1, 4, 12, 30))
# Rows at least for each coefficient of an output
MIN_ROWS_PER_COEFFICIENT = 20
# Noise of different runs is equal if its logarithm differs by less
MAX_LOG_NOISE_SPREAD = 0.2
# Number of frequencies of a run, from the lowest on, that count as slow
SLOW_FREQUENCIES = 15

Rows = Float[np.ndarray, "samples outputs *columns"]


class Series(NamedTuple):
    """Signals of one run in the order of time, for the outputs that it has measured."""

    values: Rows
    known: Bool[np.ndarray, " samples"]  # where all outputs were measured
    kind: tuple[float, tuple[int, ...]]  # sample time and outputs: runs of a kind may share a filter


@frozen(eq=False)  # compared by identity
class Whitener:
    """For each run a filter, which runs of a kind may share, and the matrix that scales its output to unit variance.

    It filters in NumPy; `Whitening` is what a fit compiles of it.
    """

    filters: list[Float[np.ndarray, "order outputs outputs"]]
    scales: list[Float[np.ndarray, "outputs outputs"]]

    @property
    def is_white(self) -> bool:
        """Whether the noise is white and equally large in all runs of the same outputs."""
        sizes: dict[tuple[int, ...], list[np.ndarray]] = {}
        for S in self.scales:
            sizes.setdefault(S.shape, []).append(np.sqrt(np.diag(np.linalg.inv(S @ S.T))))
        alike = all(np.ptp(np.log(of_kind), axis=0).max() < MAX_LOG_NOISE_SPREAD for of_kind in sizes.values())
        return alike and not any(len(A) for A in self.filters)

    def __call__(self, run: int, series: Series) -> Float[np.ndarray, "rows *columns"]:
        """The filtered rows of a run, white if the series is its noise; the outputs of a sample follow one another."""
        rest = _filtered(series, self.filters[run], self.scales[run])
        return rest.reshape(-1, *rest.shape[2:])


def fit_whitener(residuals: Sequence[Series]) -> Whitener:
    """Fit the filters to the residuals of all runs.

    **Arguments**: `residuals`, one `Series` per run, `values` (samples, outputs).
    """
    kinds = dict.fromkeys(series.kind for series in residuals)
    by_kind = {kind: iter(_filters([s for s in residuals if s.kind == kind])) for kind in kinds}
    filters = [next(by_kind[series.kind]) for series in residuals]
    scales = _scales(residuals, filters)
    slow = [_slow_power(_filtered(series, A, S)) for series, A, S in zip(residuals, filters, scales, strict=True)]
    return Whitener(filters, [S / np.sqrt(s) for S, s in zip(scales, slow, strict=True)])


def scaling_whitener(residuals: Sequence[Series]) -> Whitener:
    """A whitener without filters, only with the scale of each run."""
    filters = [np.zeros((0, *2 * s.values.shape[1:2])) for s in residuals]
    return Whitener(filters, _scales(residuals, filters))


def _slow_power(white: Rows) -> float:
    """Power of the whitened residuals at their lowest frequencies, over what white noise may have there; at least one.

    A short filter cannot remove errors that last, such as those of a coarse encoder while the motor hardly turns. A
    run with such noise is given less weight.
    """
    count = min(SLOW_FREQUENCIES, len(white) // 4)
    if not count:
        return 1.0
    power = np.abs(np.fft.rfft(white, axis=0)[1 : count + 1]) ** 2 / len(white)
    by_chance = 1 + 2 / np.sqrt(count)
    return max(float(power.mean(0).max()) / by_chance, 1.0)


def _scales(
    residuals: Sequence[Series], filters: Sequence[Float[np.ndarray, "_ _ _"]]
) -> list[Float[np.ndarray, "outputs outputs"]]:
    """The scale of each run, from all runs of its kind if it has too few rows itself."""
    rests = [_filtered(series, of_run) for series, of_run in zip(residuals, filters, strict=True)]
    scales = []
    for series, rest in zip(residuals, rests, strict=True):
        if len(rest) < MIN_ROWS_PER_COEFFICIENT:
            of_kind = (other for s, other in zip(residuals, rests, strict=True) if s.kind == series.kind)
            rest = np.concatenate(list(of_kind))
        covariance = rest.T @ rest / max(len(rest), 1)
        floor = 1e-12 * np.trace(covariance) + 1e-300
        values, vectors = np.linalg.eigh(covariance)
        scales.append((vectors / np.sqrt(np.maximum(values, floor))) @ vectors.T)
    return scales


def _filters(residuals: Sequence[Series]) -> list[Float[np.ndarray, "order outputs outputs"]]:
    """The filters of runs of a kind, coefficients A_k of r(t) = sum_k A_k r(t - k) + white noise: one filter for all
    runs, or one for each where their colours differ, as the Bayesian information criterion decides."""
    outputs = residuals[0].values.shape[1]
    # of a record with gaps, few samples follow on many without one
    lags = [lags for lags in FILTERS if _count_rows(residuals, lags[-1]) >= _least_rows(lags, outputs)]
    if not lags:
        return [np.zeros((0, outputs, outputs))] * len(residuals)
    longest = max(ends[-1] for ends in lags)
    lagged = [_lagged(series, longest) for series in residuals]
    rms = np.sqrt(np.mean(np.square(np.concatenate(lagged)), axis=0))[:outputs] + 1e-300
    runs = [_Products.of(x / np.tile(rms, longest + 1), outputs) for x in lagged]
    long = [k for k, run in enumerate(runs) if run.rows >= _least_rows(lags[0], outputs)]
    shared = _autoregression([runs[k] for k in long] or runs, lags)
    own = {k: _autoregression([runs[k]], lags) for k in long}
    differ = sum(of_run.criterion for of_run in own.values()) < shared.criterion
    chosen = [own.get(k, shared) if differ else shared for k in range(len(runs))]
    return [A.reshape(-1, outputs, outputs).transpose(0, 2, 1) * rms[:, None] / rms for A, _ in chosen]


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


def _autoregression(runs: Sequence[_Products], filters: Sequence[Sequence[int]]) -> _Autoregression:
    """The autoregression that some runs share, of the filter with the lowest criterion.

    **Arguments**: `filters`, as of `FILTERS`.
    """
    outputs, rows = runs[0].outputs, sum(run.rows for run in runs)
    sums = np.sum([run.sums for run in runs], axis=0)
    past = sums[outputs:, :outputs]
    none = np.zeros((0, outputs))
    tried = [_Autoregression(none, _criterion(runs, none, 0))]
    for lags in filters:
        if rows < _least_rows(lags, outputs):
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


def _least_rows(lags: Sequence[int], outputs: int) -> int:
    """Fewest rows from which a filter is fitted: with fewer it would follow the noise of this very record."""
    return MIN_ROWS_PER_COEFFICIENT * lags[-1] * outputs


def _count_rows(residuals: Sequence[Series], order: int) -> int:
    """How many samples of all runs were measured, together with the `order` samples before them."""
    return sum(int(with_history(s.known, order)[order:].sum()) for s in residuals if len(s.known) > order)


def _lagged(series: Series, order: int) -> Float[np.ndarray, "rows lags"]:
    values = series.values
    if len(values) <= order:
        return np.zeros((0, values.shape[1] * (order + 1)))
    whole = np.concatenate([values[order - k : len(values) - k] for k in range(order + 1)], axis=1)
    return whole[with_history(series.known, order)[order:]]


def _filtered(
    series: Series,
    filters: Float[np.ndarray, "order outputs outputs"],
    scale: Float[np.ndarray, "outputs outputs"] | None = None,
) -> Rows:
    values, order, outputs = series.values, len(filters), series.values.shape[1]
    if len(values) <= order:
        return values[:0]
    flat = np.ascontiguousarray(values).reshape(len(values) * outputs, -1)
    by_chunk = band_matrix(filters, np.eye(outputs) if scale is None else scale)
    rest = np.empty(((len(values) - order) * outputs, flat.shape[1]))
    for first in range(0, len(rest), len(by_chunk)):
        window = flat[first : first + by_chunk.shape[1]]
        part = rest[first : first + len(by_chunk)]
        np.matmul(by_chunk[: len(part), : len(window)], window, out=part)
    rest = rest.reshape(len(values) - order, *values.shape[1:])
    whole = with_history(series.known, order)[order:]
    return rest if whole.all() else rest[whole]
