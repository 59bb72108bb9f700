"""What a coarse converter leaves of a motor that lacks nothing: errors that last as long as its reading stands still,
which no filter of the noise takes out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..identify.noise import quantum
from .model import Fit

# Readings that are tried
READINGS = 8
# Errors of so many quanta blur them: what rounding adds to such noise is as white
BLURRED = 0.6


def readings(fit: Fit, run: int) -> Float[np.ndarray, "samples outputs readings"]:
    """Errors of converters as coarse as a run's that read what is simulated, their steps at any height; none of
    outputs whose errors blur the steps. The same for the same `run`, its number.

    No noise is read with it: that of the sensors may come after the converter, or before it and be little.
    """
    random = np.random.default_rng(run)
    known, values = fit.residual.known, fit.simulated.values
    errors = np.zeros((*values.shape, READINGS))
    pairs = zip(values.T, fit.residual.values.T, strict=True)
    for k, (simulated, left) in enumerate(pairs):
        step = quantum(np.diff((simulated + left)[known]))
        if np.mean(np.square(left[known])) < (BLURRED * step) ** 2:
            exact = simulated[:, None] + step * random.uniform(size=READINGS)
            errors[:, k] = step * np.round(exact / step) - exact
    return errors
