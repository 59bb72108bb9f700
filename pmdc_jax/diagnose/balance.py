"""Whether a model meets the electrical equation to the noise of the sensors, whatever torque the motor is under.

A torque that fluctuates makes the residuals of a free run large and slow, and a filter of the noise then takes for
noise what a model lacks, too. But no torque enters the electrical equation: from sample to sample the residual of the
current follows that of the speed, but for the white noise of the sensors.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..identify.noise import resolution_noise, white_noise
from ..motor import Motor
from .model import Model, rows_of

# Fewer samples of a run tell nothing
ENOUGH = 50


def electrical_misfit(model: Model) -> float:
    """What the electrical equation leaves, over what the white noise of the sensors would, as root mean square: of the
    run where that is most; 1 where no run has voltage, current and speed, or nothing is missed.

    With residuals i and w of current and speed, R i + L di/dt + Kb w = 0 between two samples, w on a straight line.
    """
    tape, given = model.given.problem.tape, model.given
    ratios = [1.0]
    if model.is_exact:
        return 1.0
    for run, rows in zip(model.training, rows_of(model), strict=True):
        both = rows.residual.kind[1] == (0, 1)
        if not both or not float(tape.drive_of(run).voltage) or rows.residual.known.sum() < ENOUGH:
            continue
        left = rows.residual.values
        measured = left + rows.simulated.values
        known = rows.residual.known
        current, speed = (_noise(measured[known, c], left[known, c]) for c in range(2))
        a, before, after, volt = _step(model.motor, tape.sample_time_of(run))
        i, w = left.T
        rest = i[1:] - a * i[:-1] + before * w[:-1] + after * w[1:]
        rest = rest[known[1:] & known[:-1]]
        unfelt = given.input_noise.get(given.runs[run].name, 0.0)
        explained = (
            current**2 * (1 + a**2) + speed**2 * (before**2 + after**2) + (volt * unfelt) ** 2
        )
        ratios.append(float(np.sqrt(np.mean(np.square(rest)) / explained)))
    return max(ratios)


def _step(motor: Motor, seconds: float) -> tuple[float, float, float, float]:
    """What of the current is left after a step, and what the speed before and after it, and a volt throughout, take of
    it and add to it: A per A, A per rad/s twice, A per V."""
    R, L, Kb = (float(x) for x in (motor.R, motor.L, motor.Kb))
    x = R * seconds / L
    a, mean = np.exp(-x), -np.expm1(-x) / x
    later = (1 - mean) / x
    return a, Kb * seconds / L * (mean - later), Kb * seconds / L * later, seconds / L * mean


def _noise(measured: Float[np.ndarray, " samples"], left: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a sensor's white noise: by what was measured, or by what a model leaves of it, which shows
    it better the rougher the motion is, unless the sensor's own steps are coarser."""
    by_fit = max(white_noise([left]) or 0.0, resolution_noise([measured]))
    return min(white_noise([measured]) or np.inf, by_fit)
