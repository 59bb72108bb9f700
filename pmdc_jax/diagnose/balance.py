"""Whether a model satisfies the electrical equation to within the noise of the sensors, whatever torque acts.

A fluctuating torque makes the residuals of a free run large and slow, and a whitening filter then takes for noise what
a model lacks, too. But no torque enters the electrical equation: from sample to sample the residual of the current
follows from that of the speed, up to the white noise of the sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..identify.generalised_least_squares import residuals_of, series_of
from ..identify.noise import noise_of_sensor, white_noise
from ..identify.noise_model import Series
from ..motor import Drive, Motor
from ..recording import OVER_LAST
from .model import Model

# A run with fewer usable samples is left out
ENOUGH = 50
# A current flows if it exceeds so many standard deviations of its sensor's noise
CLEAR = 4.0
# Lags, in steps of one sample, at which residuals of the equation are correlated, and standard errors that chance may
# bring. A sensor's error enters two successive steps, with opposite signs, and the ripple of a bridge's pulses, where a
# step does not end with one of them, only one. What steps farther apart have in common is what the equation lacks, and
# so is what makes successive ones alike, unless samples of an uneven clock were moved.
APART, CHANCE = range(2, 9), 3.0


class _Balance(NamedTuple):
    """One run's residuals of the electrical equation from sample to sample, over the white noise of the sensors."""

    rest: Float[np.ndarray, " samples"]  # of the current at the end of each step
    # derivatives by R, Kb, a voltage drop that opposes the current, and L, each up to a factor
    by_parameters: Float[np.ndarray, "samples 4"]
    even: bool  # sampled by an even clock


def electrical_misfit(model: Model) -> float:
    """Residual of the electrical equation over the white noise of the sensors, as root mean square, of the worst run.

    With residuals i and w of current and speed, R i + L di/dt + Kb w = 0 between two samples, with w on a straight
    line. R, L, Kb and the brush voltage drop are fitted to these residuals by least squares over all runs, because
    fluctuating torques bias the fit of a free run. Only what steps some samples `APART` have in common is added to the
    noise: a rough voltage, whose errors differ from step to step, is no missing effect.

    **Returns**: at least 1; 1 if no run has voltage, current and speed, or if the model is exact.
    """
    if model.is_exact:
        return 1.0
    residuals = residuals_of(model.given, model.fit)
    balances = [
        balance
        for run, residual in zip(model.training, residuals, strict=True)
        if (balance := _balance(model, run, residual)) is not None
    ]
    if not balances:
        return 1.0
    columns = np.concatenate([b.by_parameters for b in balances])
    better = np.linalg.lstsq(columns, np.concatenate([b.rest for b in balances]), rcond=None)[0]
    lasting = [_lasting(b.rest - b.by_parameters @ better, b.even) for b in balances]
    return float(np.sqrt(1 + max(lasting)))


def _lasting(rest: Float[np.ndarray, " samples"], even: bool) -> float:
    """The largest mean product, in magnitude, of two values some samples `APART`, or the positive one of neighbours,
    less what chance makes it."""
    lags = [*APART, 1] if even else APART
    products = [rest[lag:] * rest[:-lag] for lag in lags]
    means = [p.mean() if lag == 1 else abs(p.mean()) for lag, p in zip(lags, products, strict=True)]
    chance = [CHANCE * p.std() / np.sqrt(len(p)) for p in products]
    return float(max(0.0, *np.subtract(means, chance)))


def _balance(model: Model, run: int, residual: Series) -> _Balance | None:
    """The residuals of the electrical equation in a run; None if they are too few or a signal was not recorded."""
    given, tape = model.given, model.given.problem.tape
    drive, known, left = tape.drive_of(run), residual.known, residual.values
    if residual.kind[1] != (0, 1) or not drive.voltage or known.sum() < ENOUGH:
        return None
    measured = series_of(tape, run, np.asarray(tape.measured)).values
    simulated = measured - left
    current, speed = (_noise(measured[known, c], left[known, c]) for c in range(2))
    brushes = any(effect.holds == "current" for effect in model.motor.effects)
    if brushes:
        known = known & _flows(measured[:, 0], simulated[:, 0], CLEAR * current)
    pairs = known[1:] & known[:-1]
    if pairs.sum() < ENOUGH:
        return None
    kept, before, after, volt = _step(model.motor, drive, tape.sample_time_of(run))
    if given.runs[run].averaging == OVER_LAST:  # the reported speed is the mean over just this step
        before, after = 0.0, before + after
    i, w = left.T
    rest = i[1:] - kept * i[:-1] - before * w[:-1] - after * w[1:]
    mean, change = (simulated[1:] + simulated[:-1]) / 2, np.diff(simulated[:, :1], axis=0)
    unfelt = given.input_noise.get(given.runs[run].name, 0.0)
    explained = current**2 * (1 + kept**2) + speed**2 * (before**2 + after**2)
    noise = np.sqrt(explained + (volt * unfelt) ** 2)
    drop = volt * brushes * np.sign(mean[:, :1])
    by_parameters = np.concatenate([volt * mean, drop, change], axis=1)
    even = given.runs[run].resampled_from is None
    return _Balance(rest[pairs] / noise, by_parameters[pairs] / noise, even)


def _step(motor: Motor, drive: Drive, seconds: float) -> tuple[float, float, float, float]:
    """Derivatives of the current after a step by the current before it (A/A), the speed before and after it (A per
    rad/s), and a voltage held during it (A/V)."""
    A, B = map(np.asarray, motor.state_space(drive))
    decay = A[0, 0] * seconds
    mean = np.expm1(decay) / decay
    later = (mean - 1) / decay
    by_speed, by_volt = A[0, 1] * seconds, B[0, 0] * seconds
    return np.exp(decay), by_speed * (mean - later), by_speed * later, by_volt * mean


def _flows(
    measured: Float[np.ndarray, " samples"], simulated: Float[np.ndarray, " samples"], clear: float
) -> Bool[np.ndarray, " samples"]:
    """Where measured and simulated current both clearly flow, in one direction.

    Elsewhere brushes may hold the current at zero and take up any voltage.
    """
    return (np.abs(simulated) > clear) & (measured * np.sign(simulated) > clear)


def _noise(measured: Float[np.ndarray, " samples"], left: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a sensor's white noise: the smaller of two estimates, from the measured signal and from its
    residuals, which show it better the rougher the motion is; the latter at least what the sensor's steps make."""
    return min(white_noise([measured]) or np.inf, noise_of_sensor(measured, left))
