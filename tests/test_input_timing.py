"""Voltages that are not held from each sample to the next: simulated as by scipy, and recognised in recordings."""

from __future__ import annotations

import re

import attrs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

from benchmarks import virtual_bench as vb
from benchmarks.naming.plant import Plant, simulate
from pmdc_jax import identify
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.parameters import Parameters
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.recordings.recording import OVER_LAST, Recording
from pmdc_jax.simulate import (
    FIRST_ORDER_HOLD,
    UNKNOWNS_PER_RUN,
    RunUnknowns,
    Tape,
    Timing,
    free_run,
    sensitivities,
    squared_errors,
)
from pmdc_jax.simulate.between_samples import smooth_mean_and_rise

# with a current that settles about as fast as it is sampled: L / R is 1.25 ms, the sample time 2 ms
TRUE = {"R": 0.8, "L": 1e-3, "Kb": 0.04, "Kt": 0.039, "J": 4e-5, "f": 3e-5}
STEP = 2e-3
FROM_REST = RunUnknowns(*np.zeros((UNKNOWNS_PER_RUN, 1)))


def run_by_sines(seed: int, samples: int, load: float = 0.0, step: float = STEP) -> Recording:
    """A run with a voltage of several sines, as of an amplifier, and without measurements."""
    rng, time = np.random.default_rng(seed), step * np.arange(samples)
    frequencies = np.geomspace(0.4, 40.0, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    voltage = 4 * np.sin(2 * np.pi * frequencies * time[:, None] + phases).sum(1) + 3
    return Recording(f"run{seed}", time, voltage, speed=np.zeros(samples), load=load + 0 * time)


def simulated(run: Recording, motor: Motor, timing: Timing = FIRST_ORDER_HOLD) -> np.ndarray:
    """The package's free run from rest, (samples, 2)."""
    tape = Tape.from_recordings([run], timing=timing)
    return tape.samples_of(0, free_run(motor, tape, FROM_REST), len(run))


def motor_with(*effects) -> Motor:
    return Motor(**{n: np.asarray(x) for n, x in TRUE.items()}, effects=effects)


def largest_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float((np.abs(found - expected).max(0) / np.abs(expected).max(0)).max())


def outputs_by_scipy(
    run: Recording, straight: bool = True, step: float = STEP, m: dict[str, float] = TRUE
) -> np.ndarray:
    """Current, speed, angle and charge of the linear motor: `lsim` goes straight between the samples, `dlsim` holds
    them."""
    A, B = np.zeros((4, 4)), np.zeros((4, 2))
    A[:2, :2] = [[-m["R"] / m["L"], -m["Kb"] / m["L"]], [m["Kt"] / m["J"], -m["f"] / m["J"]]]
    A[2, 1] = A[3, 0] = 1.0
    B[:2] = np.diag([1 / m["L"], -1 / m["J"]])
    system, inputs = (A, B, np.eye(4), np.zeros((4, 2))), np.stack([run.voltage, run.load], 1)
    if straight:
        return signal.lsim(system, inputs, run.time)[1]
    return signal.dlsim(signal.cont2discrete(system, step), inputs)[1]


def outputs_of_sines(seed: int, samples: int, load: np.ndarray) -> np.ndarray:
    """The same of the motor driven by the sines themselves, straight between 32 points of each sample."""
    fine = run_by_sines(seed, 32 * (samples - 1) + 1, step=STEP / 32)
    fine = attrs.evolve(fine, load=np.repeat(load, 32)[: len(fine)])
    return outputs_by_scipy(fine)[::32]


def outputs_within(run: Recording, tenths: int, m: dict[str, float] = TRUE) -> np.ndarray:
    """The same so many tenths of a sample after each sample of a held voltage."""
    fine = Recording(
        "fine",
        run.time[0] + STEP / 10 * np.arange(10 * len(run)),
        voltage=np.repeat(run.voltage, 10),
        speed=np.zeros(10 * len(run)),
        load=np.repeat(run.load, 10),
    )
    return outputs_by_scipy(fine, straight=False, step=STEP / 10, m=m)[tenths::10]


def test_the_linear_motor_matches_scipy(x64):
    run = run_by_sines(1, 500, load=0.02)
    assert largest_error(simulated(run, motor_with()), outputs_by_scipy(run)[:, :2]) < 1e-10


def test_a_smooth_voltage_is_followed_between_its_samples(x64):
    run = run_by_sines(1, 500)
    exact = outputs_of_sines(1, 500, run.load)[:, :2]
    by_lines = largest_error(simulated(run, motor_with()), exact)
    rate = TRUE["R"] / TRUE["L"]
    assert largest_error(simulated(run, motor_with(), FIRST_ORDER_HOLD._replace(smooth=rate)), exact) < 0.04 * by_lines


def test_smooth_voltages_may_jump(x64):
    """Held between jumps, or smooth until the sample of one and from there on."""
    held = np.repeat([0.0, 4.0, -3.0, -2.0], 5)
    mean, rise = smooth_mean_and_rise(held, 1.0)
    np.testing.assert_array_equal(mean, held)
    assert not rise.any()
    line = np.arange(20.0) + 100 * (np.arange(20) >= 10)
    mean, rise = smooth_mean_and_rise(line, 1.0)
    np.testing.assert_allclose(mean, line + 0.5, atol=1e-12)
    np.testing.assert_allclose(rise, 1.0, atol=1e-12)


def rates_with_heating(i, w, v, rise):
    R = TRUE["R"] * (1 + rise)
    return [
        (v - R * i - TRUE["Kb"] * w) / TRUE["L"],
        (TRUE["Kt"] * i - TRUE["f"] * w) / TRUE["J"],
        (0.02 * R * i**2 - rise) / 0.5,
    ]


def rates_with_dead_zone(i, w, v, _):
    return [*rates_with_heating(i, w, v - np.clip(v, -2.0, 2.0), 0.0)[:2], 0.0]


def rates_with_friction(i, w, v, _):
    # smoothed within 1e-4 rad/s of standstill, which is crossed in no time
    torque = 0.02 * np.tanh(w / 1e-4)
    di, dw, _ = rates_with_heating(i, w, v, 0.0)
    return [di, dw - torque / TRUE["J"], 0.0]


# parameters, rates and tolerance: the error of a step of ETDRK4; of a voltage that crosses the edge of the dead zone
# within a sample; of a speed that crosses zero within one
EFFECT_CASES = {
    "resistance_heating": ({"rise_per_W": 0.02, "time_constant_s": 0.5}, rates_with_heating, 1e-4),
    "input_dead_zone": ({"width_V": 2.0}, rates_with_dead_zone, 0.03),
    "coulomb_friction": ({"torque_Nm": 0.02}, rates_with_friction, 0.005),
}


@pytest.mark.parametrize("name", EFFECT_CASES)
def test_effects_match_an_independent_integrator(x64, name):
    values, rates, tolerance = EFFECT_CASES[name]
    run = run_by_sines(2, 300)

    def slope(t, x):
        return rates(x[0], x[1], np.interp(t, run.time, run.voltage), x[2])

    settings = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-11, "max_step": STEP / 2}
    exact = solve_ivp(slope, run.time[[0, -1]], [0, 0, 0], t_eval=run.time, **settings).y[:2].T
    effect = EFFECTS[name](**{k: np.asarray(x) for k, x in values.items()})
    assert largest_error(simulated(run, motor_with(effect)), exact) < tolerance


