"""Rounding errors of coarse converters, which even a complete model leaves.

They persist as long as the reading does not change, so no whitening filter removes them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ...recordings.resolution import quantum
from ..model import RunSeries

# Simulated readings, each with the converter's steps at another offset
ROUNDING_DRAWS = 8
# Rounding errors are white, as noise blurs the steps, if the residuals are at least this many steps (root mean square),
BLURRING_RESIDUAL = 0.6
# or if the measured signal is so many times as rough as the simulated readings, as differences of encoder counts are
BLURRING_ROUGHNESS = 1.5


def rounding_errors(fit: RunSeries, run: int) -> Float[np.ndarray, "samples outputs draws"]:
    """Rounding errors of converters as coarse as the run's, reading the simulated outputs; zero where noise blurs the
    steps.

    The offsets of the steps are drawn at random, with the number of the `run` as seed. The simulated outputs are read
    without noise: that of the sensors may arise after the converter, or before it and be small.
    """
    random = np.random.default_rng(run)
    known, values = fit.residual.known, fit.simulated.values
    errors = np.zeros((*values.shape, ROUNDING_DRAWS))
    pairs = zip(values.T, fit.residual.values.T, strict=True)
    for k, (simulated, residual) in enumerate(pairs):
        measured = (simulated + residual)[known]
        step = quantum(np.diff(measured))
        if np.mean(np.square(residual[known])) >= (BLURRING_RESIDUAL * step) ** 2:
            continue
        exact = simulated[:, None] + step * random.uniform(size=ROUNDING_DRAWS)
        read = step * np.round(exact / step)
        if _roughness(measured) < BLURRING_ROUGHNESS * _roughness(read[known]):
            errors[:, k] = read - exact
    return errors


def _roughness(signals: Float[np.ndarray, "samples *signals"]) -> float:
    """How much signals fluctuate from sample to sample: the standard deviation of their second differences."""
    return float(np.std(np.diff(signals, 2, axis=0)))
