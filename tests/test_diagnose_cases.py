"""Whole diagnoses: what is hidden by a simulator of its own is named, and nothing else is."""

from __future__ import annotations

from importlib import resources

import attrs
import numpy as np
import pytest

from benchmarks import virtual_bench as vb
from benchmarks.naming.cases import Bench, record
from benchmarks.naming.plant import Plant
from pmdc_jax import Recording
from pmdc_jax.diagnose import diagnose
from pmdc_jax.motor import PARAMETERS
from pmdc_jax.recording_file import read_recording

PAPER = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
QUANTITIES, LOAD = ("time_s", "voltage_V", "current_A", "speed_rad_s"), "load_torque_Nm"


def recorded(motor: vb.BenchMotor, seed: int, noise: vb.Noise) -> list[Recording]:
    """Three short runs of the virtual bench, which shares no code with the package."""
    rng = np.random.default_rng(seed)
    excitations = {
        "prbs": vb.prbs(rng, 2.0),
        "triangle": vb.slow_triangle(2.0),
        "loaded": vb.loaded(rng, 2.0),
    }
    found = []
    for name, excitation in excitations.items():
        columns = vb.record(motor, excitation, rng, noise)
        found.append(Recording(name, *(columns[q] for q in QUANTITIES), load=columns[LOAD]))
    return found


NOISE = vb.Noise(current_A=0.1, speed_rad_s=0.5)
SHAKEN = vb.Noise(current_A=0.1, speed_rad_s=0.5, torque_Nm=0.01, torque_correlation_s=0.02)


@pytest.mark.slow
def test_a_simulation_without_noise_lacks_nothing():
    """Two simulators differ by far less than any sensor, and by far more than nothing."""
    held_out, *training = recorded(vb.BenchMotor(**PAPER), 4, vb.Noise(0.0, 0.0))
    found = diagnose(training, [held_out])
    assert found.verdict == "none_detected"
    for name in ("R", "L", "Kb", "Kt", "J", "f"):
        assert found.final.parameters[name].value == pytest.approx(PAPER[name], rel=1e-3)


@pytest.mark.parametrize(
    "noise",
    [pytest.param(NOISE, marks=pytest.mark.slow), SHAKEN],
    ids=["white", "coloured"],
)
def test_hidden_friction_is_named_and_closes_the_gap(noise):
    truth = vb.BenchMotor(**PAPER, coulomb_Nm=0.08)
    # the loaded run is among those fitted: without a known load only ratios of torques are seen
    held_out, *training = recorded(truth, 4, noise)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert (effect.name, effect.equation) == ("coulomb_friction", "mechanical")
    low, high = effect.parameters["torque_Nm"].ci95
    # torque noise of 0.01 N m that lasts 0.02 s leaves a mean over 4 s uncertain by 0.001 N m, and the
    # friction shares what it explains with f: a few times that
    assert low < 0.08 < high < low + (0.006 if noise is NOISE else 0.015)
    assert effect.p_value < 1e-6
    assert found.closed_fraction > 0.99
    assert any(r.equation == "mechanical" and r.variable == "speed" for r in found.where)
    (friction,) = found.final.motor.effects
    # one is the exponential of JAX, the other that of NumPy
    assert float(friction.torque_Nm) == pytest.approx(effect.parameters["torque_Nm"].value, 1e-14)
    # the motor without friction had bought some of it with viscous friction
    assert found.base.parameters["f"].value > found.final.parameters["f"].value


@pytest.mark.slow
def test_friction_is_named_where_no_run_has_a_load():
    """A peak of friction is ruled out there, too, although the scale of all torques is not seen."""
    runs = recorded(vb.BenchMotor(**PAPER, coulomb_Nm=0.08), 4, NOISE)
    found = diagnose([run for run in runs if run.name != "loaded"], unloaded=True)
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert found.final.parameters["Kt"].status == "not_identifiable"


