"""The motor of the wheelchair paper, and recordings of the virtual bench, for several test files."""

from __future__ import annotations

from benchmarks import virtual_bench as vb
from pmdc_jax.recording import Recording

PAPER = {name: getattr(vb.paper_motor(), name) for name in vb.SIX}


def recording_of(name: str, columns: vb.Columns) -> Recording:
    """The run with these columns of the virtual bench."""
    quantities = ("time_s", "voltage_V", "current_A", "speed_rad_s")
    return Recording(name, *(columns[q] for q in quantities), load=columns.get("load_torque_Nm"))