@pytest.mark.parametrize(
    ("names", "timing"),
    [
        (("coulomb_friction",), FIRST_ORDER_HOLD),
        (("speed_sensor_delay",), FIRST_ORDER_HOLD),
        (("speed_sensor_delay",), Timing(0.3)),
        pytest.param(("coulomb_friction",), Timing(0.3), marks=pytest.mark.slow),
    ],
)
def test_sensitivities_match_central_differences(x64, names, timing):
    bounds = {n: (x / 2, x * 2) for n, x in TRUE.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name] for name in names])
    at = np.log([*TRUE.values(), *[{"coulomb_friction": 0.02}.get(n, 0.003) for n in names]])
    tape = Tape.from_recordings([run_by_sines(3, 300)], timing=timing)
    found, jacobian, *_ = sensitivities(parameters, jnp.asarray(at), tape, FROM_REST)

    def run(at):
        return np.asarray(free_run(parameters(jnp.asarray(at)), tape, FROM_REST))

    np.testing.assert_allclose(found, run(at), rtol=1e-9, atol=1e-9)
    assert jacobian.shape[-1] == len(at) + UNKNOWNS_PER_RUN
    for column, step in enumerate(1e-5 * np.eye(len(at))):
        expected = (run(at + step) - run(at - step)) / 2e-5
        error = np.linalg.norm(jacobian[..., column] - expected) / np.linalg.norm(expected)
        assert error < 1e-4, (parameters.names[column], error)


