"""Covariance of an estimate whose residuals are correlated, and the directions that the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import chdtri, stdtrit

from ...simulate import UNKNOWNS_PER_RUN
from ..fit.polish import Fit
from ..problem import Problem

Z_95 = NormalDist().inv_cdf(0.975)  # of a 95 % interval, in standard errors
# A direction with at least this standard error counts as unseen: of a logarithm, or of a linear coordinate, whose unit
# is about the largest value that is to be expected
MIN_UNSEEN_STDERR = 0.5
# Stretches into which a run is summed for its long-run variance. Measured on white and on three kinds of slow noise,
# 60 x 6 runs of 5,000 samples each: 2,000 and 500 miss slow noise (standard errors down to a fifth), 50 scatters.
STRETCHES = 100
# Parts of a run that are left out one at a time: longer than any correlation that a noise filter leaves
JACKKNIFE_PARTS = 10
# Largest share of the information on a direction that one part is taken to hold: without it little would be left
MAX_PART_SHARE = 0.9
# Probability that white noise alone makes the parts disagree so much that the intervals follow them
SIGNIFICANCE = 0.05
# Largest standard error along an unseen direction: of a logarithm, a factor of twenty
MAX_UNSEEN_STDERR = 3.0


class Information(NamedTuple):
    """What the runs tell about the coordinates."""

    covariance: Float[np.ndarray, "parameters parameters"]
    inflation: Float[np.ndarray, " parameters"]  # of the variance, over that for white residuals
    interval_factor: Float[np.ndarray, " parameters"]  # of a 95 % interval, in standard errors
    unseen_variance: Float[np.ndarray, " parameters"]  # part of the variance that comes from the unseen directions
    unseen: tuple[np.ndarray, ...]  # unit vectors in the coordinates

    @property
    def unseen_share(self) -> Float[np.ndarray, " parameters"]:
        """How much of each coordinate's unit vector lies within the unseen directions, 0 to 1."""
        return np.sqrt(sum((np.square(d) for d in self.unseen), np.zeros(len(self.unseen_variance))))


class Part(NamedTuple):
    """J'J and J'r of a part of a run."""

    hessian: Float[np.ndarray, "parameters parameters"]
    score: Float[np.ndarray, " parameters"]


def information_of(problem: Problem, polished: Fit) -> Information:
    """What the training runs tell about the coordinates that a fit does not hold at a bound; see `information`."""
    evaluation, fixed = polished.evaluation, polished.at_bound
    free = np.array([k not in fixed for k in range(len(problem.parameters.names))])
    runs = int(np.sum(problem.fitted_runs))
    return information(evaluation.residuals, evaluation.jacobian, problem.tape.run, free, runs)


def information(
    residuals: Float[Array | np.ndarray, "blocks 2 samples"],
    jacobian: Float[Array | np.ndarray, "blocks 2 samples columns"],
    run: Int[Array | np.ndarray, " blocks"],
    free: Bool[np.ndarray, " parameters"],
    runs: int,
) -> Information:
    """Covariance of the estimated coordinates that stays valid when the residuals are correlated.

    With H = sum J'J, the error of the estimate is H^-1 sum_k J_k' r_k. Each run's own unknowns are projected out; the
    variance of the sum is then the long-run variance of its terms, whatever their correlation in time. The result is
    at least the variance for white residuals, and at least the jackknife variance (parts of the runs left out one at a
    time) where that is clearly larger: a few moments may decide, such as those at which a rotor breaks loose, and the
    fit then follows the noise of those.

    **Arguments**: `residuals` (blocks, 2, samples) and `jacobian` (blocks, 2, samples, columns), over the noise;
    `run`, the run of each block; `free`, which coordinates were estimated; `runs`, the number of training runs, which
    come first.

    **Source**: White, Econometrica 48 (1980); Andrews, Monahan, Econometrica 60 (1992), doi:10.2307/2951574; jackknife:
    MacKinnon, Nielsen, Webb, Journal of Econometrics 232 (2023), doi:10.1016/j.jeconom.2022.04.001.
    """
    residuals, jacobian, run = (np.asarray(x) for x in (residuals, jacobian, run))
    count = jacobian.shape[-1] - UNKNOWNS_PER_RUN
    scores: list[np.ndarray] = []
    parts: list[Part] = []
    for index in range(runs):
        J = _without_own_unknowns(jacobian[run == index])
        # samples in order, both outputs of an instant together
        J, r = (np.moveaxis(x, 1, 2) for x in (J, residuals[run == index]))
        J = J.reshape(-1, 2, count)
        scores.append(np.einsum("sci,sc->si", J, r.reshape(-1, 2)))
        split = (np.array_split(x, JACKKNIFE_PARTS) for x in (J, scores[-1]))
        for J, score in zip(*split, strict=True):
            J = J.reshape(-1, count)
            parts.append(Part(J.T @ J, score.sum(0)))
    hessian = np.sum([part.hessian for part in parts], 0)
    unseen, root, unseen_covariance = _split_by_visibility(hessian, free)
    inverse = root @ root.T
    long_run = np.asarray(sum(long_run_variance(score @ inverse) for score in scores))
    white = np.diag(inverse)
    jackknife, interval_factor = _jackknife(parts, root)
    variance = np.maximum(np.maximum(np.diag(long_run), white), jackknife)
    stretch = np.sqrt(_ratio_or_one(variance, np.diag(long_run)))
    return Information(
        covariance=long_run * stretch[:, None] * stretch + unseen_covariance,
        inflation=_ratio_or_one(variance, white),
        interval_factor=interval_factor,
        unseen_variance=np.diag(unseen_covariance),
        unseen=unseen,
    )


