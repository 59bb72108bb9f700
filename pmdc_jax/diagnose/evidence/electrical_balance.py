"""Whether a model satisfies the electrical equation to within the noise of the sensors, whatever torque acts.

A fluctuating torque makes the residuals of a free run large and slow, and a whitening filter then absorbs what a model
lacks as noise. But no torque enters the electrical equation: from sample to sample the residual of the current follows
from that of the speed, up to the white noise of the sensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from ...effects import BrushVoltageDrop, GradualBrushDrop
from ...identify.corrections.electrical_equation import MIN_FLOW
from ...identify.corrections.gradual_brushes import ONSETS
from ...identify.fit.generalised_least_squares import residuals_of, series_of
from ...identify.noise.noise_model import Series
from ...identify.noise.sensor_noise import noise_of_sensor, white_noise
from ...motor import Motor
from ...recordings.noise import NORMAL_MEDIAN
from ...recordings.recording import OVER_LAST
from ...simulate.exponential import scalar_phi
from ..model import Model

# A run with fewer usable samples is left out
MIN_SAMPLES = 50
# Lags, in samples, at which residuals of the equation are correlated only by what the equation lacks. A sensor's error
# enters two successive steps, with opposite signs, and the ripple of a bridge's pulses, where a step does not end with
# one of them, only one. A positive correlation of successive steps shows what the equation lacks, too, unless samples
# of an uneven clock were moved.
LAGS = range(2, 9)
# Standard errors of a correlation that chance may bring
CHANCE_ERRORS = 3.0
# Bounds of the natural logarithms of R, Kb and L over those of the model
MAX_LOGARITHM = 7.0
# Least first guess of L over R times the sample time: a smaller one is not felt, and no gradient leads back
MIN_GUESS = 0.1


class _Electrical(NamedTuple):
    """What the electrical equation depends on."""

    R: float
    Kb: float
    L: float
    # amplitudes, V, of voltages that oppose the current, beside those of the model (see `_Steps.opposing`)
    drop: Float[np.ndarray, " shapes"] = np.zeros(1 + len(ONSETS))

    def changed(self, by: Float[np.ndarray, " changes"]) -> _Electrical:
        """With R, Kb and L changed by these natural logarithms, and these amplitudes of the drop."""
        R, Kb, L = np.array(self[:3]) * np.exp(by[:3])
        return _Electrical(R, Kb, L, by[3:])


class _SampleIntervals(NamedTuple):
    """What acts in the steps of one run from sample to sample, at the start and at the end of each."""

    seconds: float
    current: Float[np.ndarray, " steps"]  # A, at the start
    speed: Float[np.ndarray, "steps 2"]  # rad/s
    voltage: Float[np.ndarray, "steps 2"]  # V
    # what brushes oppose the current with, per V of each of the `_shapes`; zero without brushes
    opposing: Float[np.ndarray, "steps 2 shapes"]

    def predicted(self, motor: _Electrical) -> Float[np.ndarray, " steps"]:
        """Current at the end of the steps by the electrical equation, with voltage and speed on straight lines."""
        decay, weights = _weights(motor, self.seconds)
        voltage = self.voltage - motor.Kb * self.speed - self.opposing @ motor.drop
        return decay * self.current + voltage @ weights


class _Balance(NamedTuple):
    """The electrical equation in the measured steps of one run."""

    measured: _SampleIntervals
    # current at the end less what the model has there beside its electrical equation, A
    reached: Float[np.ndarray, " steps"]
    noise: float  # of the sensors, in a residual, A
    even_clock: bool

    def residuals(self, motor: _Electrical) -> Float[np.ndarray, " steps"]:
        """The residuals of the electrical equation, over the noise of the sensors."""
        return (self.reached - self.measured.predicted(motor)) / self.noise


def _weights(motor: _Electrical, seconds: float) -> tuple[float, Float[np.ndarray, "2"]]:
    """What a step leaves of a current, and the current at its end per V at its start and at its end, in A/V, if the
    voltage changes linearly."""
    decay = -motor.R / motor.L * seconds
    mean, later = scalar_phi(decay, 1), scalar_phi(decay, 2)
    return float(np.exp(decay)), seconds / motor.L * np.array([mean - later, later])


def electrical_misfit(model: Model) -> float:
    """Residual of the electrical equation over the white noise of the sensors, as root mean square, of the worst run.

    L di/dt = v - R i - Kb w between two samples, with v and w on straight lines, and with what the simulation of the
    model has beside it, such as the drop of its brushes. R, Kb, L and a further drop of the brushes are fitted to the
    measured steps of all runs, because torques that the model lacks bias the fit of a free run. Only what steps some
    samples apart (`LAGS`) have in common is added to the noise: a rough voltage, whose errors differ from step to step,
    is no missing effect; nor is the colour of a sensor's noise, which is the same in all runs.

    **Returns**: at least 1; 1 if no run has voltage, current and speed, or if the model is exact.
    """
    if model.is_exact:
        return 1.0
    series = residuals_of(model.prepared, model.fit)
    size = float(model.problem.measured_rms[0])
    balances = [
        balance
        for run, residual in zip(model.prepared.training_indices, series, strict=True)
        if (balance := _balance(model, run, residual, size)) is not None
    ]
    if not balances:
        return 1.0
    start = _electrical_part(model.motor)
    guess = MIN_GUESS * start.R / start.L * min(b.measured.seconds for b in balances)
    largest = np.array([*3 * [MAX_LOGARITHM], *np.full_like(start.drop, np.inf)])
    best = least_squares(
        lambda by: np.concatenate([b.residuals(start.changed(by)) for b in balances]),
        [0.0, 0.0, np.clip(np.log(guess), 0.0, MAX_LOGARITHM / 2), *start.drop],
        bounds=(-largest, largest),
        x_scale="jac",
    )
    motor = start.changed(best.x)
    residuals = [b.residuals(motor) for b in balances]
    colour = _common_colour(balances, residuals)
    beyond = [_covariance_beyond_chance(r, b, colour) for b, r in zip(balances, residuals, strict=True)]
    return float(np.sqrt(1 + max(beyond)))


def _electrical_part(motor: Motor) -> _Electrical:
    return _Electrical(float(motor.R), float(motor.Kb), float(motor.L))


def _common_colour(balances: list[_Balance], residuals: list[Float[np.ndarray, " _"]]) -> dict[int, float]:
    """By lag, the covariance in A^2 that the residuals of all runs have in common at any time: the colour of the
    sensor's noise. What the equation lacks differs between runs, or shows at some times more than at others.

    **Returns**: zeros for a single run, and for runs of different clocks.
    """
    lags = [1, *LAGS]
    if len(balances) < 2 or len({b.measured.seconds for b in balances}) > 1:
        return dict.fromkeys(lags, 0.0)
    scaled = [r * b.noise for b, r in zip(balances, residuals, strict=True)]
    return {lag: max(min(_typical_covariance(r, lag) for r in scaled), 0.0) for lag in lags}


def _typical_covariance(residuals: Float[np.ndarray, " samples"], lag: int) -> float:
    """The covariance at a lag, of normal residuals, that rare large ones leave as it is: from the signs of pairs and
    the median size (quadrant correlation)."""
    agreement = np.mean(np.sign(residuals[lag:]) * np.sign(residuals[:-lag]))
    return float(np.sin(np.pi / 2 * agreement) * (np.median(np.abs(residuals)) / NORMAL_MEDIAN) ** 2)


def _covariance_beyond_chance(
    residuals: Float[np.ndarray, " samples"], balance: _Balance, colour: Mapping[int, float]
) -> float:
    """The largest mean product, in magnitude, of two residuals at one of the `LAGS`, or the positive one of neighbours,
    less what may be chance or the `colour` of the noise, in A^2."""
    lags = [*LAGS, 1] if balance.even_clock else LAGS
    products = [residuals[lag:] * residuals[:-lag] for lag in lags]
    excess = [p.mean() - colour[lag] / balance.noise**2 for lag, p in zip(lags, products, strict=True)]
    sizes = [x if lag == 1 else abs(x) for lag, x in zip(lags, excess, strict=True)]
    chance = [CHANCE_ERRORS * p.std() / np.sqrt(len(p)) for p in products]
    return float(max(0.0, *np.subtract(sizes, chance)))


def _balance(model: Model, run: int, residual: Series, size: float) -> _Balance | None:
    """The measured steps of a run; None if they are too few, a signal was not recorded, or the current is a mean.

    **Arguments**: `size`, the root mean square of the current in all runs, A.
    """
    prepared, tape = model.prepared, model.problem.tape
    drive, known, residuals = tape.drive_of(run), residual.known, residual.values
    recorded = prepared.runs[run]
    seconds, outputs = residual.kind
    # a sensor slower than the log has no reading at the next sample
    both = outputs == (0, 1) and seconds == tape.sample_time_of(run) and not recorded.current_averaged
    if not both or not drive.voltage or known.sum() < MIN_SAMPLES:
        return None
    measured = series_of(tape, run, np.asarray(tape.measured)).values
    simulated = measured - residuals
    current_noise, speed_noise = (_sensor_noise(measured[known, c], residuals[known, c]) for c in range(2))
    brushes = any(isinstance(effect, BrushVoltageDrop | GradualBrushDrop) for effect in model.motor.effects)
    if brushes:
        threshold = MIN_FLOW * current_noise
        known = known & _flows(measured[:, 0], simulated[:, 0], threshold)
    pairs = known[1:] & known[:-1]
    if pairs.sum() < MIN_SAMPLES:
        return None
    motor = _electrical_part(model.motor)
    # a speed that is the mean over just this step
    is_mean = recorded.averaging == OVER_LAST
    voltage = _voltage_between_readings(model, run, len(known))[pairs]

    shapes = brushes * _shapes(measured[:, 0], size)
    opposing = np.stack([shapes[:-1], shapes[1:]], 1)[pairs]

    def steps(signals: Float[np.ndarray, "samples 2"]) -> _SampleIntervals:
        i, w = signals[:-1, 0][pairs], signals[:, 1]
        speed = np.stack([w[1:] if is_mean else w[:-1], w[1:]], 1)[pairs]
        return _SampleIntervals(seconds, i, speed, voltage, opposing)

    reached = residuals[1:, 0][pairs] + steps(simulated).predicted(motor)
    decay, weights = _weights(motor, seconds)
    by_speed = motor.Kb * (weights.sum() if is_mean else np.hypot(*weights))
    parts = (
        current_noise * np.hypot(1, decay),
        speed_noise * by_speed,
        prepared.input_noise.get(recorded.name, 0.0) * weights.sum(),
    )
    noise, even_clock = float(np.linalg.norm(parts)), recorded.has_even_clock
    return _Balance(steps(measured), reached, noise, even_clock)


def _shapes(current: Float[np.ndarray, " samples"], size: float) -> Float[np.ndarray, "samples shapes"]:
    """Shapes of which the drop of the brushes may be made up: constant, and less so below each of the `ONSETS`, in
    units of `size`, A."""
    gradual = np.exp(-np.abs(current)[:, None] / (np.array(ONSETS) * max(size, 1e-300)))
    return np.sign(current)[:, None] * np.hstack([np.ones((len(current), 1)), gradual])


def _voltage_between_readings(model: Model, run: int, length: int) -> Float[np.ndarray, "steps 2"]:
    """The voltage at the start and at the end of each step between the samples of a run, of this number, V."""
    prepared, tape = model.prepared, model.problem.tape
    ends = np.stack([tape.samples_of(run, tape.drive_at(end), length) for end in (0.0, 1.0)], 1)
    if (share := prepared.timing.reading) is not None:  # from one reading to the next two voltages act
        ends[:-1] = (1 - share) * ends[:-1] + share * ends[1:]
    return ends[:-1]


def _flows(
    measured: Float[np.ndarray, " samples"], simulated: Float[np.ndarray, " samples"], threshold: float
) -> Bool[np.ndarray, " samples"]:
    """Where measured and simulated current both clearly flow, in one direction.

    Elsewhere brushes may hold the current at zero and take up any voltage.
    """
    return (np.abs(simulated) > threshold) & (measured * np.sign(simulated) > threshold)


def _sensor_noise(measured: Float[np.ndarray, " samples"], residuals: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a sensor's white noise: the smaller of two estimates, from the measured signal and from its
    residuals, which show it better the rougher the motion is; the latter is at least that of the sensor's resolution.
    """
    return min(white_noise([measured]) or np.inf, noise_of_sensor(measured, residuals))
