"""Speeds that are differences of angles over one sample or two are recognised as means, and simulated as such."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy import ndimage, signal
from scipy.interpolate import CubicSpline

from benchmarks.naming.plant import Plant, simulate
from benchmarks.virtual_bench import prbs, staircase
from pmdc_jax import diagnose, identify
from pmdc_jax.identify.corrections.averaging_by_noise import averaging_of_counts, averaging_of_differences, in_counts
from pmdc_jax.recordings.recording import AROUND, OVER_BOTH, OVER_LAST, Averaging, Recording
from pmdc_jax.recordings.resolution import quantum

# a motor that speeds up within a few samples
FAST_MOTOR = {"R": 0.5, "L": 0.001, "Kb": 0.05, "Kt": 0.05, "J": 5e-5, "f": 1e-4}
LINES = 8000
# in quantisation steps: makes a rounded speed as noisy as counts of the last sample
NOISE = 0.5


def recorded(kind: str, lines: int = LINES, torque_noise: float = 0.0, **changed: float) -> list[Recording]:
    """Runs with a speed from encoder counts, or from a tachometer with noise of the same deviation.

    **Arguments**: `torque_noise`, N m, standard deviation of a torque that is not recorded, correlated over 0.2 s.
    """
    rng = np.random.default_rng(5)
    runs = {"prbs": prbs(rng, 4.0), "stairs": staircase(4.0)}
    found = []
    for name, excitation in runs.items():
        white = np.random.default_rng(len(found)).standard_normal(len(excitation.time))
        slow = signal.lfilter([torque_noise * 0.1], [1, -0.995], white)
        outputs = simulate(Plant(**(FAST_MOTOR | changed)), *excitation._replace(load=excitation.load + slow))
        count = np.floor(outputs[:, 2] * lines / (2 * np.pi))
        speed = np.gradient(count, excitation.time) * 2 * np.pi / lines
        if kind == "counts of the last sample":
            speed = np.diff(count, prepend=count[0]) * 2 * np.pi / lines / 1e-3
        if kind == "counts around the instant":
            halfway = CubicSpline(excitation.time, outputs[:, 2])(excitation.time + 5e-4)
            count = np.floor(halfway * lines / (2 * np.pi))
            speed = np.diff(count, prepend=count[0]) * 2 * np.pi / lines / 1e-3
        if kind == "tachometer":
            speed = outputs[:, 1] + np.std(speed - outputs[:, 1]) * rng.standard_normal(len(speed))
        if kind == "rounded":
            step = 2 * np.pi / lines / 1e-3
            speed = step * np.round(outputs[:, 1] / step + NOISE * rng.standard_normal(len(speed)))
        motion = {"speed": speed}
        if kind == "angle alone":
            motion = {"angle": count * 2 * np.pi / lines}
        current = outputs[:, 0] + 0.1 * rng.standard_normal(len(speed))
        run = Recording(name, excitation.time, excitation.voltage, current, load=excitation.load, **motion)
        found.append(run)
    return found


MEAN_OVER = {
    "counts of two samples": "the last and the next sample interval",
    "counts of the last sample": "the last sample interval",
    "counts around the instant": "the sample interval around each instant",
    "tachometer": None,
    "rounded": None,
    "angle alone": None,  # differentiated by the package, without a message
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", MEAN_OVER)
def test_a_speed_that_is_a_mean_is_recognised(kind):
    found = identify(recorded(kind), tie=[("Kt", "Kb")])
    means = [m for m in found.messages if "is a mean over" in m]
    assert [f"over {MEAN_OVER[kind]}," in m for m in means] == [True] * (MEAN_OVER[kind] is not None)
    for name in ("R", "L", "Kb", "J"):
        estimate = found.parameters[name]
        assert abs(estimate.value - FAST_MOTOR[name]) < max(3.5 * estimate.stderr, 2e-3 * FAST_MOTOR[name])


@pytest.mark.slow
def test_counts_around_the_instant_are_recognised_beside_a_hidden_effect():
    """Taken for means over the last sample, their lead of half a sample was named a gear."""
    shaft = {"J": 3e-4, "stiffness": 8.0, "damping": 4e-3, "load_share": 0.5}
    found = diagnose(recorded("counts around the instant", lines=1000, **shaft))
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["shaft_compliance"]
    assert [m for m in found.final.messages if "around each instant" in m]


@pytest.mark.slow
def test_coarse_counts_around_the_instant_are_no_missing_effect():
    """They fit better as instantaneous speeds than as means over the last sample; taken for instantaneous, what is left
    was a delay of the sensor."""
    found = diagnose(recorded("counts around the instant", lines=1000, J=1.5e-4))
    assert found.verdict == "none_detected"
    assert [m for m in found.final.messages if "around each instant" in m]


@pytest.mark.slow
def test_counts_around_the_instant_are_no_missing_effect_in_torque_noise():
    found = diagnose(recorded("counts around the instant", lines=1000, torque_noise=0.01, J=1.5e-4))
    assert found.verdict == "none_detected"
    assert [m for m in found.final.messages if "around each instant" in m]


@pytest.mark.parametrize("averaging", [OVER_LAST, OVER_BOTH, AROUND, Averaging(0.25, 0.5), Averaging(1.0, 0.0, 0.3)])
def test_the_mean_of_a_signal_that_is_linear_between_samples(averaging):
    signal = np.random.default_rng(6).standard_normal(50)
    fine = np.arange(49 * 1000) / 1000
    total = np.append(0, np.cumsum(np.interp(fine + 5e-4, np.arange(50), signal))) / 1000
    integral = CubicSpline(np.append(fine, 49.0), total)
    at = np.arange(2, 47) + averaging.later
    last, coming = integral(at) - integral(at - 1), integral(at + 1) - integral(at)
    instant = np.interp(at, np.arange(50), signal)
    expected = averaging.last * last + averaging.next * coming + (1 - averaging.last - averaging.next) * instant
    np.testing.assert_allclose(averaging.applied_to(signal)[2:47], expected, atol=1e-6)
    assert np.isnan(averaging.with_ends_missing(signal)[-1]) == (averaging != OVER_LAST)


def runs_of_a_toy_motor() -> list[Recording]:
    """A toy motor behind an encoder of twelve lines, read every 20 ms: its mechanical time constant is 11 ms."""
    toy = Plant(R=1.2, L=3e-4, Kb=1.8e-3, Kt=1.8e-3, J=3e-8, f=2e-7)
    rng, step, lines, runs = np.random.default_rng(9), 0.02, 12, []
    for name, offset in (("about zero", 0.0), ("one way", 1.5)):
        excitation = prbs(rng, 10.0, step, amplitude=1.2, offset=offset, hold=0.2)
        outputs = simulate(toy, *excitation)
        count = np.floor(outputs[:, 2] * lines / (2 * np.pi))
        speed = np.diff(count, prepend=count[0]) * 2 * np.pi / lines / step
        current = outputs[:, 0] + 0.02 * rng.standard_normal(len(speed))
        runs.append(Recording(name, excitation.time, excitation.voltage, current, speed=speed))
    return runs


@pytest.mark.slow
def test_a_mean_is_recognised_if_the_motor_settles_within_a_sample():
    """Taken for instantaneous speeds, the counts bias R by half of its value."""
    found = identify(runs_of_a_toy_motor(), unloaded=True, tie=[("Kt", "Kb")])
    assert [m for m in found.messages if "is a mean over the last sample" in m]
    for name, truth in {"R": 1.2, "Kb": 1.8e-3, "J": 3e-8}.items():
        estimate = found.parameters[name]
        assert abs(estimate.value - truth) < 3.5 * estimate.stderr < 0.15 * truth


@pytest.mark.slow
def test_a_mean_is_not_diagnosed_as_a_delay_of_the_sensor():
    """Such a mean lags by half a sample, which used to be named a delay of the sensor."""
    found = diagnose(runs_of_a_toy_motor(), unloaded=True, tie=[("Kt", "Kb")])
    assert found.verdict == "none_detected"


def delayed(runs: list[Recording], samples: int) -> list[Recording]:
    return [attrs.evolve(r, speed=np.roll(r.speed, samples)) for r in runs]


@pytest.mark.slow
def test_a_speed_delayed_beyond_a_sample_is_not_taken_for_a_mean():
    found = identify(delayed(recorded("tachometer"), 9))
    assert not any("mean over" in m for m in found.messages)


def test_the_averaging_of_counts_is_recognised_by_their_noise():
    """For any motion that is slow compared with the sampling."""
    rng = np.random.default_rng(3)
    speed = 300 * ndimage.gaussian_filter1d(rng.standard_normal(12000), 20.0)
    counts = np.floor(np.cumsum(speed))
    assert averaging_of_counts([np.diff(counts)]) == (OVER_LAST, -np.inf)
    mean, min_gain = averaging_of_counts([counts[2:] - counts[:-2]])
    assert mean == OVER_BOTH and min_gain < 0
    assert averaging_of_counts([np.round(speed)])[0] is None
    # noise may have the same power, but at all frequencies: the fit has to confirm the mean
    mean, min_gain = averaging_of_counts([np.round(speed + NOISE * rng.standard_normal(12000))])
    assert mean == OVER_LAST and np.isfinite(min_gain)


def test_the_noise_of_a_mean_is_recognised_beside_a_resonance():
    """As of teeth that rattle, whose power in the middle of the spectrum is that of the counts."""
    rng = np.random.default_rng(7)
    numerator, denominator = signal.iirpeak(0.5, 30.0)
    rattle = signal.lfilter(numerator, denominator, rng.standard_normal(12000))
    slow = 300 * ndimage.gaussian_filter1d(rng.standard_normal(12000), 20.0)
    counts = np.floor(np.cumsum(slow + rattle))
    assert averaging_of_counts([np.diff(counts)]) == (OVER_LAST, -np.inf)


def test_noisy_counts_are_no_certain_mean():
    """None of 300 short records of instantaneous speeds, rounded to counts."""
    rng = np.random.default_rng(8)
    for deviation in np.repeat([0.3, 1.0, 3.0], 100):
        slow = 300 * ndimage.gaussian_filter1d(rng.standard_normal(1500), 20.0)
        _, min_gain = averaging_of_counts([np.round(slow + deviation * rng.standard_normal(1500))])
        assert np.isfinite(min_gain), deviation


def test_differences_over_two_samples_are_recognised_by_missing_power_at_the_nyquist_frequency():
    rng = np.random.default_rng(4)
    speed = 300 * ndimage.gaussian_filter1d(rng.standard_normal(4000), 2.0)
    angle = np.cumsum(speed) + rng.standard_normal(4000)
    assert averaging_of_differences([angle[2:] - angle[:-2]])[0] == OVER_BOTH
    for other in (np.diff(angle), speed + rng.standard_normal(4000), np.repeat(speed[::20], 20)):
        assert averaging_of_differences([other])[0] is None
    assert averaging_of_differences([])[0] is None


@pytest.mark.slow
def test_counts_without_a_current_are_means_only_if_their_noise_says_so():
    """Their lag may be that of an inductance."""
    runs = [attrs.evolve(r, current=None) for r in recorded("counts of the last sample", J=1.5e-4)]
    assert any("mean over" in m for m in identify(runs).messages)
    rng = np.random.default_rng(9)
    step = 2 * np.pi / LINES / 1e-3
    noisy = [attrs.evolve(r, speed=step * np.round(r.speed / step + 2 * rng.standard_normal(len(r)))) for r in runs]
    assert not any("mean over" in m for m in identify(noisy).messages)


@pytest.mark.slow
def test_counts_with_a_fractional_number_of_lines_are_not_taken_for_means():
    runs = recorded("counts of the last sample")
    scaled = [attrs.evolve(r, speed=1.0001 * r.speed) for r in runs]
    assert not any("mean over" in m for m in identify(scaled).messages)


def test_the_quantum_of_counts_divided_by_a_sample_time():
    """Divided by a sample time that is no sum of powers of two, equal counts differ by their last bits."""
    rng = np.random.default_rng(1)
    counts = np.cumsum(rng.integers(-3, 4, 3000))
    time = 7e-4 * np.arange(3000)
    assert quantum(np.diff(np.gradient(counts, time))) == pytest.approx(0.5 / 7e-4)


def test_the_quantum_of_rounded_decimals_is_more_precise_than_each_of_them():
    """Speeds of 2.80848 rad/s a count in seven digits: their smallest difference is 2.8084, and 2762.08 lines."""
    rng = np.random.default_rng(2)
    counts = np.cumsum(rng.integers(-3, 4, 3000)) * 2 * np.pi / 2762 / 8.1e-4
    speed = np.array([float(f"{x:.7g}") for x in counts])
    assert 2 * np.pi / quantum(np.diff(speed)) / 8.1e-4 == pytest.approx(2762, abs=2e-3)


def test_counts_printed_in_few_digits_are_recognised():
    """Counts of 3.125 rpm in hundredths of it: by one run's largest speeds alone its 1920 lines are 1919.95 or so."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        counts = np.round(rng.uniform(40, 90) * np.sin(np.linspace(0, 9, 3000)))
        rpm = np.round(60 / 1920 / 0.01 * counts, 2)
        (found,) = in_counts([(rpm * 2 * np.pi / 60, 0.01)])
        np.testing.assert_allclose(found, counts, atol=0.01)
        # steps of a converter are not counts
        assert not in_counts([(1.0003 * rpm * 2 * np.pi / 60, 0.01)])


