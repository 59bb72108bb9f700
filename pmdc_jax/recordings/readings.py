"""Readings of a sensor that is slower than the log: how many samples lie from one to the next."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# A slow sensor shows by at least so many changes of its signal,
MIN_CHANGES = 50
# and by readings, other than zero, of which at least this share differ from the one before
MIN_CHANGED = 0.25
# Largest share of changes that are all of one size: steps of a resolution, which a slow motion crosses now and then
MAX_OF_ONE_SIZE = 0.95
# Shortest interval, in samples, of readings that come now a sample earlier and now later, as from another clock
MIN_UNEVEN_INTERVAL = 4


def repeated_readings(signal: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Where a signal repeats the last reading of a sensor slower than the log; nowhere if it is read at every sample.

    Such a signal changes only every so many samples. One of few counts changes seldom, too, but at any sample, or
    always by one count.
    """
    nowhere = np.zeros(len(signal), bool)
    sizes = np.abs(np.diff(signal))
    changes = np.flatnonzero(sizes > 0) + 1
    if len(changes) < MIN_CHANGES or _are_alike(sizes[changes - 1]):
        return nowhere
    steps = np.diff(changes)
    interval = int(np.gcd.reduce(steps))
    if interval > 1:
        first = changes[0] % interval
        changed = np.diff(signal[first::interval])[signal[first::interval][1:] != 0] != 0
        return np.arange(len(signal)) % interval != first if np.mean(changed) > MIN_CHANGED else nowhere
    interval = int(np.median(steps))
    if interval < MIN_UNEVEN_INTERVAL or np.min(steps) < interval - 1:
        return nowhere
    return ~np.isin(np.arange(len(signal)), np.append(0, changes))


def _are_alike(sizes: Float[np.ndarray, " changes"]) -> bool:
    """Whether nearly all changes are of one size."""
    return bool(np.mean(np.isclose(sizes, np.median(sizes), rtol=1e-3)) > MAX_OF_ONE_SIZE)


def reading_interval(known: Bool[np.ndarray, " samples"]) -> int:
    """The typical number of samples from one `known` reading to the next, at least 1."""
    steps = np.diff(np.flatnonzero(known))
    return int(np.median(steps)) if len(steps) else 1
