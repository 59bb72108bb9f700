"""Noise in the record of what drives the motor: where the motor did not feel it, it is taken out.

A simulation takes the recorded voltage for true. The noise of its sensor then moves the simulated motor and not the
real one: the misfit looks like a missing effect, and the parameters make up for it (errors in variables). Whether a
motor felt the rough part of a voltage, as that of a controller which answers to a noisy speed, it says itself: its
response to that part is in its records or it is not.
"""

from __future__ import annotations

from dataclasses import replace

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...differences import noise_by_differences
from ...simulate import Tape, uniform
from ..generalised_least_squares import series_of
from ..likelihood import negative_log_likelihood
from ..noise_model import whitener
from ..polish import Fit, polish
from ..prepare import Prepared
from ..problem import Problem

# Noise of a smaller share of the largest value is rounding
ROUNDING = 1e-7
# Half widths of the windows that are smoothed over, samples
WIDTHS = (1, 2, 3, 5, 8, 12, 18, 27, 40)
# Windows behind, around and ahead of a sample, each with the order of the polynomial that is fitted in it
WINDOWS = ((-1, 0), (0, 0), (1, 0), (-1, 1), (0, 2), (1, 1))
# A wider window is no longer smooth if it departs from a narrower one by more standard errors than so many of each.
# Of motors' voltages a larger number leaves less noise, but rounds their bends, which looks like a missing effect.
DEPARTURE = 1.25
# Rough parts of which the motor felt less than this share, so many standard errors below all, are noise
FELT, CLEAR = 0.5, 5.0
# ... unless without them a run is missed by so many times more, in squares: a filter then took for noise what they did
MISSED = 1.1


def without_input_noise(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with what drives them smoothed where the motor did not feel its rough part, and the fit to them.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if nothing was found, or makes
    the runs less likely: where most of a misfit is another one's, its regression on a rough part may mislead.
    """
    drives = [np.asarray(getattr(run.recorded, run.drive)) for run in given.runs]
    rough = [drive - smoothed(drive) for drive in drives]
    if not any(map(np.any, rough)):
        return given, fit
    smooth = _driven(given, [d - r for d, r in zip(drives, rough, strict=True)])
    felt = _felt(given, fit, polish(smooth, fit.optimum, steps=0))
    if not any(share < 1 for share in felt):
        return given, fit
    lost = [(1 - share) * r for share, r in zip(felt, rough, strict=True)]
    problem = _driven(given, [d - x for d, x in zip(drives, lost, strict=True)])
    better = polish(problem, fit.optimum)
    if negative_log_likelihood(given, better) > negative_log_likelihood(given, fit):
        return given, fit
    taken = {
        run.name: float(np.std(x)) for run, x in zip(given.runs, lost, strict=True) if np.any(x)
    }
    return given._replace(problem=problem, input_noise=taken), better


def _driven(given: Prepared, drives: list[np.ndarray]) -> Problem:
    """The problem with the runs driven so."""
    runs = [
        uniform(attrs.evolve(run.recorded, **{run.drive: drive}))
        for run, drive in zip(given.runs, drives, strict=True)
    ]
    tape = given.problem.tape
    driven = Tape.from_recordings(runs, straight=given.straight)
    value, rise = jax.tree.map(jnp.asarray, (driven.value, driven.rise))
    return replace(given.problem, tape=replace(tape, value=value, rise=rise))


def _felt(given: Prepared, rough: Fit, smooth: Fit) -> list[float]:
    """Of every run the share of the rough part that the motor felt, one unless it is clearly less than half.

    By regression of what the whole drive leaves on the response to its rough part, both made white by what the smooth
    drive leaves.
    """
    shares, tape = [], given.problem.tape
    left, left_smooth = (
        -np.asarray(fit.evaluation.residuals) * fit.noise[:, None] for fit in (rough, smooth)
    )
    for run in range(len(given.runs)):
        both = series_of(tape, run, np.stack([left, left_smooth - left], -1))
        white = whitener([series_of(tape, run, left_smooth)])(0, both)
        rest, response = white[:, 0], white[:, 1]
        power = response @ response
        share = 1 + rest @ response / power if power > 0 else 1.0
        error = np.std(rest) / np.sqrt(power) if power > 0 else 1.0
        mine = tape.blocks_of(run)
        squares, smoothly = (
            np.square(residual[mine] / rough.noise[:, None]).sum()
            for residual in (left, left_smooth)
        )
        clear = share < FELT and share + CLEAR * error < 1 and smoothly < MISSED * squares
        shares.append(float(np.clip(share, 0.0, 1.0)) if clear else 1.0)
    return shares


def smoothed(signal: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """A signal less its white noise, with its steps and bends as they are.

    Every sample is estimated by the widest window on either side of it, and around it, in which the signal is as
    smooth as its noise allows: the estimates by all narrower windows have a value within their errors in common.
    These are weighed by their variances.

    **Source**: Goldenshluger & Nemirovski, Mathematical Methods of Statistics 6 (1997) 135 (intersection of
    confidence intervals); Katkovnik, IEEE Transactions on Signal Processing 47 (1999) 2567.
    """
    noise = noise_by_differences(4, signal)  # most of a signal is smooth
    if not noise > ROUNDING * np.max(np.abs(signal)):
        return signal
    estimates, errors = zip(*(_widest(signal, noise, *window) for window in WINDOWS), strict=True)
    return np.average(estimates, axis=0, weights=1 / np.square(errors))


def _widest(
    signal: np.ndarray, noise: float, side: int, order: int
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    """The estimate of every sample by the widest window on a side of it that is smooth, and its standard error."""
    best, error = signal.copy(), np.full(len(signal), noise)
    low, high = signal - DEPARTURE * noise, signal + DEPARTURE * noise
    smooth = np.ones(len(signal), bool)
    for width in WIDTHS:
        samples = width + 1 if side else 2 * width + 1
        if not order < samples - 1 < len(signal):
            continue
        before = {-1: width, 0: width, 1: 0}[side]
        weights = np.linalg.pinv(np.vander(np.arange(samples) - before, order + 1))[-1]
        spread = noise * np.sqrt(weights @ weights)
        inner = slice(before, len(signal) - samples + 1 + before)
        estimate = np.full(len(signal), np.nan)
        estimate[inner] = np.correlate(signal, weights, "valid")
        low = np.fmax(low, estimate - DEPARTURE * spread)
        high = np.fmin(high, estimate + DEPARTURE * spread)
        smooth &= ~np.isnan(estimate) & (low <= high)
        best, error = np.where(smooth, estimate, best), np.where(smooth, spread, error)
    return best, error
