"""The misfit of the electrical equation: not affected by fluctuating torques or by brushes that block the current."""

from __future__ import annotations

import numpy as np
import pytest
from linear_motor import PAPER
from scipy.signal import cont2discrete, dlsim, lfilter

from benchmarks import virtual_bench as vb
from benchmarks.naming.cases import Bench, record
from benchmarks.naming.plant import Plant
from experiments.bench import recording
from pmdc_jax.diagnose.diagnosis import MAX_ELECTRICAL
from pmdc_jax.diagnose.evidence.electrical_balance import electrical_misfit
from pmdc_jax.diagnose.model import Model, model_of
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.prepare import prepare
from pmdc_jax.identify.solve import solve
from pmdc_jax.recordings.recording import Recording

MOTOR = PAPER | {"brush_drop_V": 0.6}
SLOW_TORQUE = vb.Noise(0.1, 0.5, torque_Nm=0.05, torque_correlation_s=0.3)


def fitted(current_mean_samples: int = 1, voltage_noise: float = 0.0) -> Model:
    """A fit to a motor with brushes and slow torque noise. The recorded current is a mean over `current_mean_samples`;
    the applied voltage differs from the recorded one by multiplicative noise with the deviation `voltage_noise`."""
    rng, runs = np.random.default_rng(11), []
    excitations = {"prbs": vb.prbs(rng, 2.0), "triangle": vb.slow_triangle(2.0)}
    for name, excitation in excitations.items():
        applied = excitation.voltage * (1 + voltage_noise * rng.standard_normal(len(excitation.time)))
        columns = vb.record(vb.BenchMotor(**MOTOR), excitation._replace(voltage=applied), rng, SLOW_TORQUE)
        columns["voltage_V"] = excitation.voltage
        average = np.ones(current_mean_samples) / current_mean_samples
        columns["current_A"] = lfilter(average, 1.0, columns["current_A"])
        runs.append(recording(name, columns))
    given = prepare(runs, (), effects=[EFFECTS["brush_voltage_drop"]])
    return model_of(solve(given, "cma_es", 0).fitted)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_brushes_that_block_the_current_cause_no_electrical_misfit():
    assert electrical_misfit(fitted()) < 1.5


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_pulses_not_aligned_with_the_samples_cause_no_electrical_misfit():
    assert electrical_misfit(fitted(voltage_noise=0.2)) < 1.5


@pytest.mark.usefixtures("x64")
def test_an_averaged_current_breaks_the_electrical_equation():
    assert electrical_misfit(fitted(current_mean_samples=4)) > MAX_ELECTRICAL


def run_with_compliant_shaft(seed: int, volts: float) -> Recording:
    """The paper's motor with half of its inertia behind a shaft that rings at 20 Hz, exact from sample to sample."""
    m, step, rng = PAPER, 1e-3, np.random.default_rng(seed)
    J = m["J"] / 2
    stiffness, damping = J / 2 * (2 * np.pi * 20) ** 2, 0.02 * J * 2 * np.pi * 20
    A = np.zeros((4, 4))  # of current, motor speed, load speed and twist
    A[0, :2] = -m["R"] / m["L"], -m["Kb"] / m["L"]
    A[1] = np.array([m["Kt"], -m["f"] - damping, damping, -stiffness]) / J
    A[2] = np.array([0, damping, -damping, stiffness]) / J
    A[3, 1:3] = 1, -1
    B, C, D = np.array([[1 / m["L"]], [0], [0], [0]]), np.eye(4)[:2], np.zeros((2, 1))
    voltage = volts * np.repeat(2.0 * rng.integers(0, 2, 200) - 1, 10)
    outputs = dlsim(cont2discrete((A, B, C, D), step), voltage)[1]
    outputs += np.array([0.1, 0.3]) * rng.standard_normal(outputs.shape)
    return Recording(f"run{seed}", step * np.arange(len(voltage)), voltage, *outputs.T)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_a_hidden_shaft_causes_no_electrical_misfit():
    """It biases R and L by a tenth, with which the misfit would be 8.5."""
    runs = [run_with_compliant_shaft(1, 12.0), run_with_compliant_shaft(2, 20.0)]
    solved = solve(prepare(runs, (), unloaded=True, tie=[("Kt", "Kb")]), "cma_es", 0)
    model = model_of(solved.fitted)
    assert abs(model.motor.R / PAPER["R"] - 1) > 0.05
    assert electrical_misfit(model) < 1.1


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_brushes_whose_drop_sets_in_gradually_cause_no_electrical_misfit():
    """With an onset in proportion to each run's current it would be 4.5."""
    small = {"R": 1.2, "L": 1.5e-3, "Kb": 0.022, "Kt": 0.022, "J": 8.4e-6, "f": 6e-6}
    plant, rng, runs = (Plant(**small, brush_V=0.85, brush_onset_A=0.12), np.random.default_rng(3), [])
    for name, volts in {"large": 10.0, "small": 2.5}.items():
        steps = np.repeat(rng.uniform(-volts, volts, 50), 40)
        excitation = vb.Excitation(1e-3 * np.arange(2000), steps, np.zeros(2000))
        columns = record(plant, excitation, rng, vb.Noise(0.003, 0.2), Bench({}))
        runs.append(recording(name, columns))

    def misfit(*effects: str) -> float:
        given = prepare(runs, (), unloaded=True, effects=[EFFECTS[e] for e in effects])
        return electrical_misfit(model_of(solve(given, "cma_es", 0).fitted))

    assert misfit() > MAX_ELECTRICAL
    assert misfit("brush_voltage_drop") < 1.2


@pytest.mark.usefixtures("x64")
def test_coloured_noise_of_the_current_is_no_electrical_misfit():
    """As of an averaging converter: without the colour that all runs have in common it would be 1.45."""
    rng, runs = np.random.default_rng(12), []
    for name, excitation in {"prbs": vb.prbs(rng, 3.0), "stairs": vb.staircase(3.0)}.items():
        columns = vb.record(vb.BenchMotor(**PAPER), excitation, rng, vb.Noise(0.0, 0.5))
        columns["current_A"] += lfilter([0.08], [1.0, -0.9], rng.standard_normal(len(excitation.time)))
        runs.append(recording(name, columns))
    solved = solve(prepare(runs, (), unloaded=True), "cma_es", 0)
    assert electrical_misfit(model_of(solved.fitted)) < 1.1
