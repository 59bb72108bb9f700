"""Simulation against closed forms, scipy and plain sequential loops."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from attrs import evolve
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from linear_motor import PAPER, exact_step, state_space
from scipy import linalg, signal
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_info, threadpool_limits

import pmdc_jax
from pmdc_jax import InputError
from pmdc_jax.effects import CoulombFriction, ResistanceHeating
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.recordings.clock import is_even
from pmdc_jax.recordings.recording import OVER_LAST, Recording
from pmdc_jax.recordings.recording_file import write_recording
from pmdc_jax.runtime.threads import map_in_threads, one_blas_thread
from pmdc_jax.simulate import (
    RunUnknowns,
    Tape,
    free_run,
    on_even_clock,
    reference_solution,
    sensitivities,
    squared_errors,
)
from pmdc_jax.simulate.exponential import phi_functions

BLOCKS = 4  # every tape below has this shape, so that few are compiled
SAMPLES = 128 * BLOCKS


def motor(effects=(), **changes) -> Motor:
    return Motor(**{n: np.asarray(x, float) for n, x in (PAPER | changes).items()}, effects=effects)


def population(motors: list[dict[str, float]]) -> Motor:
    return Motor(**{n: np.array([m[n] for m in motors]) for n in PARAMETERS})


def recording(name="run", samples=SAMPLES, step=1e-3, seed=0, **columns) -> Recording:
    """Voltage and load that change now and then, and measured outputs that are only noise."""
    rng = np.random.default_rng(seed)
    time = step * np.arange(samples)
    levels = np.repeat(rng.uniform([-18, -0.5], [18, 0.5], (samples // 16 + 1, 2)), 16, axis=0)
    given = {
        "voltage": levels[:samples, 0],
        "load": levels[:samples, 1],
        "current": rng.normal(5.0, 3.0, samples),
        "speed": rng.normal(30.0, 20.0, samples),
    }
    return Recording(name, time, **(given | columns))


def exact_steps(m: dict[str, float], run: Recording, start) -> np.ndarray:
    """Current and speed (samples, 2) by scipy's matrix exponential."""
    A, B = exact_step(m, run.sample_time)
    states = [np.asarray(start, float)]
    for held in np.stack([run.voltage, run.load], 1)[:-1]:
        states.append(A @ states[-1] + B @ held)
    return np.array(states)


def simulated_alone(m: Motor, run: Recording, start=None, before: Sequence[Recording] = ()) -> np.ndarray:
    """Free run of one recording by the package, (samples, 2); on one tape with those it is `before`, if any."""
    tape = Tape.from_recordings([run, *before], unloaded=True)
    if start is not None:
        tape = dataclasses.replace(tape, initial=np.array([start]))
    outputs = free_run(m, tape)
    return np.stack([tape.samples_of(0, outputs[:, c], len(run)) for c in range(2)], 1)


