"""A speed that is a difference of angles over two samples is taken for the mean that it is."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.naming.plant import Plant, simulate
from benchmarks.virtual_bench import prbs, staircase
from pmdc_jax import identify
from pmdc_jax.identify.averaged import undone
from pmdc_jax.identify.noise import quantum
from pmdc_jax.recording import Recording

# a motor that speeds up within a few samples
QUICK = {"R": 0.5, "L": 0.001, "Kb": 0.05, "Kt": 0.05, "J": 5e-5, "f": 1e-4}
LINES = 20_000


def recorded(kind: str) -> list[Recording]:
    """Runs with the speed as counts of an encoder give it, or as an ideal tachometer does with noise as large."""
    rng = np.random.default_rng(5)
    runs = {"prbs": prbs(rng, 4.0), "stairs": staircase(4.0)}
    found = []
    for name, driven in runs.items():
        read = simulate(Plant(**QUICK), *driven)
        count = np.floor(read[:, 2] * LINES / (2 * np.pi))
        speed = np.gradient(count, driven.time) * 2 * np.pi / LINES
        if kind == "counts of the last sample":
            speed = np.diff(count, prepend=count[0]) * 2 * np.pi / LINES / 1e-3
        if kind == "tachometer":
            speed = read[:, 1] + np.std(speed - read[:, 1]) * rng.standard_normal(len(speed))
        current = read[:, 0] + 0.1 * rng.standard_normal(len(speed))
        found.append(Recording(name, driven.time, driven.voltage, current, speed, driven.load))
    return found


def is_taken_for_a_mean(found) -> bool:
    return any("mean over two samples" in m for m in found.messages)


def test_counts_of_the_last_sample_are_late_and_no_mean_over_two():
    assert not is_taken_for_a_mean(identify(recorded("counts of the last sample")))


@pytest.mark.parametrize("kind", ["counts of two samples", "tachometer"])
def test_only_a_mean_is_taken_for_one(kind):
    found = identify(recorded(kind), tie=[("Kt", "Kb")])
    assert is_taken_for_a_mean(found) is (kind == "counts of two samples")
    for name in ("R", "L", "Kb", "J"):
        estimate = found.parameters[name]
        assert abs(estimate.value - QUICK[name]) < max(3.5 * estimate.stderr, 2e-3 * QUICK[name])


def test_undoing_a_mean_gives_the_signal_back():
    signal = np.random.default_rng(0).standard_normal(50)
    mean = signal.copy()
    mean[1:-1] = (signal[:-2] + 4 * signal[1:-1] + signal[2:]) / 6
    np.testing.assert_allclose(undone(mean), signal, rtol=1e-12)


def test_steps_of_counts_over_a_time_are_steps():
    """Divided by a sample time that is no sum of powers of two, equal counts differ by their last bits."""
    rng = np.random.default_rng(1)
    counts = np.cumsum(rng.integers(-3, 4, 3000))
    time = 7e-4 * np.arange(3000)
    assert quantum(np.diff(np.gradient(counts, time))) == pytest.approx(0.5 / 7e-4)
