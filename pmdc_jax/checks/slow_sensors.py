"""Outputs of sensors slower than the log, which repeats each reading until the next one."""

from __future__ import annotations

import attrs
import numpy as np

from ..recordings.readings import repeated_readings
from ..recordings.recording import OUTPUTS, Recording


def readings_only(run: Recording) -> Recording:
    """The run with the repeated readings of slow sensors set to NaN.

    If nothing else changes in between either, only the samples remain at which all these sensors are read.
    """
    outputs = {name for name in OUTPUTS if getattr(run, name) is not None and name != run.drive}
    repeated = {name: repeated_readings(getattr(run, name)) for name in outputs}
    slow = {name: mask for name, mask in repeated.items() if mask.any()}
    if not slow:
        return run
    any_mask = next(iter(slow.values()))
    if slow.keys() == outputs and all(np.array_equal(mask, any_mask) for mask in slow.values()):
        inputs = [x for x in (run.voltage, run.torque, run.load) if x is not None]
        if not any(np.diff(x)[any_mask[1:]].any() for x in inputs):
            return attrs.evolve(run, **{name: x[~any_mask] for name, x in run.columns().items()})
    return attrs.evolve(run, **{name: np.where(mask, np.nan, getattr(run, name)) for name, mask in slow.items()})
