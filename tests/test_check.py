"""The check is silent on good data and finds each injected fault."""

from __future__ import annotations

import time as clock
from functools import cache

import numpy as np
import pytest
from attrs import evolve
from linear_motor import exact_step

from pmdc_jax.checks.check import check
from pmdc_jax.checks.plausibility import speed_of
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.simulate import on_even_clock

EXCITATIONS = ("steps", "prbs", "staircase", "triangle", "load_cycles", "spin_up")


def simulate(motor, dt, voltage, load, coulomb=0.0):
    """Current and speed of a motor by the exact step between samples, from rest."""
    A, B = exact_step(motor, dt)
    state, states = np.zeros(2), []
    for v, torque in zip(voltage, load, strict=True):
        states.append(state)
        state = A @ state + B @ [v, torque]
        slowed = abs(state[1]) - dt * coulomb / motor["J"]
        state = np.array([state[0], np.sign(state[1]) * max(slowed, 0.0)])
    return np.array(states).T


def excite(rng, kind, samples, settle, rated):
    """A voltage and a load torque; `settle`, samples in a mechanical time constant."""
    k = np.arange(samples)
    voltage, load = np.full(samples, 0.7), np.zeros(samples)
    if kind == "steps":
        levels = rng.uniform(-1, 1, samples // (4 * settle) + 2)
        voltage = levels[k // (4 * settle)]
    elif kind == "prbs":
        voltage = 0.6 + 0.3 * rng.choice([-1, 1], samples)[k // max(settle // 3, 1)]
    elif kind == "staircase":
        voltage = np.abs((k // (2 * settle)) % 10 - 5) / 5
    elif kind == "triangle":
        voltage = np.abs(k / samples * 4 % 2 - 1) * 2 - 1
    elif kind == "load_cycles":
        load = 0.3 * ((k // (5 * settle)) % 2)
    return 24 * voltage, rated * load


@cache
def good_run(seed, kind=None, samples=3000, noise=None, coulomb=None):
    """A recording of a random motor with plausible noise, and sometimes with rounded speed."""
    rng = np.random.default_rng(seed)
    kind = kind or EXCITATIONS[seed % len(EXCITATIONS)]
    R, Kb = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-2, np.log10(0.5))
    mechanical = 10 ** rng.uniform(-1.7, -0.3)
    J = mechanical * Kb**2 / R
    L, f = R * mechanical * 10 ** rng.uniform(-2.5, -0.8), 0.03 * Kb**2 / R
    motor = {"R": R, "L": L, "Kb": Kb, "Kt": Kb, "J": J, "f": f}
    settle = int(10 ** rng.uniform(1, 2.3))
    dt = mechanical / settle
    rated = Kb * 24 / R
    voltage, load = excite(rng, kind, samples, settle, rated)
    dry = rated * 10 ** rng.uniform(-3, -1.5) if coulomb is None else coulomb * rated
    current, speed = simulate(motor, dt, voltage, load, dry)
    noise = 10 ** rng.uniform(-4, -2) if noise is None else noise
    current = current + noise * np.ptp(current) * rng.normal(size=samples)
    speed = speed + noise * np.ptp(speed) * rng.normal(size=samples)
    if seed % 3 == 0:  # an encoder counted over the sampling time
        count = np.ptp(speed) / 300
        speed = count * np.round(speed / count)
    time = rng.uniform(0, 100) + dt * np.arange(samples)
    loaded = load if kind == "load_cycles" or seed % 2 else None
    return Recording(f"{kind}-{seed}", time, voltage, current, speed, loaded)


def problems(recordings):
    """The findings that are warnings or errors."""
    return [finding for finding in check(recordings) if finding.severity in ("warning", "error")]


def shifted(run, **late):
    """The run with some channels `late` by so many samples."""
    reach = max(abs(d) for d in late.values())
    length = len(run) - 2 * reach
    cut = {q: values[reach : reach + length] for q, values in run.columns().items()}
    cut |= {q: getattr(run, q)[reach - d : reach - d + length] for q, d in late.items()}
    return evolve(run, **cut)


@pytest.mark.parametrize("seed", range(50))
def test_good_data_give_no_warning(seed):
    run = good_run(seed)
    angle = np.cumsum(run.speed) * run.sample_time
    assert problems([run]) == []
    assert problems([evolve(run, current=None), evolve(run, voltage=None)]) == []
    assert problems([evolve(run, angle=angle), evolve(run, angle=angle, speed=None)]) == []


def test_jumps_of_a_current_are_noted_only_without_a_voltage():
    steps = good_run(0)
    jumping = evolve(steps, current=np.repeat([1.0, -2.0], [700, len(steps) - 700]), voltage=None)
    (note,) = [f for f in check([jumping]) if "jumps" in f.what]
    assert "by up to 3 A" in note.what and "sample 700 " in note.where
    smooth = evolve(jumping, current=np.sin(0.01 * np.arange(len(steps))))
    with_voltage = evolve(jumping, voltage=steps.voltage)
    assert not any("jumps" in f.what for run in (smooth, with_voltage) for f in check([run]))


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("kind", EXCITATIONS)
def test_clean_and_very_noisy_data_give_no_warning(kind, noise):
    for seed in range(4):
        assert problems([good_run(seed, kind, noise=noise)]) == []


def test_a_closed_loop_with_dry_friction_and_brush_drop_gives_no_warning():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        Kb, R, J, dt = 0.05, 0.8, 5e-5, 1e-3
        state, integral, rows = np.zeros(2), 0.0, []
        for k in range(3000):
            measured = state + rng.normal(size=2) * [0.05, 0.5]
            error = 200 * np.sin(k // 300) - measured[1]
            integral += error * dt
            voltage = np.clip(0.05 * error + 0.3 * integral, -24, 24)
            rows.append([voltage, *measured])
            current = (voltage - Kb * state[1] - 0.8 * np.tanh(state[0] / 0.1)) / R
            torque = Kb * current - 0.03 * np.tanh(state[1])
            state = np.array([0.3 * state[0] + 0.7 * current, state[1] + torque * dt / J])
        v, i, w = np.array(rows).T
        assert problems([Recording("loop", dt * np.arange(3000), v, i, w)]) == []


def test_rounded_or_drifting_time_stamps_are_not_jitter():
    run = good_run(1)
    grid = 1e-3 * np.arange(len(run))
    drifting = grid * (1 + 1e-4 * np.sin(grid))
    for time in (np.round(grid, 5), drifting):
        assert problems([evolve(run, time=time)]) == []


def test_a_run_at_rest_among_others_is_only_noted():
    run, rng = good_run(0, "steps"), np.random.default_rng(0)
    current = 0.02 + 0.01 * rng.normal(size=len(run))
    rest = evolve(run, name="rest", voltage=0 * run.voltage, current=current, speed=0 * run.speed)
    assert problems([run, rest]) == []
    assert [f.run for f in check([run, rest]) if "no signal varies" in f.what] == ["rest"]
    assert [f.severity for f in problems([rest])] == ["error"]


def test_a_load_of_zero_is_no_finding_and_a_constant_one_is_noted():
    run = good_run(0, "steps")
    assert check([evolve(run, load=np.zeros(len(run)))]) == check([run])
    (note,) = set(check([evolve(run, load=np.full(len(run), 0.2))])) - set(check([run]))
    assert (note.column, note.severity) == ("load", "note")
    assert "the load column is constant: used as a known load of" in note.what


def with_gap(run):
    keep = np.r_[0:1000, 1400 : len(run)]
    return evolve(run, **{q: values[keep] for q, values in run.columns().items()})


def with_jitter(run):
    scatter = np.random.default_rng(0).uniform(-0.2, 0.2, len(run))
    return evolve(run, time=run.time + run.sample_time * scatter)


def with_missing_values(run):
    speed = run.speed.copy()
    speed[100:400] = np.nan
    return evolve(run, speed=speed)


def test_dropped_rows_are_gaps_and_no_jitter():
    """Each of one, two or three rows; steps of three samples or fewer leave no output missing."""
    run = good_run(1, "prbs")
    for drops, severity in (({149: 3, 551: 1, 1245: 2}, "warning"), ({551: 1, 1245: 1}, "note")):
        dropped = [row + k for row, count in drops.items() for k in range(count)]
        keep = np.setdiff1d(np.arange(len(run)), dropped)
        short = evolve(run, **{q: values[keep] for q, values in run.columns().items()})
        (found,) = [f for f in check([short]) if f.column == "time"]
        assert found.severity == severity
        assert f"{len(drops)} gaps in time" in found.what
        assert f"sample interval of {run.sample_time:.4g} s" in found.what


def test_time_stamps_rounded_to_a_coarse_clock_are_no_gaps():
    run = good_run(1, "prbs")
    coarse = evolve(run, time=1e-3 * np.floor(1.4 * np.arange(len(run))))
    (found,) = [f for f in check([coarse]) if f.column == "time"]
    assert "jitter by" in found.what and "sample interval of 0.0014 s" in found.what


def clipped(run, quantity, share):
    values = getattr(run, quantity)
    limit = np.min(values) + share * np.ptp(values)
    return evolve(run, **{quantity: np.minimum(values, limit)})


def with_strong_noise(run):
    noise = np.random.default_rng(0).normal(size=len(run)) * 3 * np.std(run.speed)
    return evolve(run, speed=run.speed + noise)


def with_angle(run, scale):
    return evolve(run, angle=scale * np.cumsum(run.speed) * run.sample_time)


def wrapped(run, step=0.05):
    return evolve(run, speed=None, angle=np.mod(step * np.arange(len(run)), 2 * np.pi))


@pytest.mark.parametrize("step", [0.0022, 0.05, 2.0])
def test_a_wrapped_angle_is_noted_and_unwrapped(step):
    """Wrapped once in the run, often, and by a rotor that turns by a third of a turn per sample."""
    run = wrapped(good_run(1, "prbs"), step)
    (found,) = [f for f in check([run]) if f.column == "angle" and "turn" in f.what]
    wraps = int(step * (len(run) - 1) / (2 * np.pi))
    assert found.severity == "note"
    assert f"wraps after each turn, {wraps} time" in found.what
    for speed in (on_even_clock(run).speed[1:], speed_of(run)):
        np.testing.assert_allclose(speed, step / run.sample_time)


def test_jittered_time_stamps_are_noted():
    for seed in (1, 7, 13):
        (found,) = [f for f in check([with_jitter(good_run(seed, "prbs"))]) if f.column == "time"]
        assert found.severity == "note"
        assert "jitter by" in found.what
        assert "the signals were sampled evenly" in found.what


RPM = 30 / np.pi
FAULTS = [
    ("gap", with_gap, "time", "1 gap in time, the longest"),
    ("holes", with_missing_values, "speed", "300 of 3000 values are missing"),
    ("clipped current", lambda run: clipped(run, "current", 0.7), "current", "clipped at"),
    ("clipped speed", lambda run: clipped(run, "speed", 0.7), "speed", "clipped at"),
    ("voltage sign", lambda run: evolve(run, voltage=-run.voltage), "voltage", "sign"),
    ("speed sign", lambda run: evolve(run, speed=-run.speed), "speed", "sign"),
    ("current sign", lambda run: evolve(run, current=-run.current), "current", "sign"),
    (
        "speed sign without current",
        lambda run: evolve(run, speed=-run.speed, current=None),
        "speed",
        "it falls where the voltage",
    ),
    (
        "current sign without voltage",
        lambda run: evolve(run, current=-run.current, voltage=None),
        "speed",
        "it falls where the current",
    ),
    ("late current", lambda run: shifted(run, current=3), "current", "3 samples"),
    ("early current", lambda run: shifted(run, current=-5), "current", "early"),
    ("late speed", lambda run: shifted(run, speed=8), "speed", "late"),
    ("early speed", lambda run: shifted(run, speed=-8), "speed", "early"),
    ("late both", lambda run: shifted(run, speed=8, current=8), "voltage", "8 samples"),
    ("buried speed", with_strong_noise, "speed", "it varies less than its noise"),
    ("angle in degrees", lambda run: with_angle(run, 180 / np.pi), "angle", "in degrees"),
    ("speed in rpm by angle", lambda run: with_angle(run, 1 / RPM), "angle", "speed were in rpm"),
    ("angle the other way", lambda run: with_angle(run, -1), "angle", "wrong sign"),
    ("impossible speed", lambda run: evolve(run, speed=1e3 * run.speed), "speed", "too fast"),
    ("voltage in mV", lambda run: evolve(run, voltage=1e3 * run.voltage), "voltage", "too high"),
    ("current in µA", lambda run: evolve(run, current=1e6 * run.current), "current", "less than any"),
]


@pytest.mark.parametrize(("inject", "column", "what"), [pytest.param(*fault, id=name) for name, *fault in FAULTS])
def test_each_fault_is_found(inject, column, what):
    for seed in (1, 7, 13):
        run = good_run(seed, "prbs", noise=1e-3)
        found = problems([inject(run)])
        assert any(f.column == column and what in f.what for f in found), (run.name, found)


@pytest.mark.parametrize(
    ("fault", "column", "what"),
    [
        (lambda run: evolve(run, speed=RPM * run.speed), "speed", "as if the speed were in rpm"),
        (lambda run: evolve(run, speed=6 * RPM * run.speed), "speed", "in deg/s, not rad/s"),
        (lambda run: evolve(run, load=-run.load), "load", "its sign is reversed"),
        (lambda run: evolve(run, load=1e3 * run.load), "load", "in mN*m, not N m"),
        (lambda run: evolve(run, current=1e3 * run.current), "current", "in mA, not A"),
    ],
)
def test_a_known_load_reveals_wrong_units_and_a_wrong_sign_of_the_load(fault, column, what):
    for seed in range(1, 15, 2):
        runs = [good_run(seed, "steps"), good_run(seed, "load_cycles")]
        assert problems(runs) == []
        found = problems([fault(run) for run in runs])
        assert any(f.column == column and what in f.what for f in found)


def test_wrong_signs_are_found_for_every_motor_and_excitation():
    for seed in range(18):
        for column in ("voltage", "current", "speed"):
            run = good_run(seed)
            found = problems([evolve(run, **{column: -getattr(run, column)})])
            assert [f.column for f in found if "sign" in f.what] == [column]


@pytest.mark.parametrize("columns", [("speed",), ("current",), ("current", "speed")])
def test_unsigned_channels_are_found(columns):
    for seed in range(6):
        run = good_run(seed, "steps")
        unsigned = evolve(run, **{column: np.abs(getattr(run, column)) for column in columns})
        found = [f for f in problems([unsigned]) if "its sign is missing" in f.what]
        assert [f.column for f in found] == list(columns), seed


def test_a_run_without_any_variation_is_an_error():
    t = np.arange(100) / 100
    flat = Recording("flat", t, np.full(100, 5.0), np.ones(100), np.full(100, 40.0))
    assert [f.severity for f in check([flat])] == ["error"]


def test_a_blocked_shaft_gives_a_warning():
    run = good_run(0, "steps")
    blocked = evolve(run, name="blocked", speed=np.zeros(len(run)))
    assert [(f.column, f.severity) for f in problems([blocked])] == [("speed", "warning")]
    assert problems([run, blocked]) == []


def test_slow_sampling_is_noted():
    motor = {"R": 1.0, "Kb": 0.05, "Kt": 0.05, "J": 1e-4, "f": 1e-6}
    count = 2000
    voltage = 12.0 * (np.arange(count) // 200 % 2)

    def findings(L):
        i, w = simulate(motor | {"L": L}, 1e-3, voltage, np.zeros(count))
        return check([Recording("run", np.arange(count) * 1e-3, voltage, i, w)])

    assert findings(5e-3) == ()
    (note,) = findings(1e-5)
    assert note.severity == "note" and "settles within one sample" in note.what


def test_a_million_rows_are_checked_in_seconds():
    run, count = good_run(7, "prbs"), 1_000_000
    repeated = {q: np.resize(values, count) for q, values in run.columns().items()}
    big = evolve(run, **repeated | {"time": np.arange(count) * run.sample_time})
    begin = clock.perf_counter()
    check([big])
    assert clock.perf_counter() - begin < 4  # on a machine that others use too
