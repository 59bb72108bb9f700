"""Tuning: the tuned loop, specifications that are refused, and the report."""

from __future__ import annotations

import importlib
import json
import math
from functools import cache

import jax
import numpy as np
import pytest
from attrs import evolve
from linear_motor import PAPER

from pmdc_jax import InputError, cli, load_controller, load_uncertainty, save_motor, tune
from pmdc_jax.control.pipeline import robustness
from pmdc_jax.control.remarks import remarks
from pmdc_jax.control.specification import LoopRequirements
from pmdc_jax.control.tuning import Tuning
from pmdc_jax.effects import CoggingTorque, ShaftCompliance, SpeedSensorDelay
from pmdc_jax.motor import Motor
from pmdc_jax.report.notation import NARROW_SPACE
from pmdc_jax.report.tuning.figures import _range, loop_figure
from pmdc_jax.report.tuning.json import tuning_json
from pmdc_jax.report.tuning.page import write_tuning_report
from pmdc_jax.report.tuning.sentences import _current_sentence, summary

MOTOR = Motor(**{name: np.asarray(value) for name, value in PAPER.items()})


@cache
def example() -> Tuning:
    """A PID controller with samples of 1 ms and a delay of one sample, for motors with a spread of 5 %."""
    limits = {"voltage_limit": 30.0, "current_limit": 150.0}
    return tune(MOTOR, "pid", setpoint=481.0, **limits, speed_step=0.1, spread=0.05, starts=16)


@pytest.mark.slow
def test_the_tuned_loop_settles_nearly_as_fast_as_possible():
    found = example()
    assert found.metrics["SettlingTime"] < 1.25 * found.fastest_possible_settling
    assert found.metrics["Overshoot"] <= 1.0
    assert found.meets_specification
    assert found.margins.stable
    assert found.margins.sensitivity_peak < 2.1
    assert found.peak_current < 150 * 1.01
    assert abs(found.load["SteadyStateError"]) < 0.1
    second = found.tuned.second_step
    assert second["Overshoot"] < 3
    assert second["SettlingTime"] < found.fastest_possible_settling
    small = found.tuned.small_step
    assert 0.9 * 24.05 < small["Peak"] < 1.2 * 24.05
    mentioned = any("a small step of 24.1 rad/s" in message for message in found.messages)
    assert mentioned == (small["Overshoot"] > 1.2)


@pytest.mark.slow
def test_gains_are_tuned_against_the_noise_of_the_recordings():
    """At half a per cent of noise the voltage becomes several times quieter, and the step hardly slower."""
    limits = {"setpoint": 481.0, "voltage_limit": 30.0, "current_limit": 150.0, "starts": 16}
    silent, noisy = (tune(MOTOR, "pid", **limits, recorded_noise=noise) for noise in (None, 2.4))
    assert noisy.margins.voltage_per_noise < silent.margins.voltage_per_noise / 2
    assert noisy.metrics["SettlingTime"] < 1.1 * silent.metrics["SettlingTime"]
    assert silent.voltage_noise == 0
    # what the metrics are of is the motor, not the sensor
    assert not np.any(np.asarray(noisy.task.noise))
    assert any("2.40 rad/s of the speed sensor, as in the recordings" in s for s in summary(noisy))


@pytest.mark.slow
def test_the_tuned_loop_is_robust_over_drawn_motors():
    ours, textbook = example().tuned, example().textbook
    assert ours.robust.samples == 256
    assert ours.robust.Overshoot_p95 <= 1.0
    assert ours.robust.Overshoot_p95 < textbook.robust.Overshoot_p95
    assert ours.robust.SettlingTime_p95 < textbook.robust.SettlingTime_p95
    # the law limits the current of the nominal motor, not that of one with less resistance
    assert 1.0 < ours.robust.PeakCurrent_p95 / example().peak_current < 1.25
    again = robustness(example(), spread=0.05, seed=0)  # the same motors, later
    assert again.overshoot.tolist() == ours.robust.overshoot.tolist()


