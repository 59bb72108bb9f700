"""Complete diagnoses of runs from independent simulators: the hidden effects are named, and no others."""

from __future__ import annotations

from importlib import resources

import attrs
import numpy as np
import pytest
from linear_motor import PAPER
from scipy import signal

from benchmarks import virtual_bench as vb
from benchmarks.naming.cases import Bench, record
from benchmarks.naming.plant import Plant
from experiments.bench import recording
from pmdc_jax import Recording
from pmdc_jax.diagnose import Diagnosis, diagnose
from pmdc_jax.recordings.recording_file import read_recording
from pmdc_jax.report.diagnosis.sentences import verdict_sentences


def excitations(rng: np.random.Generator) -> dict[str, vb.Excitation]:
    """Three short runs, in both directions."""
    return {"prbs": vb.prbs(rng, 2.0), "triangle": vb.slow_triangle(2.0), "loaded": vb.loaded(rng, 2.0)}


def recorded(motor: vb.BenchMotor, seed: int, noise: vb.Noise) -> list[Recording]:
    """Runs of the virtual bench, which shares no code with the package."""
    rng = np.random.default_rng(seed)
    return [recording(name, vb.record(motor, excitation, rng, noise)) for name, excitation in excitations(rng).items()]


NOISE = vb.Noise(current_A=0.1, speed_rad_s=0.5)
QUIET = vb.Noise(current_A=0.012, speed_rad_s=0.2)
WITH_TORQUE_NOISE = vb.Noise(current_A=0.1, speed_rad_s=0.5, torque_Nm=0.01, torque_correlation_s=0.02)


@pytest.mark.slow
def test_a_noise_free_simulation_has_no_missing_effect():
    """The difference of two simulators is far smaller than any sensor noise, but significant without noise."""
    held_out, *training = recorded(vb.BenchMotor(**PAPER), 4, vb.Noise(0.0, 0.0))
    found = diagnose(training, [held_out])
    assert found.verdict == "none_detected"
    for name in ("R", "L", "Kb", "Kt", "J", "f"):
        assert found.final.parameters[name].value == pytest.approx(PAPER[name], rel=1e-3)


@pytest.mark.parametrize(
    "noise", [pytest.param(NOISE, marks=pytest.mark.slow), WITH_TORQUE_NOISE], ids=["white", "coloured"]
)
def test_hidden_friction_is_named_and_closes_the_gap(noise):
    truth = vb.BenchMotor(**PAPER, coulomb_Nm=0.08)
    # the loaded run is a training run: without a known load only ratios of torques are identifiable
    held_out, *training = recorded(truth, 4, noise)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert (effect.name, effect.equation) == ("coulomb_friction", "mechanical")
    low, high = effect.parameters["torque_Nm"].ci95
    # torque noise of 0.01 N m with a correlation time of 0.02 s makes a mean over 4 s uncertain by 0.001 N m;
    # correlation with f makes the friction uncertain by a few times that
    assert low < 0.08 < high < low + (0.006 if noise is NOISE else 0.015)
    assert effect.p_value < 1e-6
    assert found.closed_fraction > 0.99
    assert any(r.equation == "mechanical" and r.variable == "speed" for r in found.where)
    (friction,) = found.final.motor.effects
    # exponentiated by JAX in one and by NumPy in the other
    assert float(friction.torque_Nm) == pytest.approx(effect.parameters["torque_Nm"].value, 1e-14)
    # without it, viscous friction compensated for some of it
    assert found.base.parameters["f"].value > found.final.parameters["f"].value


@pytest.mark.slow
def test_heating_is_named_although_a_run_begins_warm():
    """With all runs cold at the start, heating would leave twice the noise in the current of one of them."""
    truth = vb.BenchMotor(**PAPER, copper_alpha_per_K=0.00393, thermal_resistance_K_per_W=0.3, thermal_time_s=2.0)
    rng = np.random.default_rng(29)
    runs = [
        recording(name, vb.record(truth, excitation, rng, NOISE, (0.0, 0.0, warmer_K)))
        for (name, excitation), warmer_K in zip(excitations(rng).items(), (0.0, 25.0, 5.0), strict=True)
    ]
    found = diagnose(runs)
    assert found.verdict == "named"
    assert [e.name for e in found.effects] == ["resistance_heating"]
    assert found.closed_fraction > 0.99
    R = found.final.parameters["R"]
    assert abs(R.value - PAPER["R"]) < 3 * R.stderr < 0.05 * PAPER["R"]
    (message,) = [m for m in found.final.messages if "warm" in m]
    assert "triangle by 9" in message or "triangle by 10" in message


