"""The virtual bench against an adaptive solver, closed forms and conservation of energy; statistics of its noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks import virtual_bench as vb

HOT = {"copper_alpha_per_K": 0.0039, "thermal_resistance_K_per_W": 4.0, "thermal_time_s": 0.5}
SMOOTH = {
    "linear": {},
    "load": {"constant_load_Nm": 0.2},
    "brush": {"brush_drop_V": 0.8, "brush_onset_A": 2.0},
    "heating": HOT,
    "together": {"constant_load_Nm": 0.2, "brush_drop_V": 0.8, "brush_onset_A": 2.0} | HOT,
}


def adaptive_reference(motor, excitation, start):
    """solve_ivp at tight tolerances, restarted at every sample because the voltage jumps there."""

    def slope(_, x, v, load):
        i, w, temp = x
        R = motor.R * (1 + motor.copper_alpha_per_K * temp)
        drop = motor.brush_drop_V * np.tanh(i / motor.brush_onset_A) if motor.brush_drop_V else 0.0
        return [
            (v - R * i - motor.Kb * w - drop) / motor.L,
            (motor.Kt * i - motor.f * w - load - motor.constant_load_Nm) / motor.J,
            (motor.thermal_resistance_K_per_W * R * i**2 - temp) / motor.thermal_time_s,
        ]

    states = [np.array(start)]
    for t, v, load in zip(*(c[:-1] for c in excitation), strict=True):
        step = (t, t + excitation.time[1])
        tight = {"rtol": 1e-10, "atol": 1e-12}
        states.append(solve_ivp(slope, step, states[-1], args=(v, load), **tight).y[:, -1])
    return np.array(states)


@pytest.mark.parametrize("effects", SMOOTH.values(), ids=SMOOTH.keys())
@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_agrees_with_the_adaptive_reference(effects, dt):
    rng = np.random.default_rng(1)
    motor = replace(vb.paper_motor(), **effects)
    excitation = vb.loaded(rng, duration=60 * dt, dt=dt, hold=7 * dt)
    start = (3.0, -20.0, 0.0)
    expected = adaptive_reference(motor, excitation, start)
    error = np.abs(vb.simulate(motor, excitation, start) - expected).max(0)
    assert np.all(error < 1e-7 * (1 + np.abs(expected).max(0)))


def coasting_motor():
    """A brush drop above the back-EMF opens the circuit, so only friction acts on the rotor."""
    return replace(vb.paper_motor(), brush_drop_V=5.0, coulomb_Nm=0.05)


def test_coasting_matches_the_closed_form_and_ends_in_exact_standstill():
    motor, time = coasting_motor(), np.arange(800) * 1e-3
    rest = vb.Excitation(time, 0 * time, 0 * time)
    current, speed, _ = vb.simulate(motor, rest, start=(0.0, 50.0, 0.0)).T
    pull = motor.coulomb_Nm / motor.f
    expected = (50.0 + pull) * np.exp(-motor.f / motor.J * time) - pull
    moving = expected > 0
    assert 300 < moving.sum() < 600
    np.testing.assert_allclose(speed[moving], expected[moving], rtol=1e-9, atol=1e-9)
    assert np.all(speed[~moving] == 0)
    assert np.all(current == 0)


def test_breaks_away_exactly_at_the_friction_torque():
    motor = replace(vb.paper_motor(), coulomb_Nm=0.1)
    time = np.arange(2000) * 1e-3
    ramp = vb.Excitation(time, 0.5 * time, 0 * time)
    current, speed, _ = vb.simulate(motor, ramp).T
    first = np.flatnonzero(speed)[0]
    assert motor.Kt * current[first - 1] <= motor.coulomb_Nm < motor.Kt * current[first]
    assert np.all(speed[first:] > 0)


def test_a_constant_load_moves_the_rotor_only_beyond_friction():
    motor, time = replace(vb.paper_motor(), coulomb_Nm=0.1), np.arange(100) * 1e-3
    for load, moves in ((0.0999, False), (-0.0999, False), (0.1001, True), (-0.1001, True)):
        speed = vb.simulate(motor, vb.Excitation(time, 0 * time, load + 0 * time))[:, 1]
        assert np.any(speed != 0) == moves
        assert np.all(speed * load <= 0)


def test_conserves_energy():
    """Supply work is stored energy, copper heat, and work against damping, friction and load."""
    motor = replace(vb.paper_motor(), coulomb_Nm=0.1, Kt=0.0492)
    dt = 1e-5
    excitation = vb.loaded(np.random.default_rng(3), duration=0.4, dt=dt, hold=0.1)
    i, w, _ = vb.simulate(motor, excitation).T

    def spent(power_before, power_after):
        return dt * float((power_before + power_after).sum()) / 2

    v, load = excitation.voltage[:-1], excitation.load[:-1]  # held over each step
    supplied = spent(v * i[:-1], v * i[1:])
    lost = motor.R * i**2 + motor.f * w**2 + motor.coulomb_Nm * np.abs(w)
    dissipated = spent(lost[:-1], lost[1:]) + spent(load * w[:-1], load * w[1:])
    stored = 0.5 * (motor.L * i[-1] ** 2 + motor.J * w[-1] ** 2)
    assert supplied == pytest.approx(dissipated + stored, rel=1e-5)


def test_sensor_noise_is_white_with_the_requested_deviation():
    noise = vb.Noise(current_A=0.2, speed_rad_s=0.7)
    excitation = vb.staircase()
    columns = vb.record(vb.paper_motor(), excitation, np.random.default_rng(4), noise)
    truth = vb.simulate(vb.paper_motor(), excitation)
    residuals = columns["current_A"] - truth[:, 0], columns["speed_rad_s"] - truth[:, 1]
    for residual, sd in zip(residuals, (0.2, 0.7), strict=True):
        assert residual.std() == pytest.approx(sd, rel=0.04)
        assert abs(np.corrcoef(residual[1:], residual[:-1])[0, 1]) < 0.05


def test_torque_noise_has_the_requested_deviation_and_correlation_time():
    noise = vb.Noise(torque_Nm=0.03, torque_correlation_s=0.02)
    excitation = vb.staircase(duration=40.0, dt=1e-2)
    torque = vb.torque_noise(vb.paper_motor(), excitation, np.random.default_rng(5), noise)
    assert torque.std() == pytest.approx(0.03, rel=0.06)
    sampled = torque[:, 0]
    assert np.corrcoef(sampled[2:], sampled[:-2])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)


def test_speed_is_quantised():
    noise = vb.Noise(speed_quantum_rad_s=0.5)
    columns = vb.record(vb.paper_motor(), vb.staircase(), np.random.default_rng(6), noise)
    assert np.all(columns["speed_rad_s"] % 0.5 == 0)


def test_standard_runs_are_reproducible_and_have_33_000_samples():
    for all_at_1_ms in (False, True):
        first, second = (vb.standard_runs(np.random.default_rng(7), all_at_1_ms=all_at_1_ms) for _ in range(2))
        assert len(first) == 7
        assert sum(c["time_s"].size for c in first.values()) == 33_000
        for name in first:
            for column in first[name]:
                np.testing.assert_array_equal(first[name][column], second[name][column])


def test_the_csv_file_holds_the_recorded_columns(tmp_path):
    excitation = vb.staircase(duration=0.1)
    columns = vb.record(vb.paper_motor(), excitation, np.random.default_rng(8))
    vb.write_csv(tmp_path / "run.csv", columns)
    header = (tmp_path / "run.csv").read_text().splitlines()[0]
    assert header == "time_s,voltage_V,current_A,speed_rad_s,load_torque_Nm"
    table = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table, np.column_stack(list(columns.values())), atol=1e-8)
