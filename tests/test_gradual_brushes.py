"""A brush drop that sets in gradually with the current: simulated, found where it is, and saved."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_motor import PAPER

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import diagnose, identify
from pmdc_jax.effects import BrushVoltageDrop, GradualBrushDrop, range_of
from pmdc_jax.motor import Motor
from pmdc_jax.motor_file import load_motor, save_motor
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.runtime.precision import double_precision
from pmdc_jax.simulate import Tape, free_run

NOISE = vb.Noise(0.1, 0.5)
BRUSHES = {"brush_drop_V": 1.0, "brush_onset_A": 4.0}


def recorded(noise: vb.Noise = NOISE, **brushes: float) -> list[Recording]:
    rng, motor = np.random.default_rng(51), vb.BenchMotor(**PAPER | brushes)
    runs = {"prbs": vb.prbs(rng, 3.0), "triangle": vb.slow_triangle(3.0), "loaded": vb.loaded(rng, 3.0)}
    return [recording(name, vb.record(motor, excitation, rng, noise)) for name, excitation in runs.items()]


@double_precision
def test_a_gradual_drop_is_simulated():
    """Against the virtual bench."""
    effect = GradualBrushDrop(voltage_V=jnp.asarray(1.0), onset_A=jnp.asarray(4.0))
    motor = jax.tree.map(jnp.asarray, Motor(**PAPER, effects=(effect,)))
    run = recorded(vb.QUIET, **BRUSHES)[0]
    simulated = np.asarray(free_run(motor, Tape.from_recordings([run])))
    expected = np.stack([run.current, run.speed], 1)
    got = np.moveaxis(simulated, 1, 2).reshape(-1, 2)[: len(run)]
    assert np.all(np.abs(got - expected).max(0) < 1e-3 * np.abs(expected).max(0))


@pytest.mark.parametrize("onset", [0.0, 4.0])
def test_an_onset_is_identified_only_if_there_is_one(onset):
    found = identify(recorded(brush_drop_V=1.0, brush_onset_A=onset), effects=["brush_voltage_drop"])
    kind = type(found.motor.effect_named("brush_voltage_drop"))
    assert kind is (GradualBrushDrop if onset else BrushVoltageDrop)
    truth = {**PAPER, "brush_voltage_drop.voltage_V": 1.0} | ({"brush_voltage_drop.onset_A": onset} if onset else {})
    for name, value in truth.items():
        estimate = found.parameters[name]
        assert abs(estimate.value - value) < max(3.5 * estimate.stderr, 1e-4 * value)


@pytest.mark.slow
def test_a_gradual_drop_is_named_with_its_onset():
    """Taken for constant, it would bias R by 4 %."""
    found = diagnose(recorded(**BRUSHES))
    assert found.verdict == "named"
    (effect,) = found.effects
    assert effect.name == "brush_voltage_drop"
    assert effect.parameters["onset_A"].value == pytest.approx(4.0, rel=0.05)
    assert found.final.parameters["R"].value == pytest.approx(PAPER["R"], rel=2e-3)


def test_a_field_that_no_form_has_does_not_select_one(tmp_path):
    save_motor(tmp_path / "motor.json", Motor(**PAPER, effects=(BrushVoltageDrop(np.asarray(0.8)),)))
    text = (tmp_path / "motor.json").read_text().replace('"voltage_V"', '"measured_on": 3, "voltage_V"')
    (tmp_path / "motor.json").write_text(text)
    assert text.count("measured_on") == 1
    (read,) = load_motor(tmp_path / "motor.json").effects
    assert type(read) is BrushVoltageDrop


def test_both_forms_are_saved_and_read(tmp_path):
    for effect in (BrushVoltageDrop(np.asarray(0.8)), GradualBrushDrop(np.asarray(0.8), np.asarray(2.0))):
        save_motor(tmp_path / "motor.json", Motor(**PAPER, effects=(effect,)))
        (read,) = load_motor(tmp_path / "motor.json").effects
        assert type(read) is type(effect)
        assert {f: float(getattr(read, f)) for f in read.ranges} == {f: float(getattr(effect, f)) for f in read.ranges}
        assert all(range_of(read.name, field) == about for field, about in read.ranges.items())