@pytest.mark.slow
def test_json_has_the_documented_keys(tmp_path):
    content = tuning_json(example())
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["controller"]["type"] == "pid"
    assert content["controller"]["sample_time_s"] == 1e-3
    assert content["controller"]["gains"]["proportional"] > 0
    assert content["limits"] == {"voltage_V": 30.0, "current_A": 150.0}
    assert set(content["metrics"]) == {
        "RiseTime",
        "SettlingTime",
        "Overshoot",
        "Undershoot",
        "Peak",
        "PeakTime",
        "SteadyStateError",
    }
    assert 0.04 < content["fastest_possible_settling_s"] < 0.05
    percentiles = {"Overshoot_p95", "SettlingTime_p95", "PeakCurrent_p95"}
    assert set(content["robust"]) == {"samples", *percentiles}


@pytest.mark.slow
def test_report_and_summary_state_the_result(tmp_path):
    found, path = example(), tmp_path / "report.html"
    write_tuning_report(found, path)
    page = path.read_text(encoding="utf-8")
    assert "http" not in page.split("<script>")[0].replace("http-equiv", "")
    assert page.count('class="plot"') == 2
    assert "Settling time" in page
    limits = [line.y[0] for line in loop_figure(found).data if line.name == "limit"]
    assert limits == [30, -30, 150, -150]
    text = " ".join(summary(found))
    assert "times the fastest possible with 30 V and 150 A (" in text
    assert "256 motors" in text


@pytest.mark.slow
def test_a_loop_that_misses_its_specification_is_reported():
    found = example()
    requirements = evolve(found.requirements, max_overshoot=0.0, max_settling=1e-3)
    missing = evolve(found, requirements=requirements)
    assert not missing.meets_specification
    slow = {**found.metrics, "SettlingTime": None}
    unsettled = evolve(found, tuned=evolve(found.tuned, metrics=slow))
    assert "does not settle" in summary(unsettled)[0]
    assert not unsettled.meets_specification
    unstable = evolve(found, tuned=evolve(found.tuned, margins=evolve(found.margins, stable=False)))
    assert not unstable.meets_specification
    assert any("unstable" in message for message in remarks(unstable, None))
    coarse = evolve(found, requirements=evolve(found.requirements, speed_step=0.05 * found.setpoint))
    assert any("wider than the settling band" in message for message in remarks(coarse, None))
    assert not any("wider than" in message for message in remarks(found, None))


@pytest.mark.slow
@pytest.mark.parametrize("measures_current", [True, False])
def test_a_current_limit_that_relies_on_the_back_emf_is_pointed_out(measures_current):
    """With a winding of 0.157 ohm, 20 A are 3 V: an eighth of the back-EMF at the set point."""
    limits = {"voltage_limit": 30.0, "current_limit": 20.0, "measures_current": measures_current}
    found = tune(MOTOR, "pi", setpoint=481.0, sample_time=1e-3, **limits, starts=8)
    assert any("relies on the back-EMF" in message for message in found.messages) != measures_current


@pytest.mark.slow
def test_a_loop_with_a_soft_shaft_settles_with_its_load():
    """The fastest settling of a rigid shaft is over within a quarter of its resonance."""
    shaft = ShaftCompliance(stiffness_Nm_rad=5.0, damping_Nms_rad=0.002, load_share=0.7)
    motor = Motor(R=1.0, L=0.002, Kb=0.3, Kt=0.3, J=0.002, f=0.001, effects=(shaft,))
    found = tune(motor, "pid", setpoint=100.0, voltage_limit=60.0, current_limit=20.0)
    assert found.meets_specification
    assert found.metrics["SettlingTime"] < 0.12
    assert found.margins.sensitivity_peak < 2.1


@pytest.mark.slow
def test_a_small_step_is_tuned_for_what_the_sampling_allows():
    """It would be over within a third of a sample."""
    found = tune(MOTOR, "pi", setpoint=2.0, voltage_limit=24.0, sample_time=1e-3, starts=16)
    assert found.fastest_possible_settling < 1e-3
    assert found.meets_specification
    assert found.margins.stable
    assert found.metrics["SettlingTime"] < 0.05