def largest_error(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest error of any sample, relative to the largest value of that output."""
    return float((np.abs(found - expected).max(0) / np.abs(expected).max(0)).max())


# ------------------------------------------------------------------------------ the exact step


class Linear(NamedTuple):
    changes: dict[str, float]
    step: float


LINEAR = {
    "paper": Linear({}, 1e-3),
    "fast sampling": Linear({}, 1e-5),
    "slow sampling": Linear({}, 0.1),
    "very stiff": Linear({"L": PAPER["R"] * 1e-6}, 1e-3),
    "very stiff, slow": Linear({"L": PAPER["R"] * 1e-6}, 0.1),
    "oscillatory": Linear({"L": 5e-3, "J": 1e-4}, 1e-3),
    "oscillatory, undersampled": Linear({"L": 5e-3, "J": 1e-4, "R": 0.02, "f": 1e-6}, 0.1),
    "nearly equal poles": Linear({"L": 0.157378**2 * 0.000466 / (4 * 0.0492 * 0.0501)}, 1e-3),
    "no friction": Linear({"f": 0.0}, 1e-3),
    "heavy": Linear({"J": 50.0}, 1e-2),
}


@pytest.mark.parametrize("case", LINEAR.values(), ids=LINEAR.keys())
def test_the_linear_motor_is_exact(x64, case):
    run, start = recording(step=case.step), (3.0, -20.0)
    expected = exact_steps(PAPER | case.changes, run, start)
    assert largest_error(simulated_alone(motor(**case.changes), run, start), expected) < 1e-10


def test_random_linear_motors_are_exact(x64):
    """Forty motors drawn over four decades, each at a sample time of its own.

    The sample time has six digits, as a logger's clock has: the tape keeps nine.
    """
    rng = np.random.default_rng(1)
    for k in range(40):
        m = {n: x * 10 ** rng.uniform(-2, 2) for n, x in PAPER.items()}
        run = recording(step=float(f"{10 ** rng.uniform(-5, -1):.6g}"), seed=k)
        expected = exact_steps(m, run, (1.0, 2.0))
        assert largest_error(simulated_alone(motor(**m), run, (1.0, 2.0)), expected) < 1e-9, m


def test_the_linear_motor_matches_a_digital_filter_of_scipy(x64):
    """Voltage to speed, from rest, by scipy's own discretisation and filter."""
    run = recording(load=np.zeros(SAMPLES))
    A, B = state_space(PAPER)
    b, a = signal.ss2tf(*signal.cont2discrete((A, B[:, :1], np.eye(2), np.zeros((2, 1))), 1e-3)[:4])
    expected = np.stack([signal.lfilter(row, a, run.voltage) for row in b], 1)
    assert largest_error(simulated_alone(motor(), run, (0.0, 0.0)), expected) < 1e-9


def test_phi_functions_match_scipy(x64):
    """phi_k(z) is a block of the exponential of a matrix of z and identity blocks."""
    rng = np.random.default_rng(2)
    z = rng.standard_normal((2, 2, 30)) * 10.0 ** rng.uniform(-9, 1.5, 30)
    z[:, :, 0] = 0.0
    z[:, :, 1] = [[-1000.0, -3.0], [1e-2, -5e-4]]  # stiff: the electrical mode has decayed
    half, whole = jax.jit(phi_functions, static_argnums=1)(jnp.asarray(z), 3)
    for found, of in ((half, z / 2), (whole, z)):
        for k, phi in enumerate(found):
            for case in range(z.shape[-1]):
                expected = _phi_by_scipy(of[:, :, case], k)
                scale = np.abs(expected).max()
                np.testing.assert_allclose(phi[:, :, case], expected, rtol=0, atol=1e-10 * scale)


def _phi_by_scipy(z: np.ndarray, k: int) -> np.ndarray:
    chain = np.zeros((2 * (k + 1), 2 * (k + 1)))
    chain[:2, :2] = z
    for j in range(k):
        chain[2 * j : 2 * j + 2, 2 * j + 2 : 2 * j + 4] = np.eye(2)
    return linalg.expm(chain)[:2, -2:]


# -------------------------------------------------------------------- order with smooth effects

HEAT = {"rise_per_W": 2e-3, "time_constant_s": 0.08}


def rates_with_heating(t, x, v, load):
    """Rates of the motor whose resistance rises with the temperature of the winding."""
    i, w, rise = x
    m, R = PAPER, PAPER["R"] * (1 + x[2])
    return [
        (v - R * i - m["Kb"] * w) / m["L"],
        (m["Kt"] * i - m["f"] * w - load) / m["J"],
        (HEAT["rise_per_W"] * R * i**2 - rise) / HEAT["time_constant_s"],
    ]


def outputs_by_scipy(run: Recording, start) -> np.ndarray:
    """Current and speed, restarted at every sample because the inputs jump there."""
    states = [np.array(start, float)]
    for v, load in zip(run.voltage[:-1], run.load[:-1], strict=True):
        held = solve_ivp(
            rates_with_heating, (0, run.sample_time), states[-1], "DOP853", args=(v, load), rtol=1e-11, atol=1e-11
        )
        states.append(held.y[:, -1])
    return np.array(states)[:, :2]


@pytest.fixture(scope="module")
def heating():
    """A run of 64 samples of 4 ms, and its solution by scipy."""
    run = recording(samples=64, step=4e-3)
    return run, outputs_by_scipy(run, (5.0, 10.0, 0.0))


def sampled_more_often(run: Recording, times: int) -> Recording:
    """The same held inputs, sampled more often."""
    fine = {q: np.repeat(getattr(run, q), times) for q in ("voltage", "load", "current", "speed")}
    return Recording(run.name, run.sample_time / times * np.arange(times * len(run)), **fine)


def test_converges_with_order_four(x64, heating):
    run, expected = heating
    heated = motor((ResistanceHeating(**{n: np.asarray(x) for n, x in HEAT.items()}),))
    errors = []
    for times in (4, 8, 16):
        found = simulated_alone(heated, sampled_more_often(run, times), (5.0, 10.0))[::times]
        errors.append(largest_error(found, expected))
    # a sample of 4 ms is four steps of 1 ms
    assert largest_error(simulated_alone(heated, run, (5.0, 10.0)), expected) == pytest.approx(errors[0], rel=1e-3)
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 1e-5
    assert np.all(np.abs(orders - 4) < 0.4), (errors, orders)


def test_the_adaptive_reference_agrees_with_scipy(x64, heating):
    run, expected = heating
    heated = motor((ResistanceHeating(**{n: np.asarray(x) for n, x in HEAT.items()}),))
    found = reference_solution(heated, run.time, run.voltage, run.load, jnp.array([5.0, 10.0]))
    assert largest_error(np.asarray(found).T, expected) < 1e-8


# ------------------------------------------------------------------- blocks joined by shooting

EFFECTS = {
    "linear": (),
    "sticking": (CoulombFriction(np.asarray(0.15)),),
    "heating": (ResistanceHeating(np.asarray(2e-3), np.asarray(0.3)),),
}


@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS.keys())
def test_joined_blocks_match_a_sequential_run(x64, effects):
    """`free_run` guesses the states in which blocks begin and corrects them; `squared_errors` simulates block after
    block. With measured outputs of zero, and all weight on one sample, it gives the square of that sample."""
    run = recording(current=np.zeros(SAMPLES), speed=np.zeros(SAMPLES))
    tape = Tape.from_recordings([run])
    outputs = np.asarray(free_run(motor(effects), tape))
    one = jax.tree.map(lambda leaf: np.reshape(leaf, 1), motor(effects))
    for block, sample in ((0, 1), (0, 127), (1, 0), (1, 1), (2, 64), (3, 127)):
        weight = np.zeros_like(tape.weight)
        weight[block, :, sample] = 1.0
        only = dataclasses.replace(tape, weight=weight)
        squares = np.array([float(e[0]) for e in squared_errors(one, only)])
        np.testing.assert_allclose(np.abs(outputs[block, :, sample]), np.sqrt(squares), rtol=1e-7)


