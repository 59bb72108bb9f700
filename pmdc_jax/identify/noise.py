"""How large the noise of the measurements is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# A channel without noise (a simulation) is still scaled by something: this share of its size.
FLOOR = 1e-5


def white_noise(signals: Sequence[np.ndarray]) -> float | None:
    """Standard deviation of the white part of some signals of one kind, None without any.

    From second differences, which leave a smooth motion out; by their median, which leaves jumps out.
    """
    differences = [np.diff(s[~np.isnan(s)], 2) for s in signals]
    differences = np.concatenate([d for d in differences if len(d)] or [np.empty(0)])
    if not len(differences):
        return None
    size = np.sqrt(np.mean([np.nanmean(np.square(s)) for s in signals]))
    spread = np.median(np.abs(differences)) / (0.6745 * np.sqrt(6.0))
    return float(max(spread, FLOOR * size, 1e-12))