@pytest.mark.parametrize(("sample_time", "noted"), [(1e-3, False), (0.02, True)])
def test_slow_sampling_is_noted(sample_time, noted):
    requirements = LoopRequirements("pi", setpoint=481.0, voltage_limit=30.0, sample_time=sample_time)
    with jax.enable_x64(True):
        _, notes = requirements.task(MOTOR)
    assert any("takes 2.2 samples of 0.02 s" in note for note in notes) == noted


SLOW_EFFECTS = {
    # 20 delays of the sensor; two of the 12 periods in each turn, at half the set point
    "a late sensor": (SpeedSensorDelay(delay_s=0.02), 300.0, 0.4),
    "teeth": (CoggingTorque(amplitude_Nm=1e-3, phase_rad=0.0, periods=12.0), 5.0, 0.42),
}


@pytest.mark.parametrize(("effect", "setpoint", "least"), SLOW_EFFECTS.values(), ids=SLOW_EFFECTS.keys())
def test_a_loop_is_judged_for_as_long_as_its_effects_last(effect, setpoint, least):
    requirements = LoopRequirements("pi", setpoint, voltage_limit=30.0, sample_time=1e-3)
    with jax.enable_x64(True):
        plain, slow = (requirements.task(motor)[0] for motor in (MOTOR, MOTOR.with_effects([effect])))
    assert 1e-3 * slow.part_samples > least > 1e-3 * plain.part_samples


IMPOSSIBLE = {
    "voltage": (
        {"setpoint": 481.0, "voltage_limit": 24.0},
        "481 rad/s cannot be reached with 24 V (at most 480.0 rad/s)",
    ),
    "load": (
        {"setpoint": 481.0, "voltage_limit": 25.0, "load_torque": 1.0},
        "481 rad/s against 1 N·m cannot be reached with 25 V",
    ),
    "current": (
        {"setpoint": 481.0, "voltage_limit": 30.0, "current_limit": 2.0},
        "holding 481 rad/s takes 2.44 A, more than the limit of 2 A",
    ),
    "time": (
        {"setpoint": 481.0, "voltage_limit": 30.0, "max_settling": 0.04},
        "0.04 s is less than the fastest settling possible within the limits (0.0441 s)",
    ),
    "no speed": ({"setpoint": 0.0}, "0 is not a nonzero speed"),
    "negative voltage": ({"voltage_limit": -3.0}, "-3 is not a positive number"),
    "delay": ({"delay": 2}, "a delay of 2 samples is not supported"),
    "overshoot": ({"max_overshoot": math.nan}, "nan is not a number of at least 0"),
    "sampling": ({"setpoint": 481.0, "voltage_limit": 30.0, "sample_time": 1e-6}, "1e-06 s needs"),
    "milliseconds": (
        {"setpoint": 481.0, "voltage_limit": 30.0, "sample_time": 1.0},
        "1 s is far longer than the motor's transients, 0.0441 s",
    ),
    "spread": ({"spread": 5.0}, "a spread of 500 % is not between 0 and 100 %"),
    "controller": ({"controller": "fuzzy"}, "unknown controller 'fuzzy'"),
}