@pytest.mark.slow
@pytest.mark.parametrize("known_by", ["angle", "difference"])
def test_differences_of_angles_are_exact_despite_voltage_steps(known_by):
    """Exact angles by the matrix exponential, sampled slowly: a spline is off by 0.27 rad/s and more."""
    plant, step = FAST_MOTOR | {"L": 3e-4}, 2e-3
    rng = np.random.default_rng(11)
    voltage = np.repeat(rng.uniform(-12, 12, 60), 25)
    A, B = np.zeros((3, 3)), np.array([[1 / plant["L"]], [0.0], [0.0]])
    A[0, :2] = -plant["R"] / plant["L"], -plant["Kb"] / plant["L"]
    A[1, :2], A[2, 1] = (plant["Kt"] / plant["J"], -plant["f"] / plant["J"]), 1.0
    F, G, *_ = signal.cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), step)
    states = np.zeros((len(voltage) + 1, 3))
    for k, volts in enumerate(voltage):
        states[k + 1] = F @ states[k] + G[:, 0] * volts
    current, speed, angle = states[:-1].T
    time = step * np.arange(len(voltage))
    assert np.std(CubicSpline(time, angle)(time, 1) - speed) > 0.27
    motion = {"angle": angle} if known_by == "angle" else {"speed": np.gradient(angle, step)}
    measured = current + 0.02 * rng.standard_normal(len(current))
    run = Recording("steps", time, voltage, measured, load=0 * time, **motion)
    found = identify([run], tie=[("Kt", "Kb")])
    assert found.fit["steps"].speed_rmse < 1e-3
    for name in ("R", "L", "Kb", "J"):
        assert found.parameters[name].value == pytest.approx(plant[name], rel=2e-3)


def test_the_quantum_of_a_speed_that_jumps_by_many_counts():
    """From sample to sample by dozens of counts, hardly ever by one."""
    rng = np.random.default_rng(8)
    step = 2 * np.pi / 4096 / 0.03
    speed = step * np.round(rng.uniform(-800, 800, 600) / step)
    assert quantum(np.diff(np.unique(speed))) == pytest.approx(step, rel=1e-6)
    assert quantum(np.diff(np.unique(speed + 0.3 * step * rng.standard_normal(600)))) == 0
