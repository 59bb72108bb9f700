"""Samples that are not measurements (spikes, clipped values), and valid samples that resemble them."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.signal import lfilter
from test_check import EXCITATIONS, good_run

from pmdc_jax.checks.invalid_samples import without_unmeasured
from pmdc_jax.identify.prepare import prepare
from pmdc_jax.recordings.recording import Recording

SPIKE_ROWS = np.array([200, 777, 1500, 2100])


@pytest.mark.parametrize("seed", range(6))
def test_valid_recordings_are_unchanged(seed):
    for name in EXCITATIONS:
        run = good_run(seed, name)
        assert without_unmeasured([run])[0] is run


@pytest.mark.parametrize(("column", "value"), [("speed", 0.0), ("speed", 65535.0), ("current", 400.0)])
def test_spikes_become_missing_and_are_noted(column, value):
    run = good_run(3, "staircase")
    signal = getattr(run, column).copy()
    rows = SPIKE_ROWS[np.abs(signal[SPIKE_ROWS] - value) > 0.5 * np.ptp(signal)]
    assert len(rows)
    signal[rows] = value
    (cleaned,) = without_unmeasured([attrs.evolve(run, **{column: signal})])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(getattr(cleaned, column))), rows)
    (note,) = cleaned.notes
    assert note.column == column
    assert "single-sample spike" in note.what


def test_the_response_to_a_voltage_pulse_is_not_a_spike():
    time = 1e-3 * np.arange(1000)
    voltage = np.where(np.arange(1000) % 97 == 50, 24.0, 2.0)
    current = np.roll(voltage, 1) * 3.0
    run = Recording("pulses", time, voltage, current, speed=time)
    assert without_unmeasured([run])[0] is run


def test_spikes_are_excluded_from_a_fit_and_listed_in_its_findings():
    run = good_run(3, "staircase")
    speed = run.speed.copy()
    speed[SPIKE_ROWS] = 3000.0
    given = prepare([attrs.evolve(run, speed=speed)], ())
    assert np.isnan(given.runs[0].speed[SPIKE_ROWS]).all()
    assert any("single-sample spike" in finding.what for finding in given.findings)


def test_clipped_samples_become_missing():
    run = good_run(7, "prbs", noise=1e-3)
    limit = np.quantile(run.current, 0.9)
    (cleaned,) = without_unmeasured([attrs.evolve(run, current=np.minimum(run.current, limit))])
    np.testing.assert_array_equal(np.isnan(cleaned.current), run.current >= limit)
    (note,) = cleaned.notes
    assert "looks clipped" in note.what


def test_a_current_clipped_at_both_ends_for_few_samples_at_a_time_becomes_missing():
    run = good_run(7, "prbs", noise=1e-3)
    low, high = np.quantile(run.current, [0.02, 0.98])
    clipped = attrs.evolve(run, current=np.clip(run.current, low, high))
    (cleaned,) = without_unmeasured([clipped])
    lost = np.isnan(cleaned.current)
    np.testing.assert_array_equal(lost, (run.current >= high) | (run.current <= low))


def test_a_coarse_current_clipped_for_few_samples_at_a_time_becomes_missing():
    """Its values often repeat by chance; and the other run reaches the end of the range only twice."""
    run = good_run(7, "prbs", noise=1e-3)
    step = 1e-3 * np.ptp(run.current)
    full = step * np.round(run.current / step)
    limit = step * np.round(np.quantile(np.abs(full), 0.99) / step)
    less = step * np.round(full * limit / np.sort(np.abs(full))[-2] / step)
    runs = [attrs.evolve(run, current=np.clip(i, -limit, limit)) for i in (full, less)]
    assert np.isnan(without_unmeasured(runs[:1])[0].current).sum() == np.sum(np.abs(full) >= limit)
    assert without_unmeasured(runs[1:])[0] is runs[1]
    assert np.isnan(without_unmeasured(runs)[1].current).sum() == np.sum(np.abs(less) >= limit)


def noisy_steps() -> Recording:
    """Voltage steps, with pauses, recorded by noisy sensors of fine resolution."""
    rng = np.random.default_rng(5)
    levels = np.repeat([0.0, 60.0, 110.0, -80.0, 0.0, 95.0, 0.0, 40.0], 300)
    speed = lfilter([0.05], [1, -0.95], levels) + 0.2 * rng.standard_normal(len(levels))
    current = levels / 50 + 0.1 * rng.standard_normal(len(levels))
    return Recording("bench", 1e-3 * np.arange(len(levels)), levels / 5, current, speed)


@pytest.mark.parametrize("value", [None, 0.0])
def test_a_sensor_that_fails_for_a_while_is_told(value):
    run = noisy_steps()
    assert without_unmeasured([run])[0] is run
    speed = run.speed.copy()
    speed[620:770] = speed[620] if value is None else value
    (cleaned,) = without_unmeasured([attrs.evolve(run, speed=speed)])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(cleaned.speed)), np.arange(621, 770))
    (note,) = cleaned.notes
    assert "stays" in note.what and "sensor" in note.mend


def test_a_rotor_that_rests_is_no_failed_sensor():
    """The sensor reads exactly zero below its threshold, as of most tachometers that count edges."""
    run = noisy_steps()
    speed = np.where(np.abs(run.speed) < 2.0, 0.0, run.speed)
    assert np.count_nonzero(speed == 0) > 500
    assert without_unmeasured([attrs.evolve(run, speed=speed)])[0].notes == ()


@pytest.mark.parametrize("seed", range(4))
def test_a_quantised_speed_that_dwells_at_its_maximum_is_not_clipped(seed):
    """Steady speeds close to whole counts: the reading dwells at the highest no longer than at the others."""
    rng = np.random.default_rng(seed)
    levels = np.repeat([20.1, 61.05, 108.95, 81.0, 40.1, 95.4, 70.6, 30.5], 150)
    counts = lfilter([0.1], [1, -0.9], levels) + 0.2 * rng.standard_normal(len(levels))
    time = 1e-3 * np.arange(len(levels))
    run = Recording("counts", time, levels / 5, levels / 50 + rng.standard_normal(), np.round(counts))
    assert without_unmeasured([run])[0] is run
    clipped = attrs.evolve(run, speed=np.minimum(counts, 105.0))
    assert any("looks clipped" in note.what for note in without_unmeasured([clipped])[0].notes)


@pytest.mark.parametrize("last_code", [-512, 511, 2047, 4095])
def test_the_last_code_of_a_converter_is_missing_even_if_it_is_reached_once(last_code):
    run = noisy_steps()
    step = 1.01 * np.abs(run.current).max() / abs(last_code)
    current = step * np.clip(np.round(run.current / step), -abs(last_code), abs(last_code))
    assert without_unmeasured([attrs.evolve(run, current=current)])[0].current is current
    current[1234] = step * last_code
    (cleaned,) = without_unmeasured([attrs.evolve(run, current=np.round(current, 6))])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(cleaned.current)), [1234])
    current[1234] = step * (last_code - np.sign(last_code))  # one less
    assert not np.isnan(without_unmeasured([attrs.evolve(run, current=current)])[0].current).any()


def test_a_speed_by_the_time_between_edges_that_dwells_at_its_maximum_is_not_clipped():
    """It is a whole number of ticks, so that its resolution is coarse only at high speed."""
    run, rng = noisy_steps(), np.random.default_rng(7)
    exact = 4.008 * lfilter([0.05], [1, -0.95], 5 * run.voltage) + 0.09 * rng.standard_normal(len(run))
    ticks = 16e6 * 2 * np.pi / 360 / np.maximum(np.abs(exact), 1.0)
    speed = np.sign(exact) * 16e6 * 2 * np.pi / 360 / np.round(ticks)
    assert without_unmeasured([attrs.evolve(run, speed=speed)])[0].notes == ()


def test_a_signal_of_few_levels_is_judged_without_undefined_numbers():
    """Next to its maximum there is only one other level, so that the resolution there is the distance between both."""
    run = noisy_steps()
    speed = 15.0 * np.round((run.speed + 9 * np.random.default_rng(8).standard_normal(len(run))) / 15)
    assert without_unmeasured([attrs.evolve(run, speed=speed)])[0].notes == ()