@pytest.mark.slow
def test_friction_is_named_without_a_known_load():
    """Stribeck friction is ruled out as well, although the scale of all torques is not identifiable."""
    runs = recorded(vb.BenchMotor(**PAPER, coulomb_Nm=0.08), 4, NOISE)
    found = diagnose([run for run in runs if run.name != "loaded"], unloaded=True)
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert found.final.parameters["Kt"].status == "not_identifiable"


@pytest.mark.parametrize("noise", [NOISE, WITH_TORQUE_NOISE], ids=["white", "coloured"])
def test_no_effect_is_named_if_none_is_missing(noise):
    found = diagnose(recorded(vb.BenchMotor(**PAPER), 5, noise))
    assert found.verdict == "none_detected"
    assert found.effects == ()
    assert found.final.motor.effects == ()
    for name, estimate in found.final.parameters.items():  # fitted to whitened residuals
        assert estimate.stderr < 1.2 * found.base.parameters[name].stderr, name
    by_name = {d.effect: d for d in found.detectable}
    assert 0 < by_name["coulomb_friction"].amplitude < 0.05


def with_ripple(run: Recording, share: float, periods: int) -> Recording:
    """The run with a speed reading that varies with the angle, by a share of the speed."""
    angle = np.append(0, np.cumsum((run.speed[1:] + run.speed[:-1]) / 2 * np.diff(run.time)))
    return attrs.evolve(run, speed=run.speed * (1 + share * np.cos(periods * angle)))


def sensor_ripple_of(found: Diagnosis) -> tuple[float, float]:
    """Share of the speed and periods per turn of the clearest unknown term, which is the speed sensor's."""
    clearest = found.curves[0]
    assert (clearest.equation, clearest.variable) == ("sensor", "angle")
    return float(np.max(np.abs(clearest.value))), 2 * np.pi / clearest.x[-1]


@pytest.mark.slow
@pytest.mark.parametrize("periods", [1, 14])
def test_an_error_of_the_speed_over_the_angle_is_attributed_to_the_sensor(periods):
    """Eccentricity of an encoder and ripple of a tachometer vary with the angle as cogging does."""
    runs = recorded(vb.BenchMotor(**PAPER), 6, NOISE)
    found = diagnose([with_ripple(run, 0.02, periods) for run in runs])
    assert found.verdict == "not_in_library"
    assert found.effects == ()
    assert sensor_ripple_of(found) == pytest.approx((0.02, periods), rel=0.05)


def test_a_ripple_of_the_speed_sensor_far_below_its_noise_is_told_but_is_no_missing_effect():
    runs = recorded(vb.BenchMotor(**PAPER), 6, NOISE)
    found = diagnose([with_ripple(run, 0.001, 14) for run in runs])
    assert found.verdict == "none_detected"
    assert sensor_ripple_of(found) == pytest.approx((0.001, 14), rel=0.1)
    assert any("tachometer ripple" in sentence for sentence in verdict_sentences(found))


@pytest.mark.slow
def test_an_inertia_that_varies_with_the_angle_is_no_sensor_ripple():
    """A crank: J(angle) dw/dt = Kt i - f w - J'(angle) w**2 / 2, in steps of a twentieth of a sample."""
    rng, runs = np.random.default_rng(12), []
    for name, sine in (("steps", False), ("triangle", True)):
        time = 4e-3 * np.arange(1000)
        triangle = 20 * signal.sawtooth(2 * np.pi * time / 2, 0.5)
        voltage = triangle if sine else np.repeat(rng.uniform(-24, 24, 10), 100)
        i, w, angle, current, speed = 0.0, 0.0, 0.0, [], []
        for v in voltage:
            current.append(i)
            speed.append(w)
            for _ in range(20):
                step, wave = 2e-4, 2 * angle + 0.7
                J, dJ = 9e-4 * (1 + 0.22 * np.cos(wave)), -9e-4 * 0.44 * np.sin(wave)
                dw = (0.12 * i - 2e-4 * w - dJ * w**2 / 2) / J
                i += step * (v - 0.7 * i - 0.12 * w) / 1.2e-3
                w += step * dw
                angle += step * w
        noise = rng.standard_normal((2, 1000))
        runs.append(Recording(name, time, voltage, current + 0.05 * noise[0], speed + 0.3 * noise[1]))
    found = diagnose(runs, unloaded=True)
    assert found.verdict == "not_in_library"
    assert not any("tachometer ripple" in sentence for sentence in verdict_sentences(found))


