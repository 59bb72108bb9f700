"""Rounding errors of coarse converters, which even a complete model leaves.

They persist as long as the reading does not change, so no whitening filter removes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ...identify.fit.run_series import RunSeries
from ...recordings.recording import SIMULATED_OUTPUTS, Recording
from ...recordings.resolution import quantum

# Simulated readings, each with the converter's steps at another offset
ROUNDING_DRAWS = 8
# Rounding errors are white, as noise blurs the steps, if the residuals are at least this many steps (root mean square),
BLURRING_RESIDUAL = 0.6
# or if the measured signal is so many times as rough as the simulated readings, as differences of encoder counts are
BLURRING_ROUGHNESS = 1.5


def rounding_errors(fit: RunSeries, steps: Sequence[float], seed: int) -> Float[np.ndarray, "samples outputs draws"]:
    """Rounding errors of converters with the run's `steps` (see `converter_steps`), reading the simulated outputs; zero
    where noise blurs the steps.

    The offsets of the steps are drawn at random. The simulated outputs are read without noise: that of the sensors may
    arise after the converter, or before it and be small.
    """
    random = np.random.default_rng(seed)
    known, values = fit.residual.known, fit.simulated.values
    errors = np.zeros((*values.shape, ROUNDING_DRAWS))
    outputs = zip(values.T, fit.residual.values.T, steps, strict=True)
    for k, (simulated, residual, step) in enumerate(outputs):
        measured = (simulated + residual)[known]
        if np.mean(np.square(residual[known])) >= (BLURRING_RESIDUAL * step) ** 2:
            continue
        exact = simulated[:, None] + step * random.uniform(size=ROUNDING_DRAWS)
        read = step * np.round(exact / step)
        if _roughness(measured) < BLURRING_ROUGHNESS * _roughness(read[known]):
            errors[:, k] = read - exact
    return errors


def converter_steps(run: Recording, outputs: Iterable[int]) -> list[float]:
    """The steps of the converters that read some outputs of a run, as recorded; zero if there are none."""
    signals = [getattr(run.recorded, SIMULATED_OUTPUTS[output]) for output in outputs]
    return [0.0 if signal is None else quantum(np.diff(signal)) for signal in signals]


def _roughness(signals: Float[np.ndarray, "samples *signals"]) -> float:
    """How much signals fluctuate from sample to sample: the standard deviation of their second differences."""
    return float(np.std(np.diff(signals, 2, axis=0)))
