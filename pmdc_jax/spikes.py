"""Samples that leap far out and straight back, as where a telegram was lost or a counter read wrongly."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from jaxtyping import Bool, Float

from .recording import Finding, Recording

# A spike is so many times what a signal usually bends from sample to sample, and this share of its range at least
STANDS_OUT, LARGE = 50.0, 0.2
# Its neighbours differ by no more than this share of it; a voltage is steady if it moves by no more of its range
ALIKE = 0.2
# More than this share of all samples are no spikes
RARE = 0.01


def without_spikes(run: Recording) -> Recording:
    """A run with the spikes of its outputs missing, and a note on each output that had any."""
    outputs = ("speed", "current") if run.drive == "voltage" else ("speed",)
    for name in outputs:
        signal = getattr(run, name)
        if signal is None:
            continue
        spikes = _spikes(signal) & _steady(run)
        if 0 < spikes.sum() <= RARE * len(run):
            run = attrs.evolve(run, **{name: np.where(spikes, np.nan, signal)})
            run = attrs.evolve(run, notes=(*run.notes, *_note(run, name, signal, spikes)))
    return run


def _spikes(signal: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    before, after = np.diff(signal)[:-1], -np.diff(signal)[1:]
    size = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    apart = np.abs(signal[2:] - signal[:-2])
    low, high = np.nanquantile(signal, [0.02, 0.98])
    least = max(STANDS_OUT * np.nanmedian(np.abs(np.diff(signal, 2))), LARGE * (high - low))
    return np.pad((size > least) & (apart < ALIKE * size), 1)


def _steady(run: Recording) -> Bool[np.ndarray, " samples"]:
    """Where what drives cannot have made a spike, for it is as it was."""
    drive = np.asarray(getattr(run, run.drive))
    leaps = np.abs(np.diff(drive, prepend=drive[0])) > ALIKE * np.ptp(drive)
    return ~(leaps | np.roll(leaps, 1) | np.roll(leaps, -1))


def _note(run: Recording, name: str, signal: np.ndarray, spikes: np.ndarray) -> Iterator[Finding]:
    rows = np.flatnonzero(spikes)
    what = "1 sample leaps" if len(rows) == 1 else f"{len(rows)} samples leap"
    yield Finding(
        run.name,
        name,
        "note",
        f"{what} out to as much as {signal[rows[np.argmax(np.abs(signal[rows]))]]:.6g} and straight back: taken as "
        "missing",
        f"sample {rows[0] + 1} ({run.time[rows[0]]:.6g} s)"
        + (" and others" if len(rows) > 1 else ""),
        "If the motor did so, sample faster",
    )
