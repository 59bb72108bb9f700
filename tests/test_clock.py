"""Recordings with uneven time stamps: samples taken unevenly, or evenly with only the stamps uneven."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from scipy.linalg import expm

import pmdc_jax
from pmdc_jax.effects import BrushVoltageDrop
from pmdc_jax.errors import InputError
from pmdc_jax.motor import Drive, Motor
from pmdc_jax.recordings.angle import angle_of_counts
from pmdc_jax.recordings.clock import evenly_stamped, is_even
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.simulate import on_even_clock
from pmdc_jax.simulate.between_samples import mean_and_rise_of_pieces, pieces_of
from pmdc_jax.simulate.uneven import simulated_at_stamps

# the current settles within a sample, so L is identified only if the sampling times are right
MOTOR = {"R": 1.0, "L": 3.4e-4, "Kb": 0.07, "Kt": 0.07, "J": 1.16e-4, "f": 1.1e-4}
NOISE = np.array([0.05, 0.3])
STEP = 1e-3


def stamps(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Sampling times, s: even, jittered about even ones, with steps of random length, or at two rates."""
    if kind == "jitter":
        return STEP * (np.arange(count) + rng.uniform(-0.4, 0.4, count))
    steps = {
        "even": np.ones(count),
        "walk": rng.uniform(0.3, 1.7, count),
        "two rates": np.where(np.arange(count) < count // 2, 1.0, 5.0),
    }[kind]
    return STEP * np.append(0.0, np.cumsum(steps[1:]))


def state_matrix() -> np.ndarray:
    """Of current, speed, voltage and load, 1/s; the last two are constant."""
    m = MOTOR
    A = np.zeros((4, 4))
    A[0, :3] = -m["R"] / m["L"], -m["Kb"] / m["L"], 1 / m["L"]
    A[1, :2], A[1, 3] = (m["Kt"] / m["J"], -m["f"] / m["J"]), -1 / m["J"]
    return A


def record(time: np.ndarray, rng: np.random.Generator, noise: np.ndarray = NOISE) -> Recording:
    """A run with steps of voltage and load, held from stamp to stamp."""
    voltage = np.repeat(rng.uniform(-15, 15, len(time)), rng.integers(8, 40, len(time)))[: len(time)]
    load = np.repeat(rng.uniform(-0.1, 0.1, len(time)), 150)[: len(time)]
    values, vectors = np.linalg.eig(state_matrix())
    back, states = np.linalg.inv(vectors), np.zeros((len(time), 2))
    for k, step in enumerate(np.diff(time)):
        whole = back @ np.r_[states[k], voltage[k], load[k]]
        states[k + 1] = (vectors @ (np.exp(values * step) * whole)).real[:2]
    current, speed = (states + noise * rng.normal(size=states.shape)).T
    return Recording("r", time, voltage, current, speed, load)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walk", "jitter", "two rates"])
def test_a_motor_is_identified_from_uneven_samples(kind):
    rng = np.random.default_rng(21)
    run = record(stamps(kind, 2400, rng), rng)
    result = pmdc_jax.identify([run])
    for name, true in MOTOR.items():
        estimate = result.parameters[name]
        # so short a run determines friction to a few per cent only
        assert abs(estimate.value / true - 1) < (0.05 if name == "f" else 0.01), name
        assert abs(estimate.value - true) < 3 * estimate.stderr, name
    fit = result.fit["r"]
    assert fit.speed_rmse == pytest.approx(NOISE[1], rel=0.1)
    assert fit.current_rmse == pytest.approx(NOISE[0], rel=0.1)


@pytest.mark.parametrize("seed", [55, 56, 57])
def test_an_inductance_that_settles_within_a_sample_has_an_honest_interval(seed):
    """Mostly the jitter of the clock shows it: derivatives at even samples promise three times too much."""
    rng = np.random.default_rng(seed)
    time = 2.5 * stamps("jitter", 2400, rng)  # L / R is a seventh of a sample
    estimate = pmdc_jax.identify([record(time, rng)]).parameters["L"]
    assert abs(estimate.value - MOTOR["L"]) < 3 * estimate.stderr
    assert estimate.stderr < 0.02 * MOTOR["L"]


@pytest.mark.slow
def test_an_effect_is_diagnosed_from_uneven_samples():
    """The samples are shifted along the motion with the effect: that without it would keep L 12 % off."""
    rng, dead_zone, runs = np.random.default_rng(41), 1.0, []
    for name in ("one", "other"):
        driven = record(stamps("jitter", 3000, rng), rng)
        command = driven.voltage + dead_zone * np.sign(driven.voltage)
        runs.append(attrs.evolve(driven, name=name, voltage=command))
    found = pmdc_jax.diagnose(runs)
    assert found.verdict == "named"
    assert [effect.name for effect in found.effects] == ["input_dead_zone"]
    for name, true in {**MOTOR, "input_dead_zone.width_V": dead_zone}.items():
        estimate = found.final.parameters[name]
        assert abs(estimate.value - true) < min(3 * estimate.stderr, 0.03 * true), name


def with_brush_drop(time: np.ndarray, voltage: np.ndarray, drop: float) -> np.ndarray:
    """Current and speed with a set-valued brush drop, in many implicit steps from stamp to stamp."""
    R, L, Kb, Kt, J, f = MOTOR.values()
    i, w, states = 0.0, 0.0, np.zeros((len(time), 2))
    for k, step in enumerate(np.diff(time) / 400):
        for _ in range(400):
            free = (i + step * (voltage[k] - Kb * w) / L) / (1 + step * R / L)
            i = np.sign(free) * max(abs(free) - step * drop / (L + step * R), 0.0)
            w = (w + step * Kt * i / J) / (1 + step * f / J)
        states[k + 1] = i, w
    return states


def test_a_brush_drop_is_simulated_at_uneven_stamps():
    """Also where the voltage jumps within a sample of the even clock and the drop changes its sign with it."""
    rng, drop = np.random.default_rng(42), 0.8
    time, voltage = stamps("jitter", 240, rng), np.repeat(rng.choice([-12.0, 12.0], 24), 10)
    run = Recording("r", time, voltage, *with_brush_drop(time, voltage, drop).T, load=np.zeros(240))
    found = pmdc_jax.simulate(Motor(**MOTOR, effects=(BrushVoltageDrop(np.asarray(drop)),)), run)
    linear = pmdc_jax.simulate(Motor(**MOTOR), run)
    for got, without, true in ((found.current, linear.current, run.current), (found.speed, linear.speed, run.speed)):
        error, effect = got - true, without - true
        # the drop reverses when the current does, a little after the voltage
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(effect**2))