@pytest.mark.parametrize("noise", [NOISE, SHAKEN], ids=["white", "coloured"])
def test_nothing_is_found_where_nothing_is_missing(noise):
    found = diagnose(recorded(vb.BenchMotor(**PAPER), 5, noise))
    assert found.verdict == "none_detected"
    assert found.effects == ()
    assert found.final.motor.effects == ()
    for name, estimate in found.final.parameters.items():  # fitted to white residuals
        assert estimate.stderr < 1.2 * found.base.parameters[name].stderr, name
    by_name = {d.effect: d for d in found.detectable}
    assert 0 < by_name["coulomb_friction"].amplitude < 0.05


@pytest.mark.parametrize("periods", [1, pytest.param(14, marks=pytest.mark.slow)])
def test_a_swinging_speed_reading_is_no_torque(periods):
    """An encoder off its centre, and the ripple of a tachometer, swing with the angle as cogging does."""
    runs = []
    for run in recorded(vb.BenchMotor(**PAPER), 6, NOISE):
        angle = np.append(0, np.cumsum((run.speed[1:] + run.speed[:-1]) / 2 * np.diff(run.time)))
        swinging = run.speed * (1 + 0.02 * np.cos(periods * angle))
        runs.append(attrs.evolve(run, speed=swinging))
    found = diagnose(runs)
    assert found.verdict == "not_in_library"
    assert found.effects == ()
    clearest = found.curves[0]
    assert (clearest.equation, clearest.variable) == ("sensor", "angle")
    assert 2 * np.pi / clearest.x[-1] == pytest.approx(periods)
    assert np.max(np.abs(clearest.value)) == pytest.approx(0.02, rel=0.05)


@pytest.mark.slow
def test_a_voltage_recorded_by_ten_bits_hides_no_dead_zone():
    """Levels are off by half a bit each, which lasts as long as they do; the motor feels the real ones."""
    rng, bit, runs = np.random.default_rng(21), 48 / 1024, []
    for name, driven in {
        "staircase": vb.staircase(4.0, amplitude=13.3),
        "prbs": vb.prbs(rng, 4.0, amplitude=5.1, offset=5.1),
    }.items():
        columns = vb.record(vb.BenchMotor(**PAPER), driven, rng, vb.Noise(0.05, 0.2))
        columns["voltage_V"] = bit * np.trunc(columns["voltage_V"] / bit)
        runs.append(Recording(name, *(columns[q] for q in QUANTITIES), load=0 * driven.time))
    assert diagnose(runs).verdict == "none_detected"


@pytest.mark.slow
def test_a_constant_load_would_not_have_shown_beside_a_load_that_nobody_knows():
    """Nor Coulomb friction, of a motor that turns one way."""
    _, triangle, _ = recorded(vb.BenchMotor(**PAPER), 1, NOISE)
    run = attrs.evolve(triangle, load=None)
    visible = {d.effect for d in diagnose([run]).detectable}
    assert {"brush_voltage_drop", "quadratic_drag"} < visible
    assert not {"constant_load", "coulomb_friction"} & visible


@pytest.mark.slow
def test_the_packaged_sample_hides_a_dry_friction():
    """What the tour shows: 12 mN m, in torque noise."""
    folder = resources.files("pmdc_jax") / "sample"
    runs = [
        read_recording(folder / f"{n}.csv") for n in ("staircase", "prbs", "triangle", "loaded")
    ]
    found = diagnose(runs, [read_recording(folder / "drive.csv")])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.name == "coulomb_friction"
    assert effect.parameters["torque_Nm"].value == pytest.approx(0.012, rel=0.04)
    assert found.closed_fraction > 0.99


