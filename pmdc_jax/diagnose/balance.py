"""Whether a model meets the electrical equation to the noise of the sensors, whatever torque the motor is under.

A torque that fluctuates makes the residuals of a free run large and slow, and a filter of the noise then takes for
noise what a model lacks, too. But no torque enters the electrical equation: from sample to sample the residual of the
current follows that of the speed, but for the white noise of the sensors.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..identify.generalised_least_squares import residuals_of, series_of
from ..identify.noise import resolution_noise, white_noise
from ..motor import Drive, Motor
from .model import Model

# Fewer samples of a run tell nothing
ENOUGH = 50


def electrical_misfit(model: Model) -> float:
    """What the electrical equation leaves, over what the white noise of the sensors would, as root mean square: of the
    run where that is most; 1 where no run has voltage, current and speed, or nothing is missed.

    With residuals i and w of current and speed, R i + L di/dt + Kb w = 0 between two samples, w on a straight line.
    """
    if model.is_exact:
        return 1.0
    given, tape, ratios = model.given, model.given.problem.tape, [1.0]
    residuals = residuals_of(given, model.fit)
    for run, residual in zip(model.training, residuals, strict=True):
        drive, known = tape.drive_of(run), residual.known
        if residual.kind[1] != (0, 1) or not drive.voltage or known.sum() < ENOUGH:
            continue
        left, measured = residual.values, series_of(tape, run, np.asarray(tape.measured)).values
        current, speed = (_noise(measured[known, c], left[known, c]) for c in range(2))
        kept, before, after, volt = _step(model.motor, drive, tape.sample_time_of(run))
        i, w = left.T
        rest = i[1:] - kept * i[:-1] - before * w[:-1] - after * w[1:]
        rest = rest[known[1:] & known[:-1]]
        unfelt = given.input_noise.get(given.runs[run].name, 0.0)
        explained = current**2 * (1 + kept**2) + speed**2 * (before**2 + after**2)
        explained += (volt * unfelt) ** 2
        ratios.append(float(np.sqrt(np.mean(np.square(rest)) / explained)))
    return max(ratios)


def _step(motor: Motor, drive: Drive, seconds: float) -> tuple[float, float, float, float]:
    """What of the current is left after a step, and what the speed before and after it, and a volt throughout, add to
    it: A per A, A per rad/s twice, A per V."""
    A, B = map(np.asarray, motor.state_space(drive))
    decay = A[0, 0] * seconds
    mean = np.expm1(decay) / decay
    later = (mean - 1) / decay
    by_speed, by_volt = A[0, 1] * seconds, B[0, 0] * seconds
    return np.exp(decay), by_speed * (mean - later), by_speed * later, by_volt * mean


def _noise(measured: Float[np.ndarray, " samples"], left: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a sensor's white noise: by what was measured, or by what a model leaves of it, which shows
    it better the rougher the motion is, unless the sensor's own steps are coarser."""
    by_fit = max(white_noise([left]) or 0.0, resolution_noise([measured]))
    return min(white_noise([measured]) or np.inf, by_fit)
