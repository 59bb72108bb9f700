"""Restricted maximum likelihood of noise that is a sum of known signals with random amplitudes, from inner products.

What the fitted coordinates and each run's own unknowns can explain says nothing about the noise, and is projected out:
the slow part of a fit's residuals is mostly absorbed by the fit.

**Source**: Patterson, Thompson, Biometrika 58 (1971), doi:10.1093/biomet/58.3.545; Harville, Journal of the American
Statistical Association 72 (1977), doi:10.1080/01621459.1977.10480998.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Variances that are tried, such that the amplitude that shows most has these over the noise of the sensors
VARIANCES = np.geomspace(1e-2, 1e8, 31)
# Least gain of twice the log-likelihood by which there is such noise
MIN_GAIN = 7.0
# Precision of a coordinate before anything is measured, and its least share of that of all: runs may not tell all
PRIOR_PRECISION, MIN_PRECISION = 1e-4, 1e-12


class NoiseFit(NamedTuple):
    """Variances of the amplitudes, and the fit by generalised least squares beside them."""

    variances: Float[np.ndarray, "runs amplitudes"]  # over `variance`
    deviance: float  # twice the negative restricted log-likelihood, up to a constant
    variance: float  # of the rows, beside such noise
    changes: Float[np.ndarray, " coordinates"]
    amplitudes: Float[np.ndarray, "runs amplitudes"]  # the likeliest

    @property
    def deviations(self) -> Float[np.ndarray, "runs amplitudes"]:
        """Standard deviations of the amplitudes."""
        return np.sqrt(self.variance * self.variances)


class NoiseProducts(NamedTuple):
    """Inner products of the filtered rows of every run, with its own unknowns projected out."""

    signals: Float[np.ndarray, "runs amplitudes amplitudes"]
    cross: Float[np.ndarray, "runs amplitudes columns"]  # with the derivatives by the coordinates, and the residual
    rest: Float[np.ndarray, "columns columns"]  # of these, of all runs
    rows: int

    @classmethod
    def of(cls, runs: Iterable[Float[np.ndarray, "_ columns"]], own: int, amplitudes: int) -> NoiseProducts:
        """From the rows of every run, with columns for its `own` unknowns, the signals with random `amplitudes`, the
        derivatives by the coordinates, and the residual."""
        of_runs, count = [], 0
        for rows in runs:
            unknowns, others = rows[:, :own], rows[:, own:]
            others = others - unknowns @ np.linalg.lstsq(unknowns, others)[0]
            of_runs.append(others.T @ others)
            count += len(rows)
        products, first, last = np.array(of_runs), slice(amplitudes), slice(amplitudes, None)
        return cls(products[:, first, first], products[:, first, last], products[:, last, last].sum(0), count)

    def fit(self, variances: Float[np.ndarray, "runs amplitudes"]) -> NoiseFit:
        """The fit with these variances of the amplitudes, over that of the rows."""
        deviations = np.sqrt(variances)
        covariance = np.eye(variances.shape[1]) + self.signals * deviations[:, :, None] * deviations[:, None, :]
        cross = self.cross * deviations[..., None]
        explained = np.linalg.solve(covariance, cross)
        left = self.rest - np.einsum("rai,raj->ij", cross, explained)
        normal = left[:-1, :-1]
        normal = normal + (PRIOR_PRECISION + MIN_PRECISION * np.trace(normal)) * np.eye(len(normal))
        changes = np.linalg.solve(normal, left[:-1, -1])
        variance = max(float(left[-1, -1] - left[-1, :-1] @ changes), 1e-300) / max(self.rows, 1)
        log_volume = np.linalg.slogdet(covariance)[1].sum() + np.linalg.slogdet(normal)[1]
        amplitudes = deviations * (explained[..., -1] - explained[..., :-1] @ changes)
        return NoiseFit(variances, float(log_volume + self.rows * np.log(variance)), variance, changes, amplitudes)

    def most_likely(self, shapes: Iterable[Float[np.ndarray, "runs amplitudes"]]) -> NoiseFit:
        """The likeliest variances of one of some shapes, whose size may be any.

        Of each run by itself they would be too uncertain: one with little noise by chance would decide.
        """
        none = self.fit(np.zeros(self.signals.shape[:2]))
        tried = (self.fit(variances) for shape in shapes for variances in self._sizes(shape))
        best = min(tried, key=attrgetter("deviance"), default=none)
        return best if best.deviance < none.deviance - MIN_GAIN else none

    def _sizes(self, shape: Float[np.ndarray, "runs amplitudes"]) -> Iterator[Float[np.ndarray, "runs amplitudes"]]:
        """Variances of a shape and all sizes (`VARIANCES`)."""
        most = float(np.max(shape * np.diagonal(self.signals, axis1=1, axis2=2)))
        return (size / most * shape for size in VARIANCES if most)