def recorded_from(plant: Plant, seed: int, noise: vb.Noise) -> list[Recording]:
    """Three runs of two seconds, in both directions."""
    rng = np.random.default_rng(seed)
    runs = []
    for name, excitation in {
        "prbs": vb.prbs(rng, 2.0),
        "triangle": vb.slow_triangle(2.0),
        "loaded": vb.loaded(rng, 2.0),
    }.items():
        columns = record(plant, excitation, rng, noise, Bench({}))
        runs.append(Recording(name, *(columns[q] for q in QUANTITIES), load=columns[LOAD]))
    return runs


@pytest.mark.slow
@pytest.mark.parametrize("peak", [1.0, 3.0], ids=["coulomb", "stribeck"])
def test_where_a_peak_of_friction_would_not_show_it_is_not_ruled_out(peak):
    """Friction so faint that it is hardly seen, with and without a peak of three times as much at rest."""
    faint = 0.0008
    plant = Plant(
        **PAPER,
        friction_forward_Nm=faint,
        friction_backward_Nm=faint,
        friction_excess_Nm=(peak - 1) * faint,
        stribeck_speed_rad_s=8.0,
    )
    held_out, *training = recorded_from(plant, 9, NOISE)
    found = diagnose(training, [held_out])
    assert found.verdict == "ambiguous"
    (effect,) = found.effects
    assert (effect.name, effect.also_possible) == ("coulomb_friction", ("stribeck_friction",))
    assert found.next_experiment is not None


@pytest.mark.slow
def test_a_faint_effect_beside_a_strong_one_is_named():
    """A dead zone explains hundreds of times as much, but leaves nothing in the mechanical equation."""
    dry = 0.008
    plant = Plant(**PAPER, dead_zone_V=1.0, friction_forward_Nm=dry, friction_backward_Nm=dry)
    held_out, *training = recorded_from(plant, 12, NOISE)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    by_name = {effect.name: effect for effect in found.effects}
    assert set(by_name) == {"input_dead_zone", "coulomb_friction"}
    low, high = by_name["coulomb_friction"].parameters["torque_Nm"].ci95
    assert low < dry < high < 1.1 * low


@pytest.mark.slow
def test_drag_beside_dry_friction_is_no_stribeck_friction():
    """The slope of a Stribeck curve and more viscous friction bend together as drag does."""
    plant = Plant(**PAPER, friction_forward_Nm=0.12, friction_backward_Nm=0.12, drag=2.7e-6)
    held_out, *training = recorded_from(plant, 14, SHAKEN)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    assert {effect.name for effect in found.effects} == {"coulomb_friction", "quadratic_drag"}


@pytest.mark.slow
def test_what_is_one_volt_in_the_given_runs_is_not_told_apart():
    """A dead zone beside a delay, turning one way, without a current: dry friction and a load would do the same."""
    plant = Plant(**PAPER, dead_zone_V=1.0, delay_s=0.01)
    rng, runs = np.random.default_rng(13), []
    for name in ("first", "second", "third"):
        excitation = vb.prbs(rng, 2.0, offset=12.0, hold=0.03)
        columns = record(plant, excitation, rng, NOISE, Bench({}))
        time, volts, _, speed = (columns[q] for q in QUANTITIES)
        runs.append(Recording(name, time, volts, speed=speed))
    found = diagnose(runs[:2], runs[2:], unloaded=True)
    assert found.verdict == "ambiguous"
    chosen = {effect.name for effect in found.effects}
    sets = [chosen, *(set(rival.split(" + ")) for rival in found.effects[0].also_possible)]
    for same in ("input_dead_zone", "coulomb_friction", "constant_load"):
        assert {same, "speed_sensor_delay"} in sets
    assert found.closed_fraction > 0.99