def test_a_current_that_decays_for_long_has_finite_sensitivities(x64):
    """At rest, where it falls by e^-20 from sample to sample, until its square, and then itself, underflows."""
    time = 5e-3 * np.arange(600)
    run = Recording("rest", time, np.where(time < 0.3, 6.0, 0.0), 0 * time, 0 * time)
    tape = Tape.from_recordings([evolve(run, averaging=OVER_LAST)])
    values = jnp.array([*(PAPER | {"L": PAPER["R"] / 4000}).values(), 0.1])

    def assemble(values):
        return Motor(*values[:6], effects=(CoulombFriction(values[6]),))

    seen, derivatives, *_ = sensitivities(assemble, values, tape)
    assert float(jnp.abs(seen[:, 1]).max()) > 50
    assert np.isfinite(seen).all()
    assert np.isfinite(derivatives).all()


def test_runs_on_one_tape_match_runs_simulated_alone(x64):
    """Runs of different rate, length, start and load on one tape do not affect each other."""
    m = motor((CoulombFriction(np.asarray(0.1)),))
    runs = [
        recording("slow", 200, 5e-3, seed=1),
        recording("fast", 150, 2e-4, seed=2),
        recording("short", 11, 1e-3, seed=3),
        recording("slow again", 128, 5e-3, seed=4),
    ]
    tape = Tape.from_recordings(runs)
    assert tape.value.shape[0] == 8  # one more than needed: the last block is empty
    offsets = np.array([0.0, 0.05, -0.02, 0.0])
    own = RunUnknowns.as_recorded(tape)._replace(load_offset=jnp.asarray(offsets))
    outputs = free_run(m, tape, own)
    for k, (run, offset) in enumerate(zip(runs, offsets, strict=True)):
        loaded = Recording(run.name, run.time, run.voltage, run.current, run.speed, run.load + offset)
        together = np.stack([tape.samples_of(k, outputs[:, c], len(run)) for c in range(2)], 1)
        # the slowest run determines for all into how many steps a sample is divided
        separate = simulated_alone(m, loaded, before=[recording("slowest", 10, 5e-3)])
        np.testing.assert_allclose(together, separate, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("count", [1, 2, 3, 16])
def test_a_tape_is_cut_into_parts_between_runs(x64, count):
    """Simulated part by part, the runs give what they give on the whole tape."""
    m = motor((CoulombFriction(np.asarray(0.1)),))
    lengths = (2900, 1000, 2200, 1900)
    tape = Tape.from_recordings([recording(samples=n, seed=k) for k, n in enumerate(lengths)])
    parts = tape.parts(count)
    assert len(parts) == {1: 1, 2: 2, 3: 3, 16: 4}[count]
    assert len({part.value.shape for part, _ in parts}) == 1
    assert all(part.begins[0] and np.all(part.weight[blocks:] == 0) for part, blocks in parts)
    outputs = np.concatenate([np.asarray(free_run(m, part))[:blocks] for part, blocks in parts])
    np.testing.assert_allclose(outputs, free_run(m, tape), rtol=1e-7, atol=1e-7)


# ---------------------------------------------------------------------------- other drives


def speed_by_closed_form(drive: np.ndarray, load: np.ndarray, step: float, start: float) -> np.ndarray:
    """Speed under a held torque: J dw/dt = drive - f w - load has a closed form over each sample."""
    rate, gain = np.exp(-PAPER["f"] / PAPER["J"] * step), 1 / PAPER["f"]
    speed = [start]
    for torque in (drive - load)[:-1]:
        speed.append(rate * speed[-1] + (1 - rate) * gain * torque)
    return np.array(speed)


def test_a_run_driven_by_torque_matches_the_closed_form(x64):
    run = recording(voltage=None, current=None, torque=np.sin(np.arange(SAMPLES) / 9))
    expected = speed_by_closed_form(run.torque, run.load, 1e-3, run.speed[0])
    found = pmdc_jax.simulate(motor(), run)
    np.testing.assert_allclose(found.speed, expected, rtol=1e-9, atol=1e-9)
    assert found.current is None


def test_a_run_driven_by_current_matches_the_closed_form(x64):
    """A measured current is interpolated, so its mean over each sample drives the motor."""
    run = recording(voltage=None, current=8 * np.sin(np.arange(SAMPLES) / 9))
    mean = (run.current + np.append(run.current[1:], run.current[-1])) / 2
    expected = speed_by_closed_form(PAPER["Kt"] * mean, run.load, 1e-3, run.speed[0])
    found = pmdc_jax.simulate(motor(), run)
    np.testing.assert_allclose(found.speed, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(found.current, run.current)


def test_a_voltage_alone_is_simulated_from_rest(x64, tmp_path):
    run = recording(load=None)
    measured = pmdc_jax.simulate(motor(), evolve(run, current=0 * run.time, speed=0 * run.time))
    unmeasured = evolve(run, current=None, speed=None)
    write_recording(unmeasured, tmp_path / "run.csv")
    for one in (unmeasured, tmp_path / "run.csv"):
        found = pmdc_jax.simulate(motor(), one)
        np.testing.assert_array_equal(found.speed, measured.speed)
        np.testing.assert_array_equal(found.current, measured.current)


# ------------------------------------------------------------------------------- squared errors

CANDIDATES = 32


@pytest.fixture(scope="module")
def candidates():
    rng = np.random.default_rng(5)
    return [{n: x * np.exp(0.3 * rng.standard_normal()) for n, x in PAPER.items()} for _ in range(CANDIDATES)]


def test_squared_errors_match_the_free_run(x64, candidates):
    run = recording()
    run.speed[40:60] = np.nan  # missing samples do not count
    tape = Tape.from_recordings([run])
    current, speed = squared_errors(population(candidates), tape)
    for k, m in enumerate(candidates):
        error = simulated_alone(motor(**m), run, tape.initial[0]) - np.stack([run.current, run.speed], 1)
        expected = np.nansum(error**2, 0)
        np.testing.assert_allclose([current[k], speed[k]], expected, rtol=1e-8)


def test_squared_errors_add_up_over_runs_of_different_rates(x64, candidates):
    runs = [recording(), recording(step=4e-3)]
    motors = population(candidates)
    separate = [np.stack(squared_errors(motors, Tape.from_recordings([run]))) for run in runs]
    together = np.stack(squared_errors(motors, Tape.from_recordings(runs)))
    np.testing.assert_allclose(together, separate[0] + separate[1], rtol=1e-10)


INVALID_VALUES = {"R": np.nan, "L": 0.0, "Kb": 1e200, "Kt": -1e6, "J": 1e-300, "f": -1e9}


def test_an_invalid_candidate_has_huge_errors_and_affects_no_other(x64, candidates):
    tape = Tape.from_recordings([recording()])
    clean = np.stack(squared_errors(population(candidates), tape))
    with_invalid = [dict(m) for m in candidates]
    for k, (name, value) in enumerate(INVALID_VALUES.items()):
        with_invalid[k][name] = value
    found = np.stack(squared_errors(population(with_invalid), tape))
    assert not np.isnan(found).any()
    assert np.all(found[:, : len(INVALID_VALUES)] > 1e3 * clean[:, : len(INVALID_VALUES)]), found
    assert np.isinf(found[:, :2]).all()
    np.testing.assert_array_equal(found[:, len(INVALID_VALUES) :], clean[:, len(INVALID_VALUES) :])


# --------------------------------------------------------------------------------- even samples


def test_nearly_even_samples_are_not_resampled():
    run = recording(step=1e-3)
    noisy = Recording("r", run.time + 1e-7 * np.sin(np.arange(SAMPLES)), run.voltage, speed=run.speed)
    even = on_even_clock(noisy)
    np.testing.assert_array_equal(even.voltage, run.voltage)
    np.testing.assert_array_equal(even.speed, run.speed)
    np.testing.assert_allclose(np.diff(even.time), even.sample_time, rtol=1e-9)


STEPS = st.lists(st.floats(0.5, 1.5), min_size=20, max_size=60)


@settings(max_examples=60, deadline=None)
@given(steps=STEPS, seed=st.integers(0, 1000))
def test_resampling_keeps_the_integrals_of_voltage_and_load(steps, seed):
    """At jittered stamps, up to any point of the even grid."""
    rng = np.random.default_rng(seed)
    time = 7.0 + 1e-3 * np.append(0.0, np.cumsum(steps))
    assume(not is_even(time))  # such stamps count as rounded, and are not resampled
    run = Recording("r", time, rng.normal(size=len(time)), speed=np.cos(time), load=rng.normal(size=len(time)))
    even = on_even_clock(run)
    assert np.ptp(np.diff(even.time)) < 1e-9
    for before, after in ((run.voltage, even.voltage), (run.load, even.load)):
        integral = np.append(0.0, np.cumsum(before[:-1] * np.diff(time)))
        kept = np.append(0.0, np.cumsum(after[:-1] * np.diff(even.time)))
        expected = np.interp(even.time, time, integral)
        expected += before[-1] * np.maximum(even.time - time[-1], 0.0)
        np.testing.assert_allclose(kept, expected, atol=1e-12)


def test_outputs_are_interpolated_but_not_across_gaps():
    """Speed is a straight line in time, which interpolation keeps; ten lost samples stay lost, and nothing is known
    of a grid point past the last sample."""
    rng = np.random.default_rng(6)
    time = np.delete(1e-3 * (np.arange(100) + rng.uniform(-0.2, 0.2, 100)), np.arange(50, 60))
    even = on_even_clock(Recording("r", time, np.ones(90), current=3 * time, speed=1 + 5 * time))
    inside = (even.time > time[49]) & (even.time < time[50])
    assert 9 <= inside.sum() <= 11
    assert time[-1] <= even.time[-1] < time[-1] + 1e-3
    unknown = inside | (even.time > time[-1])
    assert np.isnan(even.speed[unknown]).all()
    np.testing.assert_allclose(even.speed[~unknown], 1 + 5 * even.time[~unknown], rtol=1e-12)
    np.testing.assert_allclose(even.voltage, 1.0, rtol=1e-12)


def test_uneven_runs_of_one_clock_share_a_sample_time():
    """Each sample time needs step matrices of its own."""
    rng = np.random.default_rng(8)
    stamps = [1e-3 * (np.arange(200) + rng.uniform(-0.1, 0.1, 200)) for _ in range(3)]
    runs = [on_even_clock(Recording("r", t, np.ones(200), speed=t)) for t in stamps]
    assert Tape.from_recordings(runs).sample_time.tolist() == [1e-3]


@pytest.mark.parametrize("wrapped", [False, True])
def test_speed_is_computed_from_the_angle(wrapped):
    """The mean speeds between samples; on an even clock in place of an uneven one, the instantaneous speed."""
    time = 1e-3 * np.arange(400)
    stamps = time + 2e-4 * np.sin(np.arange(400))

    def angle(t):
        return 30 * t + np.sin(20 * t)

    def measured(t):
        return angle(t) % (2 * np.pi) if wrapped else angle(t)

    even = on_even_clock(Recording("r", time, np.ones(400), angle=measured(time)))
    assert even.averaging == OVER_LAST and np.isnan(even.speed[0])
    np.testing.assert_allclose(even.speed[1:], np.diff(angle(time)) / 1e-3, rtol=1e-9)
    resampled = on_even_clock(Recording("r", stamps, np.ones(400), angle=measured(stamps)))
    uneven = resampled.recorded
    assert uneven.averaging == OVER_LAST and np.isnan(uneven.speed[0])
    np.testing.assert_allclose(uneven.speed[1:], np.diff(angle(stamps)) / np.diff(stamps), rtol=1e-9)
    assert resampled.averaging is None
    speed = 30 + 20 * np.cos(20 * resampled.time)
    np.testing.assert_allclose(resampled.speed[2:-2], speed[2:-2], rtol=1e-3)
    again = on_even_clock(uneven)
    np.testing.assert_array_equal(again.recorded.speed, uneven.speed)
    np.testing.assert_array_equal(again.speed, resampled.speed)


def test_missing_angles_give_missing_speeds():
    time = 1e-3 * np.arange(100)
    angle = 30 * time
    angle[40] = np.nan
    even = on_even_clock(Recording("r", time, np.ones(100), angle=angle))
    known = ~np.isnan(even.speed)
    assert known.sum() >= 97
    np.testing.assert_allclose(even.speed[known], 30.0, rtol=1e-9)


# ------------------------------------------------------------------------------ public function


def test_simulate_keeps_the_time_stamps_and_the_initial_state():
    """Also at uneven stamps, and without a change of JAX's precision."""
    rng, heavy = np.random.default_rng(7), PAPER | {"J": 0.01}
    time = 2.0 + 1e-3 * np.cumsum(rng.uniform(0.9, 1.1, 300))
    run = Recording("r", time, np.full(300, 12.0), np.full(300, 4.0), np.full(300, 9.0), np.zeros(300))
    assert not jax.config.jax_enable_x64
    found = pmdc_jax.simulate(motor(**heavy), run)
    assert not jax.config.jax_enable_x64
    assert (found.current.dtype, found.speed.dtype) == (np.float64, np.float64)
    np.testing.assert_array_equal(found.time, time)
    assert (found.current[0], found.speed[0]) == (4.0, 9.0)
    A, B = state_space(heavy)
    rest = np.linalg.solve(A, -B @ [12.0, 0.0])
    expected = np.array([rest + linalg.expm(A * (t - time[0])) @ ([4.0, 9.0] - rest) for t in time])
    curvature = heavy["Kt"] / heavy["J"] * 12.0 / heavy["L"]
    assert np.ptp(expected[:, 1]) > 50
    np.testing.assert_allclose(found.speed, expected[:, 1], rtol=0, atol=curvature * 1e-6 / 8)


def test_simulate_accepts_a_motor_of_plain_numbers():
    """Python numbers instead of arrays."""
    run = recording()
    plain = pmdc_jax.simulate(Motor(**PAPER), run)
    np.testing.assert_array_equal(plain.speed, pmdc_jax.simulate(motor(), run).speed)


def test_simulate_accepts_a_motor_file(tmp_path):
    run, path = recording(), tmp_path / "motor.json"
    pmdc_jax.save_motor(path, motor())
    np.testing.assert_array_equal(pmdc_jax.simulate(path, run).speed, pmdc_jax.simulate(motor(), run).speed)


def test_a_simulation_that_diverges_blames_the_motor():
    run = recording(voltage=10 * np.ones(SAMPLES))
    with pytest.raises(InputError, match="motor: its simulation of run diverges at"):
        pmdc_jax.simulate(motor(L=-1e-7), run)


def test_importing_changes_no_setting_and_prints_nothing():
    code = (
        "import jax\n"
        "before = dict(jax.config.values)\n"
        "import pmdc_jax, pmdc_jax.simulate, pmdc_jax.identify, pmdc_jax.cli, pmdc_jax.identify.search.binary_ga\n"
        "changed = {k: v for k, v in jax.config.values.items() if k in before and before[k] != v}\n"
        "assert not changed, changed\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("double", [True, False])
def test_threads_work_in_the_precision_of_their_caller(double):
    """JAX has a setting for each thread, and a new thread begins with single precision."""
    with jax.enable_x64(double):
        found = map_in_threads(lambda k: (k, jnp.arange(k, dtype=float).dtype.itemsize), range(7))
    assert found == [(k, 8 if double else 4) for k in range(7)]


def test_threads_may_start_threads():
    """All cores may be waiting for others already, so these do themselves what no other has begun."""
    found = map_in_threads(lambda k: sum(map_in_threads(lambda j: j * k, range(9))), range(20))
    assert found == [36 * k for k in range(20)]


def test_blas_has_one_thread_while_a_public_function_runs():
    def threads() -> set[int]:
        return {x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"}

    with threadpool_limits(2):
        assert one_blas_thread(threads)() == {1}
        assert threads() == {2}