@pytest.mark.slow
def test_a_ripple_of_the_speed_sensor_hides_no_friction():
    runs = recorded(vb.BenchMotor(**PAPER, coulomb_Nm=0.08), 6, NOISE)
    found = diagnose([with_ripple(run, 0.01, 14) for run in runs])
    (effect,) = found.effects
    assert effect.name == "coulomb_friction"
    assert effect.parameters["torque_Nm"].value == pytest.approx(0.08, rel=0.01)
    assert sensor_ripple_of(found) == pytest.approx((0.01, 14), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("coulomb_Nm", [0.0, 0.08])
def test_a_current_that_is_read_late_is_no_shaft(coulomb_Nm):
    """An RC filter before the converter: the motor then seems to respond before its current, like a shaft with so much
    damping that it could not ring."""
    runs, lag = [], 4e-4
    for run in recorded(vb.BenchMotor(**PAPER, coulomb_Nm=coulomb_Nm), 7, NOISE):
        decay = np.exp(-(run.time[1] - run.time[0]) / lag)
        late = signal.lfilter([1 - decay], [1, -decay], run.current)
        runs.append(attrs.evolve(run, current=late))
    found = diagnose(runs)
    names = {effect.name for effect in found.effects}
    assert "shaft_compliance" not in names
    assert names == ({"coulomb_friction"} if coulomb_Nm else set())
    assert found.verdict == ("named" if coulomb_Nm else "not_in_library")
    clearest = found.curves[0]
    assert (clearest.equation, clearest.variable) == ("sensor", "current_rate")
    # the mean age of the samples in the filter's output
    late = -clearest.value[-1] / clearest.x[-1]
    assert late == pytest.approx(1e-3 * decay / (1 - decay), rel=0.1)


def by_euler_steps(run: Recording, steps: int, rng: np.random.Generator) -> Recording:
    """The run by an explicit Euler simulation of the linear motor, with so many steps per sample."""
    R, L, Kb, Kt, J, f = (PAPER[name] for name in ("R", "L", "Kb", "Kt", "J", "f"))
    h = (run.time[1] - run.time[0]) / steps
    step = np.eye(2) + h * np.array([[-R / L, -Kb / L], [Kt / J, -f / J]])
    gain = h * np.diag([1 / L, -1 / J])
    gain_of_sample = sum(np.linalg.matrix_power(step, k) for k in range(steps)) @ gain
    system = (np.linalg.matrix_power(step, steps), gain_of_sample, np.eye(2), np.zeros((2, 2)), 1)
    inputs = np.stack([run.voltage, run.load], axis=1)
    current, speed = (signal.dlsim(system, inputs)[1] + rng.normal(0, (0.1, 0.5), inputs.shape)).T
    return attrs.evolve(run, current=current, speed=speed)


def test_the_steps_of_a_simple_simulator_are_no_effect():
    """Explicit Euler steps of a tenth of a sample make the speed half a step late, which is clear but means nothing."""
    rng = np.random.default_rng(39)
    runs = [by_euler_steps(run, 10, rng) for run in recorded(vb.BenchMotor(**PAPER), 8, NOISE)]
    assert diagnose(runs).verdict == "none_detected"


@pytest.mark.slow
def test_a_voltage_quantised_to_ten_bits_is_not_diagnosed_as_a_dead_zone():
    """Each level is off by up to half a bit for as long as it lasts; the motor is driven by the exact voltage."""
    rng, bit, runs = np.random.default_rng(21), 48 / 1024, []
    for name, driven in {
        "staircase": vb.staircase(4.0, amplitude=13.3),
        "prbs": vb.prbs(rng, 4.0, amplitude=5.1, offset=5.1),
    }.items():
        columns = vb.record(vb.BenchMotor(**PAPER), driven, rng, vb.Noise(0.05, 0.2))
        columns["voltage_V"] = bit * np.trunc(columns["voltage_V"] / bit)
        runs.append(recording(name, columns))
    assert diagnose(runs).verdict == "none_detected"


@pytest.mark.slow
def test_a_constant_load_is_not_detectable_beside_an_unknown_load():
    """Nor is Coulomb friction of a motor that turns in one direction."""
    _, triangle, _ = recorded(vb.BenchMotor(**PAPER), 1, NOISE)
    run = attrs.evolve(triangle, load=None)
    visible = {d.effect for d in diagnose([run]).detectable}
    assert {"brush_voltage_drop", "quadratic_drag"} < visible
    assert not {"constant_load", "coulomb_friction"} & visible


@pytest.mark.slow
def test_coulomb_friction_is_named_in_the_packaged_sample():
    """As in `pmdc demo`: 12 mN m, with torque noise."""
    folder = resources.files("pmdc_jax") / "sample"
    runs = [read_recording(folder / f"{n}.csv") for n in ("staircase", "prbs", "triangle", "loaded")]
    found = diagnose(runs, [read_recording(folder / "drive.csv")])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.name == "coulomb_friction"
    assert effect.parameters["torque_Nm"].value == pytest.approx(0.012, rel=0.04)
    assert found.closed_fraction > 0.99


def recorded_from(plant: Plant, seed: int, noise: vb.Noise) -> list[Recording]:
    """Runs of the naming benchmark's plant, which has more effects."""
    rng = np.random.default_rng(seed)
    return [
        recording(name, record(plant, excitation, rng, noise, Bench({})))
        for name, excitation in excitations(rng).items()
    ]


@pytest.mark.slow
@pytest.mark.parametrize("peak", [1.0, 3.0], ids=["coulomb", "stribeck"])
def test_stribeck_friction_too_weak_to_detect_remains_a_rival_of_coulomb_friction(peak):
    """Friction that is barely detectable, with and without a peak of three times as much at standstill."""
    weak = 0.0008
    plant = Plant(
        **PAPER,
        friction_forward_Nm=weak,
        friction_backward_Nm=weak,
        friction_excess_Nm=(peak - 1) * weak,
        stribeck_speed_rad_s=8.0,
    )
    held_out, *training = recorded_from(plant, 9, NOISE)
    found = diagnose(training, [held_out])
    assert found.verdict == "ambiguous"
    (effect,) = found.effects
    assert (effect.name, found.rivals) == ("coulomb_friction", (("stribeck_friction",),))
    assert found.next_experiment is not None


@pytest.mark.slow
def test_a_weak_effect_beside_a_strong_one_is_named():
    """A dead zone explains hundreds of times as much, but none of the misfit of the mechanical equation."""
    coulomb = 0.008
    plant = Plant(**PAPER, dead_zone_V=1.0, friction_forward_Nm=coulomb, friction_backward_Nm=coulomb)
    held_out, *training = recorded_from(plant, 12, NOISE)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    by_name = {effect.name: effect for effect in found.effects}
    assert set(by_name) == {"input_dead_zone", "coulomb_friction"}
    low, high = by_name["coulomb_friction"].parameters["torque_Nm"].ci95
    assert low < coulomb < high < 1.1 * low


@pytest.mark.slow
def test_three_effects_are_named_together():
    """Heating and the brush drop explain nearly all; the friction that makes the rotor stick is a small rest."""
    truth = vb.BenchMotor(
        **PAPER,
        coulomb_Nm=0.05,
        brush_drop_V=0.6,
        copper_alpha_per_K=0.00393,
        thermal_resistance_K_per_W=0.3,
        thermal_time_s=2.0,
    )
    found = diagnose(recorded(truth, 42, NOISE))
    assert found.verdict == "named"
    amplitudes = {
        "coulomb_friction": ("torque_Nm", 0.05),
        "brush_voltage_drop": ("voltage_V", 0.6),
        "resistance_heating": ("rise_per_W", 0.00393 * 0.3),
    }
    assert {effect.name for effect in found.effects} == set(amplitudes)
    for name, (field, true) in amplitudes.items():
        assert found.final.parameters[f"{name}.{field}"].value == pytest.approx(true, rel=0.05)


@pytest.mark.slow
def test_drag_and_coulomb_friction_are_not_named_stribeck_friction():
    """The slope of a Stribeck curve and more viscous friction together resemble drag."""
    plant = Plant(**PAPER, friction_forward_Nm=0.12, friction_backward_Nm=0.12, drag=2.7e-6)
    held_out, *training = recorded_from(plant, 14, WITH_TORQUE_NOISE)
    found = diagnose(training, [held_out])
    assert found.verdict == "named"
    assert {effect.name for effect in found.effects} == {"coulomb_friction", "quadratic_drag"}


@pytest.mark.slow
def test_effects_that_are_equivalent_in_the_given_runs_are_rivals():
    """A dead zone and a delay: in one direction and without a current, friction or a load do as the dead zone does."""
    plant = Plant(**PAPER, dead_zone_V=1.0, delay_s=0.01)
    rng, runs = np.random.default_rng(13), []
    for name in ("first", "second", "third"):
        excitation = vb.prbs(rng, 2.0, offset=12.0, hold=0.03)
        columns = record(plant, excitation, rng, NOISE, Bench({}))
        runs.append(attrs.evolve(recording(name, columns), current=None, load=None))
    found = diagnose(runs[:2], runs[2:], unloaded=True)
    assert found.verdict == "ambiguous"
    chosen = {effect.name for effect in found.effects}
    sets = [chosen, *map(set, found.rivals)]
    for equivalent in ("input_dead_zone", "coulomb_friction", "constant_load"):
        assert {equivalent, "speed_sensor_delay"} in sets
    assert found.closed_fraction > 0.99


@pytest.mark.slow
def test_stribeck_friction_of_a_rotor_that_sticks_for_long_is_named():
    """By a new search: in one short staircase under load the best fit without friction is so poor that the first-order
    response does not show what is missing."""
    motor = {"R": 0.956, "L": 2.84e-4, "Kb": 0.01145, "Kt": 0.01153, "J": 8.18e-6, "f": 3.93e-6}
    coulomb, peak, speed = 3.08e-3, 7.38e-3, 15.7
    plant = Plant(
        **motor,
        friction_forward_Nm=coulomb,
        friction_backward_Nm=coulomb,
        friction_excess_Nm=peak - coulomb,
        stribeck_speed_rad_s=speed,
    )
    rng, excitation = np.random.default_rng(15), vb.staircase(2.4, dt=5e-4, amplitude=4.8)
    load = np.repeat(rng.uniform(-0.018, 0.018, 10), len(excitation.time) // 10)
    noise = vb.Noise(current_A=0.019, speed_rad_s=1.05)
    columns = record(plant, excitation._replace(load=load), rng, noise, Bench({}))
    found = diagnose([recording("staircase", columns)])
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.name == "stribeck_friction"
    for field, truth in {"coulomb_Nm": coulomb, "static_Nm": peak, "speed_rad_s": speed}.items():
        assert effect.parameters[field].value == pytest.approx(truth, rel=0.02)


# Coulomb and static friction, N m, and Stribeck speed, rad/s
STICKING = (3.1e-3, 5.4e-3, 7.0)


def in_speed_loop(set_points: np.ndarray, rng: np.random.Generator) -> Recording:
    """A 20 W motor with Stribeck friction and a little torque noise in a PI loop, by implicit steps of 25 us."""
    R, L, K, J, f = 2.3, 3.5e-4, 0.0234, 5.6e-6, 5e-6
    coulomb, static, stribeck_speed = STICKING
    step, substeps, i, w, integral, torque, rows = 1e-3, 40, 0.0, 0.0, 0.0, 0.0, []
    h, decay = step / substeps, np.exp(-step / 0.02)
    for wanted in set_points:
        integral += (wanted - w) * step
        voltage = np.clip(0.03 * (wanted - w) + 0.6 * integral, -12.0, 12.0)
        rows.append((voltage, i, w))
        torque = decay * torque + 4e-5 * np.sqrt(1 - decay**2) * rng.standard_normal()
        for _ in range(substeps):
            i = (i + h * (voltage - K * w) / L) / (1 + h * R / L)
            free = w + h * (K * i - f * w - torque) / J
            friction = coulomb + (static - coulomb) * np.exp(-((w / stribeck_speed) ** 2))
            w = np.sign(free) * max(abs(free) - h * friction / J, 0.0)
    voltage, current, speed = np.array(rows).T
    current, speed = (x + size * rng.standard_normal(len(x)) for x, size in ((current, 8e-3), (speed, 0.15)))
    return Recording("loop", step * np.arange(len(speed)), voltage, current, speed, load=np.zeros(len(speed)))


@pytest.mark.slow
def test_friction_of_a_rotor_that_sticks_and_slips_in_a_speed_loop_is_named_alone():
    """Replayed in open loop, each moment at which it slips is an optimum of its own; a wrong one calls for effects that
    are not there."""
    runs = [
        attrs.evolve(in_speed_loop(np.repeat(levels, 500), np.random.default_rng(seed)), name=str(seed))
        for seed, levels in ((71, (3.0, -5.0, 8.0, -3.0, 12.0, 4.0)), (72, (40.0, -20.0, 5.0, -50.0, 10.0, 30.0)))
    ]
    (effect,) = diagnose(runs).effects
    assert effect.name == "stribeck_friction"
    for field, truth in zip(("coulomb_Nm", "static_Nm", "speed_rad_s"), STICKING, strict=True):
        assert effect.parameters[field].value == pytest.approx(truth, rel=0.1)


@pytest.mark.slow
def test_a_load_that_exceeds_friction_is_named_with_it():
    """A hoist, which such a load drives backwards. Friction in one direction only fits nearly as well, and a whitening
    filter estimated from such short runs takes the difference for noise."""
    motor = {"R": 4.0, "L": 2e-3, "Kb": 0.012, "Kt": 0.012, "J": 1e-6, "f": 1.5e-6}
    coulomb, weight = 3e-3, 4e-3
    plant = Plant(**motor, friction_forward_Nm=coulomb, friction_backward_Nm=coulomb, load_Nm=weight)
    rng, time, runs = np.random.default_rng(31), 0.01 * np.arange(600), []
    for name, voltage in {
        "steps": np.repeat(rng.choice([0.0, 3.6, 6.0, 8.4, 10.8], 24), 25),
        "ramp": np.interp(time, [0.0, 1.0, 4.0, 6.0], [0.0, 0.0, 10.8, 3.2]),
    }.items():
        excitation, bench = vb.Excitation(time, voltage, 0 * time), Bench({}, encoder_lines=256)
        columns = record(plant, excitation, rng, vb.Noise(0.01, 0.0), bench)
        runs.append(attrs.evolve(recording(name, columns), load=None))
    found = diagnose(runs, unloaded=True, tie=[("Kt", "Kb")])
    assert found.verdict == "named"
    by_name = {effect.name: effect.parameters["torque_Nm"].value for effect in found.effects}
    assert by_name == pytest.approx({"coulomb_friction": coulomb, "constant_load": weight}, rel=0.01)
    assert found.final.missed == {}  # the residuals are the noise of encoder and current sensor


@pytest.mark.slow
def test_a_seizing_bearing_is_not_named_coulomb_friction():
    """Torque noise is slow too, but does not reverse with the motion. A torque of 0.04 N m is just not significant."""
    plant = Plant(**PAPER, seizing_Nm=0.05, seizing_from_s=1.0)
    found = diagnose(recorded_from(plant, 6, WITH_TORQUE_NOISE))
    assert found.verdict == "not_in_library"
    curve = found.curves[0]
    assert (curve.variable, curve.reverses) == ("time", True)
    early, late = curve.value[1:3], curve.value[4:6]
    assert late.mean() - early.mean() == pytest.approx(0.05, rel=0.3)


@pytest.mark.slow
def test_an_eccentric_weight_behind_a_gear_is_not_in_the_library():
    """It turns once in 11.6 turns of the motor, as slowly as torque noise fluctuates."""
    plant = Plant(**PAPER, eccentric_Nm=0.02, eccentric_gear=11.6, eccentric_phase=1.0)
    found = diagnose(recorded_from(plant, 6, NOISE))
    assert found.verdict == "not_in_library"
    assert {curve.variable for curve in found.curves[:1]} == {"angle"}
    turn = found.curves[0].x[-1] / (2 * np.pi)
    assert turn == pytest.approx(11.6, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "factor", "friction"), [("Kb", 0.97, 0.0), ("R", 1.1, 0.08), ("J", 1.6, 0.0), ("f", 1.5, 0.0)]
)
def test_a_parameter_that_differs_in_one_run_is_told(name, factor, friction):
    """The residuals are far above the noise, but no term that the runs share explains them."""
    changed = {**PAPER, name: factor * PAPER[name]}
    one, other = (vb.BenchMotor(**m, coulomb_Nm=friction) for m in (PAPER, changed))
    driven = 2 if name != "J" else 0  # the loaded run determines all but the inertia
    apart = attrs.evolve(recorded(other, 5, NOISE)[driven], name="apart")
    found = diagnose([*recorded(one, 4, NOISE), apart])
    assert found.verdict == "not_in_library"
    assert [effect.name for effect in found.effects] == ["coulomb_friction"] * (friction > 0)
    assert found.varies is not None
    assert found.varies.name == name
    for run, one in found.varies.by_run.items():
        truth = (changed if run == "apart" else PAPER)[name]
        assert one.value == pytest.approx(truth, abs=4 * one.stderr)
        assert one.stderr < 0.01 * truth
    gap = found.gap_by_own_value["apart"]
    assert gap.before > 2.5
    assert gap.after == pytest.approx(1.0, abs=0.05)
    assert "is not the same in all runs" in " ".join(verdict_sentences(found))


@pytest.mark.slow
def test_a_timing_that_made_up_for_a_slow_sensor_is_given_up_with_it():
    """Slow sines: without the sensor's lag, voltages that act a sample late fit better than held ones; with it, no
    better."""
    motor = {"R": 0.9, "L": 2e-3, "Kb": 0.051, "Kt": 0.051, "J": 8.1e-4, "f": 4.2e-4}
    rng, runs, time = np.random.default_rng(16), [], 1e-2 * np.arange(4000)
    for name in ("first", "second", "held out"):
        tones = zip(rng.uniform(0.04, 0.6, 6), rng.uniform(0, 2 * np.pi, 6), strict=True)
        volts = 3 * sum(np.sin(2 * np.pi * f * time + phase) for f, phase in tones)
        excitation = vb.Excitation(time, volts, 0 * time)
        columns = record(Plant(**motor, lag_s=9e-3), excitation, rng, QUIET, Bench({}))
        runs.append(recording(name, columns))
    found = diagnose(runs[:2], runs[2:])
    assert {effect.name for effect in found.effects} <= {"speed_sensor_lag", "speed_sensor_delay"}
    assert found.closed_fraction > 0.99
    assert not any("voltage" in message for message in found.final.messages)
    L = found.final.parameters["L"]
    assert L.value == pytest.approx(2e-3, abs=3 * L.stderr)


@pytest.mark.slow
def test_friction_that_differs_in_one_run_is_told_where_only_ratios_of_torques_are_seen():
    """Without a load Kt, J and f are seen in proportion only; their values are those for Kt = Kb."""
    rng, runs = np.random.default_rng(17), []
    for name, factor in (("first", 1.0), ("second", 1.0), ("cold", 1.6)):
        motor = vb.BenchMotor(**PAPER | {"f": factor * PAPER["f"], "Kt": PAPER["Kb"]})
        columns = vb.record(motor, vb.prbs(rng, 4.0), rng, NOISE, load_known=False)
        runs.append(recording(name, columns))
    found = diagnose(runs, unloaded=True)
    assert (found.verdict, found.effects, found.varies.name) == ("not_in_library", (), "f")
    for name, one in found.varies.by_run.items():
        truth = PAPER["f"] * (1.6 if name == "cold" else 1.0)
        assert one.value == pytest.approx(truth, abs=4 * one.stderr)
        assert one.stderr < 0.05 * truth