@pytest.mark.parametrize("averaged", [False, True])
def test_outputs_are_read_within_a_sample_as_by_scipy(x64, averaged):
    run, tenths = run_by_sines(4, 300, load=0.02), 3
    if averaged:
        run = attrs.evolve(run, averaging=OVER_LAST)
    tape = Tape.from_recordings([run], timing=Timing(tenths / 10))
    seen = free_run(motor_with(), tape, FROM_REST)
    current, speed = (tape.samples_of(0, seen[:, c], len(run)) for c in range(2))
    expected = outputs_within(run, tenths)
    if averaged:  # before the start of the run its speed is unknown
        expected, current, speed = np.diff(expected, axis=0) / STEP, np.diff(current), speed[1:]
        expected[:, 1], expected[:, 0] = expected[:, 2], expected[:, 0] * STEP
    assert largest_error(np.stack([current, speed], 1), expected[:, :2]) < 1e-10


def test_a_population_is_read_within_a_sample(x64):
    run = attrs.evolve(run_by_sines(5, 300), current=np.zeros(300))
    tape = Tape.from_recordings([run], timing=Timing(0.3))
    seen = np.asarray(free_run(motor_with(), tape, FROM_REST))
    population = jax.tree.map(lambda x: jnp.full(4, x), motor_with())
    for effects in ((), (EFFECTS["coulomb_friction"](torque_Nm=jnp.zeros(4)),)):
        found = squared_errors(population.with_effects(effects), tape)
        for c, errors in enumerate(found):
            np.testing.assert_allclose(errors, np.sum(seen[:, c] ** 2 * tape.weight[:, c]), rtol=1e-9)


# ways in which voltages act and are logged, and the message for each
MESSAGE_OF = {
    "held": None,
    "straight": "is linear between samples",
    "smooth": "changes smoothly between its samples",
    "recorded late": "recorded one sample late",
    "acts late": "acts one sample later",
    "straight, counted": "is linear between samples",
    "held, read after 3 tenths": "acts 0.3 of a sample earlier",
    "recorded early by 3 tenths": "acts 0.3 of a sample later",
    "held, read after 3 tenths, counted": "acts 0.3 of a sample earlier",
}
LINES = 2048