@pytest.mark.parametrize("kind", ["jitter", "walk", "two rates"])
def test_a_linear_motor_is_simulated_exactly_at_uneven_stamps(kind):
    rng = np.random.default_rng(22)
    run = record(stamps(kind, 300, rng), rng, 0 * NOISE)
    found = pmdc_jax.simulate(Motor(**MOTOR), run)
    np.testing.assert_allclose(found.speed, run.speed, atol=1e-9 * np.ptp(run.speed))
    np.testing.assert_allclose(found.current, run.current, atol=1e-9 * np.ptp(run.current))


def test_an_interpolated_voltage_keeps_its_mean_and_first_moment_in_every_even_sample():
    """Against quadrature over each even sample; and the motor at the stamps against many short steps."""
    rng = np.random.default_rng(23)
    run = record(stamps("walk", 60, rng), rng, 0 * NOISE)
    even = on_even_clock(run)
    mean, rise = mean_and_rise_of_pieces(even, pieces_of(even, first_order_hold=True))
    share = (np.arange(2000) + 0.5) / 2000
    for k, begin in enumerate(even.time):
        drive = np.interp(begin + even.sample_time * share, run.time, run.voltage)
        assert mean[k] == pytest.approx(drive.mean(), abs=1e-4)
        assert rise[k] == pytest.approx(12 * np.mean((share - 0.5) * drive), abs=1e-3)
    fine, unloaded = 400, attrs.evolve(even, load=None, resampled_from=attrs.evolve(run, load=None))
    transition = expm(state_matrix() * even.sample_time / fine)
    straight, true = np.zeros((2, len(even) * fine + 1, 4))
    middles = (np.arange(fine) + 0.5) / fine
    for k in range(len(even) * fine):
        at, part = divmod(k, fine)
        now = even.time[at] + even.sample_time * middles[part]
        straight[k, 2] = mean[at] + rise[at] * (middles[part] - 0.5)
        true[k, 2] = np.interp(now, run.time, run.voltage)
        for states in (straight, true):
            states[k + 1, :2] = (transition @ states[k])[:2]
    seen = straight[:-1:fine, :2]
    then = simulated_at_stamps(Motor(**MOTOR), Drive(), unloaded, seen, first_order_hold=True)
    times = even.time[0] + even.sample_time / fine * np.arange(len(true))
    for c in range(2):
        want = np.interp(run.time, times, true[:, c])
        # the error of the short steps
        np.testing.assert_allclose(then[:, c], want, atol=1e-4 * np.ptp(want))


