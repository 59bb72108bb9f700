"""White noise of a signal, estimated from its differences."""

from __future__ import annotations

from math import comb

import numpy as np
from jaxtyping import Float

# Median absolute value of a normal variable of unit variance
NORMAL_MEDIAN = 0.6745


def noise_by_differences(order: int, *signals: Float[np.ndarray, " _"]) -> float:
    """Standard deviation of the white noise common to some signals, from their differences of order n = `order`.

    These differences remove motion that is a polynomial of degree n - 1 over a few samples, and have (2 n)! / (n!)^2
    times the variance of the noise. Their median absolute value is robust against jumps. Values that are not finite are
    ignored; the result is zero if none remain.

    **Source**: von Neumann, Annals of Mathematical Statistics 12 (1941), doi:10.1214/aoms/1177731677; the median:
    Rousseeuw, Croux, Journal of the American Statistical Association 88 (1993), doi:10.1080/01621459.1993.10476408.
    """
    differences = np.concatenate([np.diff(signal, order) for signal in signals] or [np.empty(0)])
    sizes = np.abs(differences[np.isfinite(differences)])
    return float(np.median(sizes) / (NORMAL_MEDIAN * np.sqrt(comb(2 * order, order)))) if len(sizes) else 0.0