def logged(timing: str) -> list[Recording]:
    """Three runs with noise, one of them under a load that comes and goes."""
    rng, runs = np.random.default_rng(11), []
    for seed, load in ((21, 0.0), (22, 0.05), (23, 0.0)):
        run = run_by_sines(seed, 2501)
        run = attrs.evolve(run, load=load * (np.sin(8 * run.time) > 0))
        if timing == "smooth" and seed == 21:  # a continuous simulation may have steps, too
            run = attrs.evolve(run, voltage=np.repeat(run.voltage[::61], 61)[: len(run)])
            outputs = outputs_by_scipy(run, straight=False)[:, :2]
        elif timing == "smooth":
            outputs = outputs_of_sines(seed, len(run), run.load)[:, :2]
        else:
            outputs = outputs_by_scipy(run, "straight" in timing)[:, :2]
        outputs += np.array([0.02, 0.2]) * rng.standard_normal(outputs.shape)
        v, measured = run.voltage[:-1], outputs[:-1]
        load = run.load[:-1]
        if timing == "recorded late":  # beside the next outputs, and so is the load
            measured = outputs[1:]
        if "tenths" in timing:
            exact = outputs_within(run, 3 if "after" in timing else 7)
            measured = measured + (exact - outputs_by_scipy(run, straight=False))[:-1, :2]
        if "counted" in timing:  # by an encoder, over the last sample
            exact = outputs_within(run, 3) if "tenths" in timing else outputs_by_scipy(run)
            angle = np.round(exact[:, 2] * LINES / (2 * np.pi)) * 2 * np.pi / LINES
            measured[:, 1] = np.diff(angle, prepend=angle[0])[:-1] / STEP
        if timing == "acts late":
            v, measured, load = run.voltage[1:], outputs[:-1], run.load[:-1]
        # the next voltage acts 3 tenths of a sample after the outputs were read
        if "early" in timing:
            v = run.voltage[1:]
        runs.append(Recording(run.name, run.time[:-1], v, *measured.T, load=load))
    return runs


def slow(case: str) -> object:
    """A case that runs with the slow tests only."""
    return pytest.param(case, marks=pytest.mark.slow)


@pytest.mark.parametrize("timing", [k if k == "held" else slow(k) for k in MESSAGE_OF])
def test_the_timing_of_a_voltage_is_found(timing):
    """Taken for held from their samples on, these voltages would bias L by up to 60 % and R by 5 %."""
    found = identify(logged(timing))
    reported = [message for message in found.messages if message.startswith("the voltage")]
    assert len(reported) == (MESSAGE_OF[timing] is not None)
    assert all(MESSAGE_OF[timing] in message for message in reported)
    for name in PARAMETERS:
        estimate = found.parameters[name]
        assert abs(estimate.value - TRUE[name]) < 3 * estimate.stderr, name
        assert estimate.stderr < 0.02 * TRUE[name], name


# the current settles within a fifth of a sample
FAST = TRUE | {"L": 8e-5}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("read", "message"),
    [
        ("current", "the current is a mean over the last sample"),
        ("both", "the speed is a mean over the last sample"),
        ("late", "acts one sample later"),
        ("7 tenths", "acts 0.3 of a sample later"),
        ("3 tenths early", "acts 0.3 of a sample earlier"),
        ("5 tenths early", "acts 0.5 of a sample earlier"),
        ("held", None),
    ],
)
@pytest.mark.parametrize("truth", [FAST, TRUE])
def test_what_looks_like_another_inductance_is_found(read, message, truth):
    """Taken as read at the samples, these currents would treble L of the fast motor, some without larger residuals."""
    rng, runs = np.random.default_rng(13), []
    for seed, load in ((31, 0.0), (32, 0.05), (33, 0.0)):
        run = run_by_sines(seed, 2500, load)
        exact = outputs_by_scipy(run, straight=False, m=truth)
        means = np.diff(exact, axis=0, prepend=exact[:1]) / STEP
        current, speed, voltage, load = means[:, 3], exact[:, 1], run.voltage, run.load
        if read == "both":
            speed = means[:, 2]
        if read == "late":
            voltage, load, current, speed = voltage[1:], load[1:], current[:-1], speed[:-1]
        if read == "held":
            current = exact[:, 0]
        if read == "7 tenths":
            current, speed = outputs_within(run, 7, truth)[:-1, :2].T
            voltage, load = voltage[1:], load[1:]
        if read.endswith("early"):
            current, speed = outputs_within(run, int(read[0]), truth)[:, :2].T
        time = STEP * np.arange(len(current))
        current, speed = (x + s * rng.standard_normal(len(x)) for x, s in ((current, 0.02), (speed, 0.2)))
        runs.append(Recording(run.name, time, voltage, current, speed, load=load))
    found = identify(runs)
    assert message is None or any(message in reported for reported in found.messages)
    if read == "held":
        assert not [m for m in found.messages if "modelled" in m]
    for name in PARAMETERS:
        estimate = found.parameters[name]
        assert abs(estimate.value - truth[name]) < 3 * estimate.stderr, name
        assert estimate.stderr < (0.3 if name == "L" else 0.02) * truth[name], name