def moved(state: np.ndarray, voltage: float, slope: float, load: float, seconds: float) -> np.ndarray:
    """Current, speed and angle after this time, with a voltage that changes by `slope` in V/s."""
    A = np.zeros((6, 6))  # of current, speed, voltage, load, slope and angle
    A[:4, :4] = state_matrix()
    A[2, 4] = A[5, 1] = 1.0
    return (expm(A * seconds) @ [state[0], state[1], voltage, load, slope, state[2]])[[0, 1, 5]]


@pytest.mark.parametrize("first_order_hold", [False, True])
def test_mean_speeds_between_uneven_stamps_are_exact_for_a_linear_motor(first_order_hold):
    """A mean begins at the last known angle."""
    rng = np.random.default_rng(26)
    run = record(stamps("walk", 60, rng), rng, 0 * NOISE)
    true = np.zeros((len(run), 3))
    for k, seconds in enumerate(np.diff(run.time)):
        slope = first_order_hold * (run.voltage[k + 1] - run.voltage[k]) / seconds
        true[k + 1] = moved(true[k], run.voltage[k], slope, run.load[k], seconds)
    angle = np.where(np.isin(np.arange(len(run)), [7, 20, 21]), np.nan, true[:, 2])
    even = on_even_clock(attrs.evolve(run, speed=None, angle=angle))
    mean, rise = mean_and_rise_of_pieces(even, pieces_of(even, first_order_hold))
    seen, step = np.zeros((len(even), 3)), even.sample_time
    for k in range(len(even) - 1):
        seen[k + 1] = moved(seen[k], mean[k] - rise[k] / 2, rise[k] / step, even.load[k], step)
    found = simulated_at_stamps(Motor(**MOTOR), Drive(), even, seen[:, :2], first_order_hold, mean_speed=True)
    np.testing.assert_allclose(found[:, 0], true[:, 0], atol=1e-9 * np.ptp(true[:, 0]))
    assert np.flatnonzero(np.isnan(found[:, 1])).tolist() == [0, 7, 20, 21]
    np.testing.assert_allclose(found[:, 1], even.recorded.speed, atol=1e-9 * np.ptp(true[:, 1]))