@pytest.mark.slow
def test_a_rotor_that_sticks_for_long_is_found_by_searching_anew():
    """One short staircase under load: the best motor without friction is so far off that no response to first order
    shows what is missing."""
    motor = {"R": 0.956, "L": 2.84e-4, "Kb": 0.01145, "Kt": 0.01153, "J": 8.18e-6, "f": 3.93e-6}
    dry, peak, speed = 3.08e-3, 7.38e-3, 15.7
    plant = Plant(
        **motor,
        friction_forward_Nm=dry,
        friction_backward_Nm=dry,
        friction_excess_Nm=peak - dry,
        stribeck_speed_rad_s=speed,
    )
    rng, excitation = np.random.default_rng(15), vb.staircase(2.4, dt=5e-4, amplitude=4.8)
    load = np.repeat(rng.uniform(-0.018, 0.018, 10), len(excitation.time) // 10)
    noise = vb.Noise(current_A=0.019, speed_rad_s=1.05)
    columns = record(plant, excitation._replace(load=load), rng, noise, Bench({}))
    found = diagnose(
        [Recording("staircase", *(columns[q] for q in QUANTITIES), load=columns[LOAD])]
    )
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.name == "stribeck_friction"
    for field, truth in {"coulomb_Nm": dry, "static_Nm": peak, "speed_rad_s": speed}.items():
        assert effect.parameters[field].value == pytest.approx(truth, rel=0.02)


@pytest.mark.slow
def test_a_load_that_is_larger_than_friction_drives_the_motor_backwards():
    """As a hoist at rest: a friction that is none in one direction comes near, and a filter of so short runs takes for
    noise what it leaves."""
    motor = {"R": 4.0, "L": 2e-3, "Kb": 0.012, "Kt": 0.012, "J": 1e-6, "f": 1.5e-6}
    dry, weight = 3e-3, 4e-3
    plant = Plant(**motor, friction_forward_Nm=dry, friction_backward_Nm=dry, load_Nm=weight)
    rng, time, runs = np.random.default_rng(31), 0.01 * np.arange(600), []
    for name, voltage in {
        "steps": np.repeat(rng.choice([0.0, 3.6, 6.0, 8.4, 10.8], 24), 25),
        "ramp": np.interp(time, [0.0, 1.0, 4.0, 6.0], [0.0, 0.0, 10.8, 3.2]),
    }.items():
        excitation, bench = vb.Excitation(time, voltage, 0 * time), Bench({}, encoder_lines=256)
        columns = record(plant, excitation, rng, vb.Noise(0.01, 0.0), bench)
        runs.append(Recording(name, *(columns[q] for q in QUANTITIES)))
    found = diagnose(runs, unloaded=True, tie=[("Kt", "Kb")])
    assert found.verdict == "named"
    by_name = {effect.name: effect.parameters["torque_Nm"].value for effect in found.effects}
    assert by_name == pytest.approx({"coulomb_friction": dry, "constant_load": weight}, rel=0.01)
    assert found.final.missed == {}  # as much is left as encoder and current sensor make


@pytest.mark.slow
def test_a_bearing_that_seizes_is_no_coulomb_friction():
    """Torque noise is slow too, but does not turn with the direction of motion."""
    plant = Plant(**PAPER, seizing_Nm=0.04, seizing_from_s=1.0)
    found = diagnose(recorded_from(plant, 6, SHAKEN))
    assert found.verdict == "not_in_library"
    curve = found.curves[0]
    assert (curve.variable, curve.reverses) == ("time", True)
    early, late = curve.value[1:3], curve.value[4:6]
    assert late.mean() - early.mean() == pytest.approx(0.04, rel=0.3)


def test_a_weight_behind_a_gear_is_something_that_no_library_has():
    """It comes round once in 11.6 turns, as slowly as the noise of a fluctuating torque."""
    plant = Plant(**PAPER, eccentric_Nm=0.02, eccentric_gear=11.6, eccentric_phase=1.0)
    found = diagnose(recorded_from(plant, 6, NOISE))
    assert found.verdict == "not_in_library"
    assert {curve.variable for curve in found.curves[:1]} == {"angle"}
    turn = found.curves[0].x[-1] / (2 * np.pi)
    assert turn == pytest.approx(11.6, rel=0.2)
