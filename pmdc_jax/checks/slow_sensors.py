"""Outputs of sensors slower than the log, which repeats each reading until the next one."""

from __future__ import annotations

import attrs
import numpy as np

from ..recordings.readings import repeated_readings
from ..recordings.recording import RECORDED_OUTPUTS, Recording


def readings_only(run: Recording) -> Recording:
    """The run with the repeated readings of slow sensors set to NaN.

    If nothing else changes in between either, only the samples remain at which all these sensors are read.
    """
    outputs = [name for name in RECORDED_OUTPUTS if getattr(run, name) is not None and name != run.drive]
    repeated = {name: repeated_readings(getattr(run, name)) for name in outputs}
    slow = [name for name in outputs if repeated[name].any()]
    if not slow:
        return run
    between = repeated[slow[0]]
    inputs = [x for x in (run.voltage, run.torque, run.load) if x is not None]
    all_slow = all(np.array_equal(repeated[name], between) for name in outputs)
    if all_slow and not any(np.diff(x)[between[1:]].any() for x in inputs):
        return attrs.evolve(run, **{name: x[~between] for name, x in run.columns().items()})
    return attrs.evolve(run, **{name: np.where(repeated[name], np.nan, getattr(run, name)) for name in slow})