@pytest.mark.slow
def test_a_motor_is_identified_from_encoder_counts_at_uneven_stamps():
    """With a fluctuating torque: taken as instantaneous speeds, the counts would give an L that is 15 % off."""
    rng, count = np.random.default_rng(27), 4000
    time, voltage = 4 * stamps("walk", count, rng), np.repeat(rng.uniform(-15, 15, count // 40), 40)
    torque, states = np.zeros(count), np.zeros((count, 3))
    for k, seconds in enumerate(np.diff(time)):
        keep = np.exp(-seconds / 0.1)
        torque[k + 1] = keep * torque[k] + 0.005 * np.sqrt(1 - keep**2) * rng.normal()
        states[k + 1] = moved(states[k], voltage[k], 0.0, torque[k], seconds)
    step = 2 * np.pi / 4096
    current = states[:, 0] + NOISE[0] * rng.normal(size=count)
    run = Recording("counts", time, voltage, current, angle=step * np.floor(states[:, 2] / step))
    found = pmdc_jax.identify([run], unloaded=True, tie=[("Kt", "Kb")])
    for name in ("R", "L", "Kb", "J"):
        estimate = found.parameters[name]
        assert abs(estimate.value - MOTOR[name]) < 3 * estimate.stderr, name
        assert estimate.stderr < 0.02 * MOTOR[name], name


def counted(time: np.ndarray, rng: np.random.Generator, count: float, digits: int) -> np.ndarray:
    """A speed in counts of an encoder over each interval, with time stamps rounded to so many digits."""
    angle = np.cumsum(np.repeat(rng.uniform(-150, 150, len(time) // 50), 50) * np.diff(time, prepend=0.0))
    counts = np.diff(np.floor(angle / count), prepend=0.0)
    return counts * count / np.diff(np.round(time, digits), prepend=np.nan)


@pytest.mark.parametrize("digits", [9, 6])
def test_counts_over_uneven_intervals_are_an_angle(digits):
    rng = np.random.default_rng(28)
    time, count = stamps("jitter", 1000, rng), 2 * np.pi / 500
    speed = np.nan_to_num(counted(time, rng, count, digits))
    angle = angle_of_counts(np.round(time, digits), speed)
    assert angle is not None
    np.testing.assert_allclose(np.diff(angle), (speed * np.diff(np.round(time, digits), prepend=0.0))[1:], atol=1e-12)


def test_other_speeds_at_uneven_stamps_are_no_counts():
    """Without steps, with those of a converter, and as counts over the even intervals of another clock."""
    rng = np.random.default_rng(29)
    time, count = stamps("jitter", 1000, rng), 2 * np.pi / 500
    speed = np.repeat(rng.uniform(-150, 150, 20), 50) + rng.normal(size=1000)
    for other in (speed, np.round(speed), np.nan_to_num(counted(stamps("even", 1000, rng), rng, count, 9)), 0 * speed):
        assert angle_of_counts(time, other) is None
    assert angle_of_counts(time, np.where(np.arange(1000) == 7, np.nan, speed)) is None


def test_pieces_cover_every_even_sample_once():
    rng = np.random.default_rng(24)
    even = on_even_clock(record(stamps("walk", 200, rng), rng))
    pieces = pieces_of(even, first_order_hold=False)
    of_sample = np.bincount(pieces.even, pieces.length)
    np.testing.assert_allclose(of_sample, even.sample_time, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_jittered_stamps_of_even_samples_are_replaced_by_even_ones(seed):
    """Stamps of samples that were truly taken unevenly are kept: the speed tells the two apart."""
    rng = np.random.default_rng(30 + seed)
    jittered = stamps("jitter", 2000, rng)
    true = record(jittered, rng)
    assert not is_even(evenly_stamped(true).time)
    stamped = attrs.evolve(record(stamps("even", 2000, rng), rng), time=jittered)
    corrected = evenly_stamped(stamped)
    assert is_even(corrected.time)
    assert corrected.time[-1] == pytest.approx(STEP * 1999, abs=STEP / 10)


def test_a_long_gap_is_refused():
    rng = np.random.default_rng(40)
    run = record(stamps("even", 100, rng), rng)
    time = run.time + 60.0 * (np.arange(100) >= 50)
    with pytest.raises(InputError, match=r"sample 51.*a gap of 60 s.*split the run"):
        attrs.evolve(run, time=time)
