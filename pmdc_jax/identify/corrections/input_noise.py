"""Measurement noise in the record of what drives the motor is removed where the motor did not feel it.

A simulation takes the recorded voltage as exact. The noise of its sensor then moves the simulated motor but not the
real one: the residuals look like a missing effect, and the parameters are biased (errors in variables). The rough part
of a voltage can also be real, as from a controller that responds to a noisy speed. The outputs tell: they contain the
response to the rough part, or they do not.
"""

from __future__ import annotations

import attrs
import numpy as np
from jaxtyping import Float

from ...recordings.noise import noise_by_differences
from ...simulate import on_even_clock
from ..fit.fitted_runs import FittedRuns
from ..fit.generalised_least_squares import series_of
from ..fit.likelihood import negative_log_likelihood
from ..fit.polish import Fit, fit_at
from ..noise.noise_model import fit_whitener
from ..prepare import Prepared

# Noise below this share of the largest value is rounding
ROUNDING_NOISE = 1e-7
# Half widths of the smoothing windows, samples
HALF_WIDTHS = (1, 2, 3, 5, 8, 12, 18, 27, 40)
# Windows behind (-1), around (0) and ahead of (1) a sample, each with the order of the polynomial fitted in it
WINDOWS = ((-1, 0), (0, 0), (1, 0), (-1, 1), (0, 2), (1, 1))
# Half width, in standard errors, of the confidence intervals of the estimates by wider and wider windows, which must
# intersect. For voltages of motors a larger value leaves less noise, but rounds corners: like a missing effect.
CONFIDENCE_HALF_WIDTH = 1.25
# Largest share of a rough part that the motor felt if it is noise
MAX_FELT_SHARE = 0.5
# Least standard errors by which the motor felt less than all of a rough part that is noise
MIN_Z_SCORE = 5.0
# Largest ratio of the squared residuals of a run without a rough part that is noise to those with it: above it, the
# whitening filter has mistaken what the part does for noise
MAX_SQUARES_RATIO = 1.1


def without_input_noise(recorded: FittedRuns) -> FittedRuns:
    """The runs with their drives smoothed where the motor did not feel the rough part, and the fit to them.

    **Returns**: both unchanged if nothing was found, or if smoothing makes the runs less likely: where most of the
    residuals have another cause, their regression may mislead.
    """
    prepared, fit = recorded
    drives = [np.asarray(getattr(run.recorded, run.drive)) for run in prepared.runs]
    rough = [drive - denoised(drive) for drive in drives]
    if not any(map(np.any, rough)):
        return recorded
    smooth = _with_drives(prepared, [d - r for d, r in zip(drives, rough, strict=True)])
    felt = _felt_shares(prepared, fit, fit_at(smooth.problem, fit.optimum))
    if not any(share < 1 for share in felt):
        return recorded
    lost = [(1 - share) * r for share, r in zip(felt, rough, strict=True)]
    removed = {run.name: float(np.std(x)) for run, x in zip(prepared.runs, lost, strict=True) if np.any(x)}
    cleaned = _with_drives(prepared, [d - x for d, x in zip(drives, lost, strict=True)])
    better = FittedRuns.polished(cleaned._replace(input_noise=removed), fit.optimum)
    return recorded if negative_log_likelihood(better) > negative_log_likelihood(recorded) else better


def _with_drives(prepared: Prepared, drives: list[np.ndarray]) -> Prepared:
    """The runs with these drives on their tape."""
    runs = [
        on_even_clock(attrs.evolve(run.recorded, **{run.drive: drive}))
        for run, drive in zip(prepared.runs, drives, strict=True)
    ]
    return prepared.with_tape_of(runs, "value", "rise", timing=prepared.timing)


def _felt_shares(prepared: Prepared, rough: Fit, smooth: Fit) -> list[float]:
    """The share of the rough part that the motor felt, for each run; 1 unless it is clearly less than half.

    By regression of the residuals with the whole drive on the response to its rough part, both filtered by the whitener
    of the residuals with the smooth drive.
    """
    shares, tape = [], prepared.problem.tape
    whole, smoothed = (-np.asarray(fit.evaluation.residuals) * fit.noise[:, None] for fit in (rough, smooth))
    for run in range(len(prepared.runs)):
        both = series_of(tape, run, np.stack([whole, smoothed - whole], -1))
        white = fit_whitener([series_of(tape, run, smoothed)])(0, both)
        rest, response = white[:, 0], white[:, 1]
        power = response @ response
        share = 1 + rest @ response / power if power > 0 else 1.0
        error = np.std(rest) / np.sqrt(power) if power > 0 else 1.0
        mine = tape.blocks_of(run)
        squares, squares_smooth = (
            np.square(residual[mine] / rough.noise[:, None]).sum() for residual in (whole, smoothed)
        )
        is_noise = (
            share < MAX_FELT_SHARE and share + MIN_Z_SCORE * error < 1 and squares_smooth < MAX_SQUARES_RATIO * squares
        )
        shares.append(float(np.clip(share, 0.0, 1.0)) if is_noise else 1.0)
    return shares


def denoised(signal: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """A signal without its white noise, but with its steps and corners preserved.

    Each sample is estimated from the widest window behind, around and ahead of it in which the signal is smooth: the
    confidence intervals of the estimates from this and all narrower windows intersect. The estimates are averaged with
    the inverse of their variances as weights.

    **Source**: Goldenshluger & Nemirovski, Mathematical Methods of Statistics 6 (1997) 135 (intersection of
    confidence intervals); Katkovnik, IEEE Transactions on Signal Processing 47 (1999) 2567.
    """
    noise = noise_by_differences(4, signal)  # by a median, since most of a signal is smooth
    if not noise > ROUNDING_NOISE * np.max(np.abs(signal)):
        return signal
    estimates, errors = zip(*(_estimate_by_widest(signal, noise, *window) for window in WINDOWS), strict=True)
    return np.average(estimates, axis=0, weights=1 / np.square(errors))


def _estimate_by_widest(
    signal: np.ndarray, noise: float, side: int, order: int
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    """The estimate of each sample from the widest smooth window on one side of it, and its standard error."""
    best, error = signal.copy(), np.full(len(signal), noise)
    low, high = signal - CONFIDENCE_HALF_WIDTH * noise, signal + CONFIDENCE_HALF_WIDTH * noise
    smooth = np.ones(len(signal), bool)
    for width in HALF_WIDTHS:
        samples = width + 1 if side else 2 * width + 1
        if not order < samples - 1 < len(signal):
            continue
        before = {-1: width, 0: width, 1: 0}[side]
        weights = np.linalg.pinv(np.vander(np.arange(samples) - before, order + 1))[-1]
        spread = noise * np.sqrt(weights @ weights)
        inner = slice(before, len(signal) - samples + 1 + before)
        estimate = np.full(len(signal), np.nan)
        estimate[inner] = np.correlate(signal, weights, "valid")
        low = np.fmax(low, estimate - CONFIDENCE_HALF_WIDTH * spread)
        high = np.fmin(high, estimate + CONFIDENCE_HALF_WIDTH * spread)
        smooth &= ~np.isnan(estimate) & (low <= high)
        best, error = np.where(smooth, estimate, best), np.where(smooth, spread, error)
    return best, error