@pytest.mark.parametrize(("tenths", "effects"), [(3, []), (7, ["brush_voltage_drop"])])
@pytest.mark.slow
def test_the_timing_of_a_voltage_is_found_beside_brushes(tenths, effects):
    """The electrical equation shows it, although a fit without the drop of the brushes is poor at any timing."""
    truth = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
    rng, runs = np.random.default_rng(17), []
    for name, excitation in (("prbs", vb.prbs(rng, 2.0)), ("loaded", vb.loaded(rng, 2.0))):
        time, *held = excitation
        fine = vb.Excitation(1e-4 * np.arange(10 * len(time)), *(np.repeat(x, 10) for x in held))
        outputs = simulate(Plant(**truth, brush_V=0.6), *fine)[tenths::10, :2][:-1]
        current, speed = (outputs + [0.05, 0.3] * rng.standard_normal(outputs.shape)).T
        # recorded beside the outputs that were read while it acted, or before
        v, load = (x[1:] if tenths > 5 else x[:-1] for x in held)
        runs.append(Recording(name, time[:-1], v, current, speed, load=load))
    found = identify(runs, effects=effects)
    when = "later" if tenths > 5 else "earlier"
    told = rf"the voltage acts 0\.3\d? of a sample {when}"
    assert any(re.match(told, message) for message in found.messages)
    if effects:
        drop, L = found.parameters["brush_voltage_drop.voltage_V"], found.parameters["L"]
        assert abs(drop.value - 0.6) < 3 * drop.stderr < 0.02
        assert abs(L.value - truth["L"]) < 3 * L.stderr < 0.01 * truth["L"]


@pytest.mark.parametrize(
    ("late", "told"),
    [(0.04, r"acts 0\.0(39|4|41) of a sample later"), (-0.04, r"acts 0\.0(39|4|41) of a sample earlier"), (0.0, None)],
)
def test_a_slight_lateness_is_found(late, told):
    """A bridge that switches a few hundredths of a sample late leaves nothing but noise with a wrong inductance, many
    standard errors off."""
    rng, runs = np.random.default_rng(29), []
    for seed, torque in ((41, 0.0), (42, 0.06), (43, 0.0)):
        run = run_by_sines(seed, 2500)
        run = attrs.evolve(run, voltage=np.repeat(run.voltage[::7], 7)[: len(run)])
        run = attrs.evolve(run, load=torque * np.repeat(rng.uniform(0, 1, 25), 100))
        outputs = outputs_with_late_voltage(run, late)
        current, speed = (outputs + [0.02, 0.2] * rng.standard_normal(outputs.shape)).T
        runs.append(Recording(run.name, run.time, run.voltage, current, speed, load=run.load))
    found = identify(runs)
    reported = [text for text in found.messages if text.startswith("the voltage")]
    assert len(reported) == (told is not None)
    assert all(re.search(told, text) for text in reported), reported
    for name in PARAMETERS:
        estimate = found.parameters[name]
        assert abs(estimate.value - TRUE[name]) < 3 * estimate.stderr, name
    assert found.parameters["L"].stderr < 0.01 * TRUE["L"]


def outputs_with_late_voltage(run: Recording, late: float) -> np.ndarray:
    """Current and speed at the samples if each voltage acts so many samples after its own."""
    fine = 50  # parts of a sample
    rows = np.arange(fine * len(run))
    at = np.clip((rows - round(late * fine)) // fine, 0, len(run) - 1)
    inside = attrs.evolve(
        run,
        time=STEP / fine * rows,
        voltage=run.voltage[at],
        load=np.repeat(run.load, fine),
        speed=np.zeros(len(rows)),
        current=None,
    )
    return outputs_by_scipy(inside, straight=False, step=STEP / fine)[::fine, :2]
