"""Make the packaged sample, `pmdc_jax/sample/*.csv`: `python -m benchmarks.make_sample`.

The true parameters are in this script only. It is a plausible 24 V catalogue motor, linear except for the dry friction
of its brushes and bearings: about 3,600 rev/min and 0.9 A without load, 40 A at stall, time constants 1.1 ms and 19 ms.
"""

from pathlib import Path

import numpy as np

from benchmarks import virtual_bench as vb

SAMPLE = Path(__file__).parents[1] / "pmdc_jax" / "sample"
TRUTH = vb.BenchMotor(R=0.60, L=0.65e-3, Kb=0.0635, Kt=0.0635, J=1.3e-4, f=1.2e-4, coulomb_Nm=0.012)
NOISE = vb.Noise(current_A=0.05, speed_rad_s=0.3, torque_Nm=0.002, torque_correlation_s=0.01)
DECIMALS = {"current_A": 2, "speed_rad_s": 2, "Current (mA)": 0, "Speed [rpm]": 1}


def excitations(rng: np.random.Generator) -> dict[str, vb.Excitation]:
    """The excitation of each file; runs without load have a load column of zeros."""
    return {
        "staircase": vb.staircase(duration=4.0),
        "prbs": vb.prbs(rng, duration=2.0, dt=5e-4, hold=0.005),
        "triangle": vb.slow_triangle(duration=6.0, dt=2e-3, amplitude=8.0),
        "loaded": vb.loaded(rng, duration=4.0, amplitude=16.0, load=0.35),
        "drive": vb.drive(rng, duration=4.0, amplitude=18.0, load=0.3),
    }


def applied(excitation: vb.Excitation) -> vb.Excitation:
    """Voltage rounded to 0.01 V and load to 0.001 N m, so that the short numbers in the files are exact."""
    time, voltage, load = excitation
    return vb.Excitation(time, np.round(voltage, 2), np.round(load, 3))


def in_mixed_units(columns: vb.Columns) -> vb.Columns:
    """The same record as by another logger: mA and rev/min, with other headers."""
    foreign = {"current_A": ("Current (mA)", 1e3), "speed_rad_s": ("Speed [rpm]", 30.0 / np.pi)}
    renamed = {}
    for name, values in columns.items():
        header, factor = foreign.get(name, (name, 1.0))
        renamed[header] = factor * values
    return renamed


def make_sample(folder: Path = SAMPLE) -> None:
    """Write the five records; the same bytes every time."""
    rng = np.random.default_rng(24)
    folder.mkdir(parents=True, exist_ok=True)
    for name, excitation in excitations(rng).items():
        columns = vb.record(TRUTH, applied(excitation), rng, NOISE)
        if name == "triangle":
            columns = in_mixed_units(columns)
        rounded = {header: np.round(v, DECIMALS.get(header, 9)) for header, v in columns.items()}
        vb.write_csv(folder / f"{name}.csv", rounded)


if __name__ == "__main__":
    make_sample()