@pytest.mark.parametrize(("options", "expected"), IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_an_impossible_specification_is_refused_with_its_limit(options, expected):
    with pytest.raises(InputError) as refusal:
        tune(MOTOR, **options)
    assert expected in str(refusal.value)
    assert refusal.value.mend


@pytest.fixture
def motor_file(tmp_path, monkeypatch, no_terminal):
    save_motor(tmp_path / "motor.json", MOTOR)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_refuses_an_impossible_specification_in_one_line(motor_file, capsys):
    arguments = "tune motor.json --controller pid --setpoint 481 --voltage-limit 24"
    assert cli.main(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "481 rad/s cannot be reached with 24 V (at most 480.0 rad/s). Raise --voltage-limit" in err


@pytest.mark.parametrize(
    ("limit", "peak", "text"),
    [
        (8.0, 8.016, "The current reaches 8.016 A, 0.20 % above its limit"),
        (8.0, 8.001, ""),
        (8.0, 8.2, ""),  # a message says so
        (None, 8.0, ""),
    ],
)
def test_a_current_above_its_limit_is_stated(limit, peak, text):
    sentence = _current_sentence(peak, limit)
    assert sentence.replace(NARROW_SPACE, " ").startswith(text)
    assert bool(sentence) == bool(text)


def test_motors_that_hardly_differ_are_drawn_on_readable_axes():
    assert _range(np.full(9, 0.65), smallest=0.2) == pytest.approx([0.55, 0.75])
    assert _range(np.array([1.0, 2.0]), smallest=0.2) == pytest.approx([0.9, 2.1])
    assert _range(np.zeros(9), smallest=0.2) == pytest.approx([0.0, 0.1])
    assert _range(np.zeros(0), smallest=0.2) is None


def test_a_motor_file_is_accepted_with_its_noise(motor_file, monkeypatch):
    content = json.loads((motor_file / "motor.json").read_text()) | {"noise": {"speed_rad_s": 0.5}}
    (motor_file / "motor.json").write_text(json.dumps(content))

    def refuse(requirements, motor):
        raise InputError("asked", f"{requirements.recorded_noise} {motor.R}", "")

    monkeypatch.setattr(LoopRequirements, "task", refuse)
    with pytest.raises(InputError, match=f"asked: 0.5 {PAPER['R']}"):
        tune("motor.json", "pi")


@pytest.mark.slow
def test_the_command_writes_the_requested_files(motor_file, capsys, monkeypatch):
    given = {}

    def fake_tune(motor, controller, **options):
        given.update(motor=motor, controller=controller, **options)
        return example()

    monkeypatch.setattr(importlib.import_module("pmdc_jax.control.pipeline"), "tune", fake_tune)
    arguments = (
        "tune motor.json --controller pid --setpoint 481 --voltage-limit 30 --current-limit 60"
        " --sample-time 1e-3 --max-overshoot 0.5 --max-settling 0.2 --load-torque 0.3 --spread 10"
        " --no-current-sensor --save controller.json --json out.json --report report.html --seed 3"
    )
    assert cli.main(arguments.split()) == 0
    assert given["motor"].name == "motor.json"
    assert given["seed"] == 3
    assert given["controller"] == "pid"
    assert given["spread"] == pytest.approx(0.1)
    assert not given["measures_current"]
    assert (given["load_torque"], given["max_settling"]) == (0.3, 0.2)
    out, _ = capsys.readouterr()
    assert "PID controller" in out
    assert "fastest possible" in out
    assert json.loads((motor_file / "out.json").read_text()) == tuning_json(example())
    assert (motor_file / "report.html").stat().st_size > 1e6
    assert load_controller(motor_file / "controller.json").hardware.delay == 1
    assert cli.main(["export", "controller.json", "--c", "controller.h"]) == 0
    assert "pmdc_step" in (motor_file / "controller.h").read_text()


@pytest.mark.slow
def test_json_is_all_that_goes_to_standard_output(motor_file, capsys, monkeypatch):
    pipeline = importlib.import_module("pmdc_jax.control.pipeline")
    monkeypatch.setattr(pipeline, "tune", lambda *_, **__: example())
    assert cli.main(["tune", "motor.json", "--controller", "pid", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == tuning_json(example())


def test_the_uncertainty_of_a_motor_file_is_read(motor_file):
    assert load_uncertainty("motor.json") is None
    content = json.loads((motor_file / "motor.json").read_text())
    content["covariance"] = {"names": ["R", "J"], "matrix": [[1e-4, 0.0], [0.0, 4e-4]]}
    (motor_file / "motor.json").write_text(json.dumps(content))
    found = load_uncertainty("motor.json")
    assert (found.names, found.undetermined) == (("R", "J"), ())
    assert found.covariance.tolist() == [[1e-4, 0.0], [0.0, 4e-4]]
    content["status"] = {"R": "identified", "L": "at_bound", "Kt": "not_identifiable"}
    (motor_file / "motor.json").write_text(json.dumps(content))
    assert load_uncertainty("motor.json").undetermined == ("L", "Kt")
    for broken in ({"names": ["R"]}, {"names": ["Z"], "matrix": [[1.0]]}, 3, {"names": 1}):
        content["covariance"] = broken
        (motor_file / "motor.json").write_text(json.dumps(content))
        with pytest.raises(InputError, match="covariance"):
            load_uncertainty("motor.json")
