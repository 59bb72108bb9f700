"""Whether a model meets the electrical equation to the noise of the sensors, whatever torque the motor is under.

A torque that fluctuates makes the residuals of a free run large and slow, and a filter of the noise then takes for
noise what a model lacks, too. But no torque enters the electrical equation: from sample to sample the residual of the
current follows that of the speed, but for the white noise of the sensors.
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

# Fewer samples of a run tell nothing
ENOUGH = 50
# A current is none by chance from so many times the noise of its sensor on
CLEAR = 4.0
# Errors of sensors are in two steps that follow each other, and what pulses of a bridge put into a step that does not
# end with one of them is in no other: what is in steps so far apart, by more standard errors than chance brings, is
# what the equation lacks
APART, CHANCE = range(2, 9), 3.0


class _Balance(NamedTuple):
    """Of one run what the electrical equation leaves of the current from sample to sample, and what other values of R,
    Kb, a voltage that opposes the current, and L would add to it, both over the white noise of the sensors."""

    rest: Float[np.ndarray, " samples"]
    by_parameters: Float[np.ndarray, "samples 4"]


def electrical_misfit(model: Model) -> float:
    """What the electrical equation leaves, over what the white noise of the sensors would, as root mean square: of the
    run where that is most; 1 where no run has voltage, current and speed, or nothing is missed.

    With residuals i and w of current and speed, R i + L di/dt + Kb w = 0 between two samples, w on a straight line. R,
    L, Kb and the drop of brushes are those that leave least: torques that fluctuate lead the fit of a free run astray.
    Added to the noise is what steps some samples `APART` have in common: a voltage that is rough lacks no effect.
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
    rest, columns = map(np.concatenate, zip(*balances, strict=True))
    better = np.linalg.lstsq(columns, rest, rcond=None)[0]
    return float(np.sqrt(1 + max(_lasting(b.rest - b.by_parameters @ better) for b in balances)))


def _lasting(rest: Float[np.ndarray, " samples"]) -> float:
    """The largest product of two values some samples apart, on average, less what chance makes it."""
    products = [rest[apart:] * rest[:-apart] for apart in APART]
    clear = [abs(p.mean()) - CHANCE * p.std() / np.sqrt(len(p)) for p in products]
    return float(max(0.0, *clear))


def _balance(model: Model, run: int, residual: Series) -> _Balance | None:
    """What the electrical equation leaves of a run; None of one that tells nothing."""
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
    if given.runs[run].averaging == OVER_LAST:  # the mean over that very step
        before, after = 0.0, before + after
    i, w = left.T
    rest = i[1:] - kept * i[:-1] - before * w[:-1] - after * w[1:]
    mean, change = (simulated[1:] + simulated[:-1]) / 2, np.diff(simulated[:, :1], axis=0)
    unfelt = given.input_noise.get(given.runs[run].name, 0.0)
    explained = current**2 * (1 + kept**2) + speed**2 * (before**2 + after**2)
    noise = np.sqrt(explained + (volt * unfelt) ** 2)
    drop = volt * brushes * np.sign(mean[:, :1])
    by_parameters = np.concatenate([volt * mean, drop, change], axis=1)
    return _Balance(rest[pairs] / noise, by_parameters[pairs] / noise)


def _step(motor: Motor, drive: Drive, seconds: float) -> tuple[float, float, float, float]:
    """What of the current is left after a step, and what the speed before and after it, and a volt throughout, add to
    it: A per A, A per rad/s twice, A per V."""
    A, B = map(np.asarray, motor.state_space(drive))
    decay = A[0, 0] * seconds
    mean = np.expm1(decay) / decay
    later = (mean - 1) / decay
    by_speed, by_volt = A[0, 1] * seconds, B[0, 0] * seconds
    return np.exp(decay), by_speed * (mean - later), by_speed * later, by_volt * mean


def _flows(
    measured: Float[np.ndarray, " samples"], simulated: Float[np.ndarray, " samples"], clear: float
) -> Bool[np.ndarray, " samples"]:
    """Where a current flows by both, in one direction: brushes that hold it at zero take up any voltage."""
    return (np.abs(simulated) > clear) & (measured * np.sign(simulated) > clear)


def _noise(measured: Float[np.ndarray, " samples"], left: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a sensor's white noise: by what was measured, or by what a model leaves of it, which shows
    it better the rougher the motion is, unless the sensor's own steps are coarser."""
    return min(white_noise([measured]) or np.inf, noise_of_sensor(measured, left))