def _without_own_unknowns(
    jacobian: Float[np.ndarray, "blocks 2 samples columns"],
) -> Float[np.ndarray, "blocks 2 samples parameters"]:
    """Derivatives by the coordinates in a run, with those by the run's own unknowns projected out."""
    count = jacobian.shape[-1] - UNKNOWNS_PER_RUN
    own = jacobian[..., count:].reshape(-1, UNKNOWNS_PER_RUN)
    shared = jacobian[..., :count].reshape(-1, count)
    projection = np.linalg.pinv(own.T @ own, hermitian=True) @ (own.T @ shared)
    return (shared - own @ projection).reshape(*jacobian.shape[:-1], count)


def _ratio_or_one(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(b > 0, a / np.where(b > 0, b, 1.0), 1.0)


def _jackknife(parts: Sequence[Part], root: Float[np.ndarray, "parameters seen"]) -> tuple[np.ndarray, np.ndarray]:
    """Jackknife variances, zero where white noise may explain their size; and the reach of a 95 % interval in standard
    errors, from Student's t where these variances count: longer where few parts decide."""
    moved, shares = [], []
    for part in parts:
        known, axes = np.linalg.eigh(root.T @ part.hessian @ root)
        known = np.clip(known, 0.0, MAX_PART_SHARE)
        along = root @ axes
        moved.append(along @ (along.T @ part.score / (1 - known)))
        shares.append(np.square(along) @ known)
    n, moved, shares = len(parts), np.square(moved), np.array(shares)
    variance, white = moved.sum(0) * (n - 1) / n, np.square(root).sum(1)
    deciding = _ratio_or_one(shares.sum(0) ** 2, np.square(shares).sum(0))
    clear = variance > white * chdtri(deciding, SIGNIFICANCE) / deciding
    freedom = np.maximum(_ratio_or_one(moved.sum(0) ** 2, np.square(moved).sum(0)), 2.0)
    return np.where(clear, variance, 0.0), np.where(clear, stdtrit(freedom, 0.975), Z_95)


def _split_by_visibility(
    hessian: Float[np.ndarray, "parameters parameters"], free: Bool[np.ndarray, " parameters"]
) -> tuple[
    tuple[Float[np.ndarray, " parameters"], ...],
    Float[np.ndarray, "parameters seen"],
    Float[np.ndarray, "parameters parameters"],
]:
    """The unseen directions; a root R of the inverse on the others, R R'; and the covariance due to the unseen ones."""
    index = np.flatnonzero(free)
    values, vectors = np.linalg.eigh(hessian[np.ix_(index, index)])
    visible = values > max(1 / MIN_UNSEEN_STDERR**2, 1e-13 * values.max(initial=0.0))
    full = np.zeros((len(hessian), len(index)))
    full[index] = vectors
    root = full[:, visible] / np.sqrt(values[visible])
    # even a small component along an unseen direction adds to the variance of a parameter
    variances = np.minimum(1 / np.maximum(values[~visible], 1e-300), MAX_UNSEEN_STDERR**2)
    covariance = (full[:, ~visible] * variances) @ full[:, ~visible].T
    return tuple(full[:, k] for k in np.flatnonzero(~visible)), root, covariance


def long_run_variance(terms: Float[np.ndarray, "samples n"]) -> Float[np.ndarray, "n n"]:
    """Covariance matrix of the sum of correlated terms with mean zero.

    Each column is prewhitened by a first-order autoregression; then a quadratic-spectral kernel with the automatic
    bandwidth of Andrews (1991) is applied. The terms are first summed over stretches: that keeps the variance of the
    whole sum, and the slow part that decides it stands out from the white noise that hides it from sample to sample.
    """
    stretch = max(1, len(terms) // STRETCHES)
    whole = len(terms) // stretch * stretch
    sums = terms[:whole].reshape(-1, stretch, terms.shape[1]).sum(1)
    ar1 = np.clip(_ar1_coefficients(sums), -0.97, 0.97)
    whitened = sums[1:] - ar1 * sums[:-1]
    rest = np.clip(_ar1_coefficients(whitened), -0.97, 0.97)
    slow = np.sum(4 * rest**2 / (1 - rest) ** 8) / np.sum((1 - rest) ** -4.0)
    bandwidth = 1.3221 * max(slow * len(whitened), 1e-12) ** 0.2
    lags = np.arange(1, min(len(whitened) - 1, int(8 * bandwidth) + 2))
    kernel = _quadratic_spectral(lags / bandwidth)
    length = 2 ** int(np.ceil(np.log2(len(whitened) + len(lags) + 1)))
    spectrum = np.fft.rfft(whitened, length, axis=0)
    variance = whitened.T @ whitened
    for i in range(variance.shape[0]):
        cross = np.fft.irfft(np.conj(spectrum[:, i : i + 1]) * spectrum, length, axis=0)
        one_sided = kernel @ cross[lags]
        variance[i] += one_sided
        variance[:, i] += one_sided
    recolouring = 1 / (1 - ar1)
    return variance * recolouring[:, None] * recolouring * (len(sums) / len(whitened))


def _ar1_coefficients(series: np.ndarray) -> np.ndarray:
    return np.sum(series[1:] * series[:-1], 0) / (np.sum(series[:-1] ** 2, 0) + 1e-300)


def _quadratic_spectral(x: np.ndarray) -> np.ndarray:
    z = 6 * np.pi * x / 5
    return 25 / (12 * np.pi**2 * x**2) * (np.sin(z) / z - np.cos(z))
