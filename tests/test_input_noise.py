"""Noise of a recorded voltage, removed where it did not act on the motor, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import identify
from pmdc_jax.identify.corrections.input_noise import denoised
from pmdc_jax.recordings.recording import Recording

NOISE = 0.1  # V


def steps(samples: int = 2000) -> np.ndarray:
    return np.repeat([0.0, 5.0, -12.0, 3.0, 3.5], samples // 5)


def wave(samples: int = 2000) -> np.ndarray:
    return 10.0 * np.sin(2 * np.pi * np.arange(samples) / 200)


# with a larger `CONFIDENCE_HALF_WIDTH` only a quarter of the noise remained on steps, but bends were rounded
@pytest.mark.parametrize(("signal", "remaining"), [(steps(), 0.27), (wave(), 0.6)], ids=["steps", "sine"])
def test_denoising_removes_noise_and_keeps_steps(signal, remaining):
    seen = signal + NOISE * np.random.default_rng(3).standard_normal(len(signal))
    error = denoised(seen) - signal
    assert np.std(error) < remaining * NOISE
    assert np.max(np.abs(error)) < 4.5 * NOISE  # nowhere near a step's height


@given(st.lists(st.floats(-48, 48), min_size=1, max_size=12), st.integers(9, 60), st.integers(0, 8))
def test_denoising_leaves_noise_free_steps_unchanged(levels, hold, cut):
    """Steps of any height, and any number of samples."""
    signal = np.repeat(levels, hold)[cut:]
    np.testing.assert_array_equal(denoised(signal), signal)


def recorded(applied_noise: float, sensor_noise: float) -> list[Recording]:
    """Runs with noise of the applied voltage and noise of the voltage sensor alone, V."""
    rng = np.random.default_rng(11)
    runs = {"prbs": vb.prbs(rng, 3.0), "loaded": vb.loaded(rng, 3.0), "stairs": vb.staircase(3.0)}
    found = []
    for name, excitation in runs.items():
        driven = excitation._replace(voltage=excitation.voltage + applied_noise * noise(rng, excitation))
        columns = vb.record(vb.paper_motor(), driven, rng, vb.Noise(0.1, 0.5))
        columns["voltage_V"] = columns["voltage_V"] + sensor_noise * noise(rng, excitation)
        found.append(recording(name, columns))
    return found


def noise(rng, excitation) -> np.ndarray:
    return rng.standard_normal(excitation.time.size)


def errors(found) -> np.ndarray:
    """Errors of the six parameters in standard errors."""
    truth = vb.paper_motor()
    return np.array([(found.parameters[n].value - getattr(truth, n)) / found.parameters[n].stderr for n in vb.SIX])


@pytest.mark.slow
def test_noise_of_the_voltage_sensor_does_not_bias_the_parameters():
    found = identify(recorded(applied_noise=0.0, sensor_noise=0.3))
    assert [m.split(":")[0] for m in found.messages if "did not reach the motor" in m] == [
        *("prbs", "loaded", "stairs")
    ]
    assert np.max(np.abs(errors(found))) < 3.5


def controlled_run(samples: int = 3000, step: float = 1e-3) -> Recording:
    """A run of a PI loop, whose voltage reacts to the noise of the measured speed; exact from sample to sample."""
    m, rng = vb.paper_motor(), np.random.default_rng(12)
    A = np.array([[-m.R / m.L, -m.Kb / m.L], [m.Kt / m.J, -m.f / m.J]])
    B = np.array([[1 / m.L], [0.0]])
    F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), step)
    wanted = np.repeat(rng.uniform(-300, 300, samples // 250), 250)
    state, rows, sum_of_errors = np.zeros(2), [], 0.0
    for k in range(samples):
        current, speed = state + rng.standard_normal(2) * [0.1, 0.5]
        sum_of_errors += (wanted[k] - speed) * step
        volts = 0.05 * (wanted[k] - speed) + sum_of_errors
        rows.append((volts, current, speed))
        state = F @ state + G[:, 0] * volts
    return Recording("controlled", step * np.arange(samples), *np.transpose(rows))


def test_a_held_out_voltage_of_a_control_loop_is_not_denoised():
    found = identify(recorded(applied_noise=0.0, sensor_noise=0.0), [controlled_run()])
    assert not [m for m in found.messages if "did not reach the motor" in m]
    assert found.fit["controlled"].current_rmse == pytest.approx(0.1, rel=0.05)


def test_noise_that_acted_on_the_motor_is_kept():
    found = identify(recorded(applied_noise=0.3, sensor_noise=0.0))
    assert not [m for m in found.messages if "did not reach the motor" in m]
    assert np.max(np.abs(errors(found))) < 3.5


def run_in_a_speed_loop() -> Recording:
    """A motor held at one speed after another against unmeasured loads by a PI loop, whose voltage reacts to the noise
    of the measured speed."""
    motor, rng, dt, substeps = vb.paper_motor(), np.random.default_rng(21), 1e-3, 20
    wanted = np.repeat(rng.uniform(-200.0, 200.0, 8), 750)
    load = np.repeat(rng.uniform(-0.2, 0.2, 16), 375)
    current = speed = integral = 0.0
    voltage, seen = np.empty(len(wanted)), np.empty((len(wanted), 2))
    for k in range(len(wanted)):
        seen[k] = current + 0.05 * rng.standard_normal(), speed + 0.3 * rng.standard_normal()
        error = wanted[k] - seen[k, 1]
        voltage[k] = np.clip(0.2 * error + 1.5 * integral, -24.0, 24.0)
        integral += error * dt * (abs(voltage[k]) < 24.0)
        for _ in range(substeps):
            current_rate = (voltage[k] - motor.R * current - motor.Kb * speed) / motor.L
            acceleration = (motor.Kt * current - motor.f * speed - load[k]) / motor.J
            current, speed = (current + current_rate * dt / substeps, speed + acceleration * dt / substeps)
    return Recording("loop", dt * np.arange(len(wanted)), voltage, *seen.T)


@pytest.mark.slow
def test_an_unknown_load_in_a_control_loop_is_not_taken_for_voltage_noise():
    found = identify([run_in_a_speed_loop()])
    assert not [m for m in found.messages if "did not reach the motor" in m]
