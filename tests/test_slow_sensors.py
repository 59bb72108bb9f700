"""Sensors that are slower than the log, which repeats their readings: only the readings count."""

from __future__ import annotations

import attrs
import jax
import numpy as np
import pytest

from benchmarks.naming.plant import Plant, simulate
from benchmarks.virtual_bench import loaded, prbs, staircase
from pmdc_jax import diagnose, identify
from pmdc_jax.checks.check import check
from pmdc_jax.checks.slow_sensors import readings_only
from pmdc_jax.errors import InputError
from pmdc_jax.motor import Motor
from pmdc_jax.recordings.readings import reading_interval, repeated_readings
from pmdc_jax.recordings.recording import OVER_LAST, Recording
from pmdc_jax.runtime.precision import double_precision
from pmdc_jax.simulate import RunUnknowns, Tape, free_run

MOTOR = {"R": 0.6, "L": 6.5e-4, "Kb": 0.0635, "Kt": 0.0635, "J": 1.3e-4, "f": 1.2e-4}
LINES = 8000


def repeated(signal: np.ndarray, every: int, first: int = 0) -> np.ndarray:
    """A signal of which every so many samples are read, and the readings repeated in between."""
    k = np.arange(len(signal))
    return signal[np.maximum((k - first) // every * every + first, 0)]


def recorded(kind: str, every: int, **effects: float) -> list[Recording]:
    """Runs of an independent simulator with a speed read every so many samples: a tachometer's, or encoder counts since
    the last reading."""
    rng, runs = np.random.default_rng(31), []
    for name, excitation in {"stairs": staircase(4.0), "prbs": prbs(rng, 4.0), "loaded": loaded(rng, 4.0)}.items():
        outputs = simulate(Plant(**MOTOR | effects), *excitation)
        speed = outputs[:, 1] + 0.3 * rng.standard_normal(len(outputs))
        if kind == "counts":
            count = np.floor(outputs[:, 2] * LINES / (2 * np.pi))
            since = np.append(np.zeros(every), count[every:] - count[:-every])
            speed = since * 2 * np.pi / LINES / (every * 1e-3)
        current = outputs[:, 0] + 0.05 * rng.standard_normal(len(outputs))
        if kind == "all":
            current = repeated(current, every)
        speed = repeated(speed, every)
        runs.append(Recording(name, excitation.time, excitation.voltage, current, speed, load=excitation.load))
    return runs


@pytest.mark.parametrize(("every", "first"), [(2, 0), (5, 3), (50, 49)])
def test_repeated_readings_are_found(every, first):
    noisy = np.random.default_rng(32).standard_normal(60 * every)
    repeats = repeated_readings(repeated(noisy, every, first))
    assert np.array_equal(~repeats, np.arange(len(noisy)) % every == first)
    assert reading_interval(~repeats) == every


def test_readings_by_another_clock_are_found():
    """A sensor read every 9.77 samples changes after nine samples or ten."""
    time = np.arange(3000.0)
    readings = np.random.default_rng(33).standard_normal(400)
    signal = readings[(time / 9.77).astype(int)]
    repeats = repeated_readings(signal)
    assert np.array_equal(np.flatnonzero(~repeats)[1:], np.flatnonzero(np.diff(signal)) + 1)


@pytest.mark.parametrize("step", [0.05, 0.5, 5.0])
def test_coarse_counts_are_no_slow_sensor(step):
    """A counted speed changes seldom where it changes slowly, but at any sample."""
    time = np.arange(4000) * 1e-3
    speed = 40 * np.sin(2 * np.pi * 0.5 * time)
    assert not repeated_readings(step * np.round(speed / step)).any()
    ramp = 30 * np.arange(4000) * 1e-3
    assert not repeated_readings(step * np.round(ramp / step)).any()


def test_a_log_faster_than_all_its_sensors_is_thinned():
    every, length = 4, 400
    rng = np.random.default_rng(34)
    voltage, current, speed = (repeated(rng.standard_normal(length), every) for _ in range(3))
    run = Recording("log", np.arange(length) * 1e-3, voltage, current, speed)
    thin = readings_only(run)
    assert thin.sample_time == pytest.approx(every * 1e-3)
    np.testing.assert_array_equal(thin.speed, speed[::every])
    np.testing.assert_array_equal(thin.voltage, voltage[::every])
    # a voltage that changes in between acts in between
    whole = readings_only(attrs.evolve(run, voltage=rng.standard_normal(length)))
    assert len(whole) == length
    assert np.isnan(whole.speed).sum() == np.isnan(whole.current).sum() == length - length // every


def test_the_readings_of_a_slow_sensor_are_noted_once_and_others_left_alone():
    run, *_ = recorded("tachometer", 5)
    found = [f for f in check([readings_only(run)]) if f.column == "speed"]
    assert ["every 5 samples" in f.what for f in found] == [True]
    fast, *_ = recorded("tachometer", 1)
    assert readings_only(fast) is fast


def test_regular_gaps_are_a_slow_sensor_but_lost_readings_are_gaps():
    time, speed = np.arange(1000) * 1e-3, np.full(1000, np.nan)
    speed[::10] = 1.0
    Recording("log", time, np.zeros(1000), speed=speed)
    speed[200:500] = np.nan
    with pytest.raises(InputError, match="may be missing"):
        Recording("log", time, np.zeros(1000), speed=speed)


@double_precision
def test_means_from_one_reading_to_the_next_are_simulated():
    """Against the angle of an independent simulator."""
    every = 7
    excitation = prbs(np.random.default_rng(35), 1.0)
    outputs = simulate(Plant(**MOTOR), *excitation)
    means = np.full(len(outputs), np.nan)
    rows = np.arange(every, len(outputs), every)
    means[rows] = (outputs[rows, 2] - outputs[rows - every, 2]) / (every * 1e-3)
    run = Recording("prbs", excitation.time, excitation.voltage, outputs[:, 0], means, averaging=OVER_LAST)
    tape = Tape.from_recordings([run], unloaded=True)
    motor = jax.tree.map(jax.numpy.asarray, Motor(**MOTOR))
    at_rest = RunUnknowns.as_recorded(tape)._replace(speed=jax.numpy.zeros(1))
    simulated = tape.samples_of(0, free_run(motor, tape, at_rest), len(run))
    np.testing.assert_allclose(simulated[rows, 1], means[rows], atol=1e-6 * np.nanmax(np.abs(means)))


@pytest.mark.parametrize(("kind", "every"), [("tachometer", 5), ("all", 4), ("counts", 10)])
def test_a_motor_is_identified_from_slow_sensors(kind, every):
    found = identify(recorded(kind, every))
    assert any("last reading" in m for m in found.messages) == (kind == "counts")
    for name, truth in MOTOR.items():
        estimate = found.parameters[name]
        assert abs(estimate.value - truth) < max(3.5 * estimate.stderr, 5e-4 * truth)
        assert estimate.stderr < 0.01 * truth


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "every"), [("tachometer", 10), ("all", 4), ("counts", 2), ("counts", 10)])
def test_friction_is_named_behind_slow_sensors(kind, every):
    """Taken for readings of every sample, their repetition was named a delay and a lag of the sensor."""
    found = diagnose(recorded(kind, every, friction_forward_Nm=0.012, friction_backward_Nm=0.012))
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
