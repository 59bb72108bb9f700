"""The next experiment as a CSV file for a power stage."""

from __future__ import annotations

from pathlib import Path

from ..diagnose.diagnosis import Diagnosis
from ..files import write_text


def write_experiment(diagnosis: Diagnosis, path: str | Path) -> bool:
    """Write the voltage of the next experiment as CSV: time_s, and voltage_V held until the next row.

    **Returns**: False, with nothing written, if the diagnosis has no next experiment.
    """
    experiment = diagnosis.next_experiment
    if experiment is None:
        return False
    samples = zip(experiment.time, experiment.voltage, strict=True)
    rows = [f"{time:.9g},{voltage:.9g}" for time, voltage in samples]
    write_text(path, "\n".join(["time_s,voltage_V", *rows]) + "\n")
    return True
