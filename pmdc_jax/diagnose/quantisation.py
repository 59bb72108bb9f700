"""What a coarse converter leaves of a motor that lacks nothing: errors that last as long as its reading stands still,
which no filter of the noise takes out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..identify.noise import quantum
from .model import RunSeries

# Readings that are tried
READINGS = 8
# Errors of so many steps blur them: what rounding adds to such noise is as white. So do errors that come and go by so
# many times more than those of the readings, as those of an encoder whose counts are taken from sample to sample
BLURRED, RESTLESS = 0.6, 1.5


def readings(fit: RunSeries, run: int) -> Float[np.ndarray, "samples outputs readings"]:
    """Errors of converters as coarse as a run's that read what is simulated, their steps at any height; none of
    outputs whose errors blur the steps. The same for the same `run`, its number.

    No noise is read with it: that of the sensors may come after the converter, or before it and be little.
    """
    random = np.random.default_rng(run)
    known, values = fit.residual.known, fit.simulated.values
    errors = np.zeros((*values.shape, READINGS))
    pairs = zip(values.T, fit.residual.values.T, strict=True)
    for k, (simulated, left) in enumerate(pairs):
        measured = (simulated + left)[known]
        step = quantum(np.diff(measured))
        if np.mean(np.square(left[known])) >= (BLURRED * step) ** 2:
            continue
        exact = simulated[:, None] + step * random.uniform(size=READINGS)
        read = step * np.round(exact / step)
        if _restlessness(measured) < RESTLESS * _restlessness(read[known]):
            errors[:, k] = read - exact
    return errors


def _restlessness(signals: Float[np.ndarray, "samples *signals"]) -> float:
    """How much signals come and go from sample to sample."""
    return float(np.std(np.diff(signals, 2, axis=0)))
