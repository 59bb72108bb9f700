"""Mains hum that a sensor picked up is removed; a torque that oscillates at the frequency of the mains is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from linear_motor import PAPER

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import diagnose, identify
from pmdc_jax.recordings.recording import Recording

MOTOR = vb.BenchMotor(**PAPER)
Wave = Callable[[np.ndarray], np.ndarray]


def hum(frequency: float, amplitude: float, phase: float) -> Wave:
    """A fundamental and its third harmonic."""
    angle = 2 * np.pi * frequency
    return lambda time: amplitude * (np.sin(angle * time + phase) + 0.25 * np.sin(3 * angle * time + 2.1 * phase))


def recorded(amplitude: float = 0.0, frequency: float = 50.0, of: str = "current_A", **effects: float):
    """Runs of the virtual bench whose current or speed has hum, or whose motor an oscillating torque."""
    rng, runs = np.random.default_rng(41), []
    motor = vb.BenchMotor(**PAPER | effects)
    excitations = {"prbs": vb.prbs(rng, 4.0), "stairs": vb.staircase(4.0), "loaded": vb.loaded(rng, 4.0)}
    for phase, (name, excitation) in enumerate(excitations.items()):
        wave = hum(frequency, amplitude, float(phase))
        load = excitation.load + (wave(excitation.time) if of == "torque" else 0.0)
        columns = vb.record(motor, excitation._replace(load=load), rng, vb.Noise(0.1, 0.5))
        columns["load_torque_Nm"] = excitation.load
        if of != "torque":
            columns[of] = columns[of] + wave(columns["time_s"])
        runs.append(recording(name, columns))
    return runs


def humming(runs: list[Recording]) -> list[str]:
    return [message for message in identify(runs).messages if "mains hum" in message]


@pytest.mark.parametrize(
    ("amplitude", "frequency", "of", "said"),
    [(0.1, 50.0, "current_A", "0.1 A"), (0.3, 59.9, "speed_rad_s", "0.3 rad/s")],
)
def test_hum_of_a_sensor_is_removed(amplitude, frequency, of, said):
    (message,) = humming(recorded(amplitude, frequency, of))
    size, unit = message.split(" of ")[2].split(":")[0].split(" ", 1)
    assert float(size) == pytest.approx(amplitude, rel=0.05)
    assert unit == said.split(" ", 1)[1]


def test_a_run_that_is_sampled_too_slowly_to_show_hum_is_left_as_it_is():
    runs = recorded(0.1)
    quick, slow = runs[0], {name: x[::10] for name, x in runs[1].columns().items()}
    assert identify([quick, runs[2]], holdout=Recording("slow", **slow)).fit["slow"].role == "holdout"


@pytest.mark.parametrize(
    ("amplitude", "frequency", "of"), [(0.0, 50.0, "current_A"), (0.1, 50.0, "torque"), (0.1, 43.0, "current_A")]
)
def test_other_oscillations_are_no_hum(amplitude, frequency, of):
    """Of a torque, or at another frequency."""
    assert humming(recorded(amplitude, frequency, of)) == []


@pytest.mark.slow
def test_a_motor_whose_current_sensor_hums_lacks_nothing():
    assert diagnose(recorded(0.1)).verdict == "none_detected"


@pytest.mark.slow
def test_hum_beside_hidden_friction_is_found_once_the_friction_is_named():
    found = diagnose(recorded(0.1, coulomb_Nm=0.05))
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert [m for m in found.final.messages if "mains hum" in m]
