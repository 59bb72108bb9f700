"""Rounding errors of coarse converters, which even a complete model leaves.

They last as long as the reading stands still, so no whitening filter removes them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..identify.noise import quantum
from .model import RunSeries

# Simulated readings, each with the converter's steps at another offset
READINGS = 8
# Noise blurs the steps, and rounding errors are white, from residuals of this many steps on (root mean square), or if
# the measured signal fluctuates from sample to sample this many times as much as the simulated readings, as differences
# of an encoder's counts do
BLURRED, RESTLESS = 0.6, 1.5


def readings(fit: RunSeries, run: int) -> Float[np.ndarray, "samples outputs readings"]:
    """Rounding errors of converters as coarse as the run's, reading the simulated outputs; zero where noise blurs the
    steps.

    The offsets of the steps are drawn at random, with the number of the `run` as seed. The simulated outputs are read
    without noise: that of the sensors may arise after the converter, or before it and be small.
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
    """How much signals fluctuate from sample to sample: the standard deviation of their second differences."""
    return float(np.std(np.diff(signals, 2, axis=0)))
