"""Whether a model satisfies the electrical equation to within the noise of the sensors, whatever torque acts.

A fluctuating torque makes the residuals of a free run large and slow, and a whitening filter then absorbs what a model
lacks as noise. But no torque enters the electrical equation: from sample to sample the residual of the current follows
from that of the speed, up to the white noise of the sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..identify.corrections.electrical_equation import MIN_FLOW
from ..identify.generalised_least_squares import residuals_of, series_of
from ..identify.noise import noise_of_sensor, white_noise
from ..identify.noise_model import Series
from ..motor import Drive, Motor
from ..recording import OVER_LAST
from ..simulate.exponential import scalar_phi
from .model import Model

# A run with fewer usable samples is left out
MIN_SAMPLES = 50
# Lags, in samples, at which residuals of the equation are correlated only by what the equation lacks. A sensor's error
# enters two successive steps, with opposite signs, and the ripple of a bridge's pulses, where a step does not end with
# one of them, only one. A positive correlation of successive steps shows what the equation lacks, too, unless samples
# of an uneven clock were moved.
LAGS = range(2, 9)
# Standard errors of a correlation that chance may bring
CHANCE_ERRORS = 3.0


class _Balance(NamedTuple):
    """One run's residuals of the electrical equation from sample to sample, over the white noise of the sensors."""

    residuals: Float[np.ndarray, " samples"]  # of the current at the end of each step
    # derivatives by R, Kb, a voltage drop that opposes the current, and L, each up to a factor
    sensitivities: Float[np.ndarray, "samples 4"]
    even_clock: bool


class _StepGains(NamedTuple):
    """Derivatives of the current after a step."""

    current: float  # by the current before the step, A/A
    speed_before: float  # by the speed before the step, A per rad/s
    speed_after: float  # by the speed after the step, A per rad/s
    voltage: float  # by a voltage held during the step, A/V


def electrical_misfit(model: Model) -> float:
    """Residual of the electrical equation over the white noise of the sensors, as root mean square, of the worst run.

    With residuals i and w of current and speed, R i + L di/dt + Kb w = 0 between two samples, with w on a straight
    line. R, L, Kb and the brush voltage drop are fitted to these residuals by least squares over all runs, because
    fluctuating torques bias the fit of a free run. Only what steps some samples apart (`LAGS`) have in common is added
    to the noise: a rough voltage, whose errors differ from step to step, is no missing effect.

    **Returns**: at least 1; 1 if no run has voltage, current and speed, or if the model is exact.
    """
    if model.is_exact:
        return 1.0
    series = residuals_of(model.given, model.fit)
    balances = [
        balance
        for run, residual in zip(model.training, series, strict=True)
        if (balance := _balance(model, run, residual)) is not None
    ]
    if not balances:
        return 1.0
    sensitivities = np.concatenate([b.sensitivities for b in balances])
    residuals = np.concatenate([b.residuals for b in balances])
    corrections = np.linalg.lstsq(sensitivities, residuals, rcond=None)[0]
    covariances = [
        _covariance_beyond_chance(b.residuals - b.sensitivities @ corrections, b.even_clock)
        for b in balances
    ]
    return float(np.sqrt(1 + max(covariances)))


def _covariance_beyond_chance(residuals: Float[np.ndarray, " samples"], even_clock: bool) -> float:
    """The largest mean product, in magnitude, of two residuals at one of the `LAGS`, or the positive one of neighbours,
    less what may be chance."""
    lags = [*LAGS, 1] if even_clock else LAGS
    products = [residuals[lag:] * residuals[:-lag] for lag in lags]
    means = [p.mean() if lag == 1 else abs(p.mean()) for lag, p in zip(lags, products, strict=True)]
    chance = [CHANCE_ERRORS * p.std() / np.sqrt(len(p)) for p in products]
    return float(max(0.0, *np.subtract(means, chance)))


def _balance(model: Model, run: int, residual: Series) -> _Balance | None:
    """The residuals of the electrical equation in a run; None if they are too few, a signal was not recorded, or the
    current is a mean."""
    given, tape = model.given, model.given.problem.tape
    drive, known, residuals = tape.drive_of(run), residual.known, residual.values
    recorded = given.runs[run]
    both = residual.kind[1] == (0, 1) and not recorded.current_averaged
    if not both or not drive.voltage or known.sum() < MIN_SAMPLES:
        return None
    measured = series_of(tape, run, np.asarray(tape.measured)).values
    simulated = measured - residuals
    current_noise, speed_noise = (
        _sensor_noise(measured[known, c], residuals[known, c]) for c in range(2)
    )
    brushes = any(effect.holds == "current" for effect in model.motor.effects)
    if brushes:
        threshold = MIN_FLOW * current_noise
        known = known & _flows(measured[:, 0], simulated[:, 0], threshold)
    pairs = known[1:] & known[:-1]
    if pairs.sum() < MIN_SAMPLES:
        return None
    gains = _step_gains(model.motor, drive, tape.sample_time_of(run))
    if recorded.averaging == OVER_LAST:  # the reported speed is the mean over just this step
        both = gains.speed_before + gains.speed_after
        gains = gains._replace(speed_before=0.0, speed_after=both)
    by_current, by_before, by_after, by_voltage = gains
    i, w = residuals.T
    step_residuals = i[1:] - by_current * i[:-1] - by_before * w[:-1] - by_after * w[1:]
    mean, change = (simulated[1:] + simulated[:-1]) / 2, np.diff(simulated[:, :1], axis=0)
    sensors = current_noise**2 * (1 + by_current**2) + speed_noise**2 * (by_before**2 + by_after**2)
    voltage_noise = given.input_noise.get(given.runs[run].name, 0.0)
    noise = np.sqrt(sensors + (by_voltage * voltage_noise) ** 2)
    drop = by_voltage * brushes * np.sign(mean[:, :1])
    sensitivities = np.concatenate([by_voltage * mean, drop, change], axis=1)
    even_clock = given.runs[run].resampled_from is None
    return _Balance(step_residuals[pairs] / noise, sensitivities[pairs] / noise, even_clock)


def _step_gains(motor: Motor, drive: Drive, seconds: float) -> _StepGains:
    """The gains of a step of so many seconds, with a speed on a straight line."""
    A, B = map(np.asarray, motor.state_space(drive))
    decay = A[0, 0] * seconds
    mean, later = scalar_phi(decay, 1), scalar_phi(decay, 2)
    by_speed, by_voltage = A[0, 1] * seconds, B[0, 0] * seconds
    return _StepGains(np.exp(decay), by_speed * (mean - later), by_speed * later, by_voltage * mean)


def _flows(
    measured: Float[np.ndarray, " samples"],
    simulated: Float[np.ndarray, " samples"],
    threshold: float,
) -> Bool[np.ndarray, " samples"]:
    """Where measured and simulated current both clearly flow, in one direction.

    Elsewhere brushes may hold the current at zero and take up any voltage.
    """
    return (np.abs(simulated) > threshold) & (measured * np.sign(simulated) > threshold)


def _sensor_noise(
    measured: Float[np.ndarray, " samples"], residuals: Float[np.ndarray, " samples"]
) -> float:
    """Standard deviation of a sensor's white noise: the smaller of two estimates, from the measured signal and from its
    residuals, which show it better the rougher the motion is; the latter is at least that of the sensor's resolution.
    """
    return min(white_noise([measured]) or np.inf, noise_of_sensor(measured, residuals))
