"""The colour of the noise: the filter that whitens the residuals of each run.

The residuals of a free run are coloured even if the sensor noise is white, since the motor filters the fluctuations
of its torque. Tests for white noise would mistake that for an effect. Residuals, and the columns that they are
regressed on, are therefore passed through the whitening filter, and each run is weighted by its own innovations.

**Source**: Ljung, "System Identification", 2nd edition, section 7.4 (prediction errors); Lütkepohl, "New
Introduction to Multiple Time Series Analysis" (2005), sections 3.2 and 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from attrs import evolve, frozen
from jaxtyping import Bool, Float

from .autoregression import LAGS, autoregressions, least_rows
from .whitening import band_matrix, root_of_slow, with_history

# Fewest rows of a run that show its scale
MIN_ROWS = 20
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
    """For each run a filter, which runs of a kind may share, and the matrix that scales its output to unit variance;
    and what slow noise may add, that no filter removes.

    It filters in NumPy; `Whitening` is what a fit compiles of it.
    """

    filters: list[Float[np.ndarray, "order outputs outputs"]]
    scales: list[Float[np.ndarray, "outputs outputs"]]
    # of each run, signals that its slow noise has with random coefficients of unit variance
    slow: list[Float[np.ndarray, "samples outputs waves"]] | None = None

    @property
    def is_white(self) -> bool:
        """Whether the noise is white and equally large in all runs of the same outputs."""
        sizes: dict[tuple[int, ...], list[np.ndarray]] = {}
        for S in self.scales:
            sizes.setdefault(S.shape, []).append(np.sqrt(np.diag(np.linalg.inv(S @ S.T))))
        alike = all(np.ptp(np.log(of_kind), axis=0).max() < MAX_LOG_NOISE_SPREAD for of_kind in sizes.values())
        return alike and self.slow is None and not any(len(A) for A in self.filters)

    def __call__(self, run: int, series: Series) -> Float[np.ndarray, "rows *columns"]:
        """The rows of a run, white if the series is its noise; the outputs of a sample follow one another."""
        rows = self.filtered(run, series)
        if self.slow is None:
            return rows
        slow = self.filtered(run, series._replace(values=self.slow[run]))
        return rows - slow @ (root_of_slow(slow.T @ slow) @ (slow.T @ rows))

    def filtered(self, run: int, series: Series) -> Float[np.ndarray, "rows *columns"]:
        """The rows of a run, filtered and scaled, still with its slow noise."""
        rest = _filtered(series, self.filters[run], self.scales[run])
        return rest.reshape(-1, *rest.shape[2:])

    def weighted(self, residuals: Sequence[Series]) -> Whitener:
        """The same with the scale of each run such that its residuals have unit variance, and less weight where they
        vary slowly."""
        scales = []
        for run, (series, S) in enumerate(zip(residuals, self.scales, strict=True)):
            rows = self(run, series).reshape(-1, series.values.shape[1])
            size = float(np.mean(rows**2)) if len(rows) >= MIN_ROWS else 0.0
            scales.append(S / np.sqrt(size * _slow_power(rows / np.sqrt(size))) if size else S)
        return evolve(self, scales=scales)


def fit_whitener(residuals: Sequence[Series]) -> Whitener:
    """Fit the filters to the residuals of all runs, the scale of each to its own.

    **Arguments**: `residuals`, one `Series` per run, `values` (samples, outputs).
    """
    return fit_filters(residuals).weighted(residuals)


def fit_filters(residuals: Sequence[Series]) -> Whitener:
    """`fit_whitener` without less weight for what varies slowly."""
    kinds = dict.fromkeys(series.kind for series in residuals)
    by_kind = {kind: iter(_filters([s for s in residuals if s.kind == kind])) for kind in kinds}
    filters = [next(by_kind[series.kind]) for series in residuals]
    return Whitener(filters, _scales(residuals, filters))


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
        if len(rest) < MIN_ROWS:
            of_kind = (other for s, other in zip(residuals, rests, strict=True) if s.kind == series.kind)
            rest = np.concatenate(list(of_kind))
        covariance = rest.T @ rest / max(len(rest), 1)
        floor = 1e-12 * np.trace(covariance) + 1e-300
        values, vectors = np.linalg.eigh(covariance)
        scales.append((vectors / np.sqrt(np.maximum(values, floor))) @ vectors.T)
    return scales


def _filters(residuals: Sequence[Series]) -> list[Float[np.ndarray, "order outputs outputs"]]:
    """The filters of runs of a kind: coefficients A_k of r(t) = sum_k A_k r(t - k) + white noise."""
    outputs = residuals[0].values.shape[1]
    # of a record with gaps, few samples follow on many without one
    lags = [lags for lags in LAGS if _count_rows(residuals, lags[-1]) >= least_rows(lags, outputs)]
    if not lags:
        return [np.zeros((0, outputs, outputs))] * len(residuals)
    longest = max(ends[-1] for ends in lags)
    return autoregressions([_lagged(series, longest) for series in residuals], lags, outputs)


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
