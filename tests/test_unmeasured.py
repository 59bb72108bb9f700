"""Samples that are no measurements, and what only looks like some."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.signal import lfilter
from test_check import EXCITATIONS, good_run

from pmdc_jax.identify.prepare import prepare
from pmdc_jax.recording import Recording
from pmdc_jax.unmeasured import without_unmeasured

ROWS = np.array([200, 777, 1500, 2100])


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_taken_from_a_sound_record(seed):
    for name in EXCITATIONS:
        run = good_run(seed, name)
        assert without_unmeasured(run) is run


@pytest.mark.parametrize(
    ("column", "value"), [("speed", 0.0), ("speed", 65535.0), ("current", 400.0)]
)
def test_spikes_are_missing_and_told_of(column, value):
    run = good_run(3, "staircase")
    signal = getattr(run, column).copy()
    rows = ROWS[np.abs(signal[ROWS] - value) > 0.5 * np.ptp(signal)]
    assert len(rows)
    signal[rows] = value
    mended = without_unmeasured(attrs.evolve(run, **{column: signal}))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(getattr(mended, column))), rows)
    (note,) = mended.notes
    assert note.column == column
    assert "single-sample spike" in note.what


def test_a_pulse_of_the_voltage_makes_no_spike():
    time = 1e-3 * np.arange(1000)
    voltage = np.where(np.arange(1000) % 97 == 50, 24.0, 2.0)
    current = np.roll(voltage, 1) * 3.0
    run = Recording("pulses", time, voltage, current, speed=time)
    assert without_unmeasured(run) is run


def test_a_fit_does_not_see_spikes_and_its_findings_tell_of_them():
    run = good_run(3, "staircase")
    speed = run.speed.copy()
    speed[ROWS] = 3000.0
    given = prepare([attrs.evolve(run, speed=speed)], ())
    assert np.isnan(given.runs[0].speed[ROWS]).all()
    assert any("single-sample spike" in finding.what for finding in given.findings)


def test_what_is_clipped_is_missing():
    run = good_run(7, "prbs", noise=1e-3)
    limit = np.quantile(run.current, 0.9)
    mended = without_unmeasured(attrs.evolve(run, current=np.minimum(run.current, limit)))
    np.testing.assert_array_equal(np.isnan(mended.current), run.current >= limit)
    (note,) = mended.notes
    assert "looks clipped" in note.what


@pytest.mark.parametrize("seed", range(4))
def test_a_speed_in_counts_that_stays_at_its_largest_is_not_clipped(seed):
    """A motor that turns steadily at levels near whole counts: the highest one stays no longer than the others."""
    rng = np.random.default_rng(seed)
    levels = np.repeat([20.1, 61.05, 108.95, 81.0, 40.1, 95.4, 70.6, 30.5], 150)
    rising = lfilter([0.1], [1, -0.9], levels) + 0.2 * rng.standard_normal(len(levels))
    time = 1e-3 * np.arange(len(levels))
    run = Recording(
        "counts", time, levels / 5, levels / 50 + rng.standard_normal(), np.round(rising)
    )
    assert without_unmeasured(run) is run
    clipped = attrs.evolve(run, speed=np.minimum(rising, 105.0))
    assert any("looks clipped" in note.what for note in without_unmeasured(clipped).notes)
