"""Recordings of motors on the virtual bench, which shares no code with the package."""

from collections.abc import Mapping

import numpy as np

from benchmarks import virtual_bench as vb
from pmdc_jax import Recording


def recording(name: str, columns: vb.Columns) -> Recording:
    """A record of the virtual bench as a recording."""
    signals = (columns[c] for c in ("time_s", "voltage_V", "current_A", "speed_rad_s"))
    return Recording(name, *signals, load=columns.get("load_torque_Nm"))


def acceptance_runs(rng: np.random.Generator) -> dict[str, vb.Excitation]:
    """The five kinds of log: staircase, PRBS, slow triangle, loaded, 60 s of load cycles."""
    return {
        "staircase": vb.staircase(),
        "prbs": vb.prbs(rng),
        "triangle": vb.slow_triangle(),
        "loaded": vb.loaded(rng),
        "load_cycles": vb.load_cycles(rng),
    }


def record_all(
    motor: vb.BenchMotor,
    excitations: Mapping[str, vb.Excitation],
    rng: np.random.Generator,
    noise: vb.Noise,
    load_known: bool = True,
) -> list[Recording]:
    """One noisy recording of each excitation."""
    return [
        recording(name, vb.record(motor, excitation, rng, noise, load_known=load_known))
        for name, excitation in excitations.items()
    ]
