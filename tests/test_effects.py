"""All effects: against independent integrators, derivatives against finite differences, and physical laws."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import attrs
import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest
from attrs import evolve
from linear_motor import PAPER
from scipy.integrate import cumulative_trapezoid, solve_ivp

from benchmarks import virtual_bench as vb
from pmdc_jax.effects import EFFECTS
from pmdc_jax.effects.base import AbstractEffect
from pmdc_jax.effects.sine import cosine, sine
from pmdc_jax.identify.parameters import Parameters
from pmdc_jax.motor import Motor
from pmdc_jax.recordings.recording import AROUND, OVER_BOTH, OVER_LAST, Averaging, Recording
from pmdc_jax.simulate import UNKNOWNS_PER_RUN, RunUnknowns, Tape, free_run, sensitivities, squared_errors
from pmdc_jax.simulate.propagator import steps_within

DOCUMENTED = Path(__file__).parents[1] / "docs" / "effects.md"
STARTS = ((5.0, 60.0), (-3.0, -8.0), (0.0, 0.0))  # current A, speed rad/s of each run

Values = Mapping[str, float]


class Case(NamedTuple):
    """An effect strong enough to matter, and an independent simulation of it.

    Either `bench`, arguments of the virtual bench's motor; or `rates`, dx/dt as a function of (x, v, load, values), x
    beginning with current and speed, which scipy integrates; or, for other dry friction, `friction`, the torque at
    which it slips as a function of (speed, direction, values), for which scipy finds slipping and sticking as events.
    """

    values: Values
    amplitude: str  # the fields at whose zero the effect vanishes
    bench: Callable[[Values], dict[str, float]] | None = None
    rates: Callable | None = None
    friction: Callable | None = None
    start: Callable | None = None  # values of the effect's own states, for (speed, load, values)
    # measured current and speed, for x (states, samples) and values
    reported: Callable | None = None
    # largest error with samples of 1 ms, relative to the largest value of each output; dry elements start and stop
    # within a sample
    tolerance: float = 1e-4
    # error of the sensitivities, relative to central differences over this step
    slope_tolerance: float = 1e-4
    difference: float = 1e-5
    dissipates: bool = True  # never returns energy
    # by how much the outputs change at least, root mean square over the largest value
    min_change: float = 0.02


def current_rate(i, w, v, L=None, R=None):
    """di/dt of the linear motor."""
    return (v - (R or PAPER["R"]) * i - PAPER["Kb"] * w) / (L or PAPER["L"])


def acceleration(i, w, load, Kt=None, J=None):
    """dw/dt of the linear motor."""
    return ((Kt or PAPER["Kt"]) * i - PAPER["f"] * w - load) / (J or PAPER["J"])


def linear_rates(x, v, load, values):
    return [current_rate(x[0], x[1], v), acceleration(x[0], x[1], load)]


def rates_with_heating(x, v, load, values):
    """Copper loss warms the winding, whose resistance rises with its temperature."""
    i, w, rise = x
    R = PAPER["R"] * (1 + rise)
    warming = (values["rise_per_W"] * R * i**2 - rise) / values["time_constant_s"]
    return [current_rate(i, w, v, R=R), acceleration(i, w, load), warming]


def rates_with_drag(x, v, load, values):
    drag = values["drag_Nms2_rad2"] * x[1] * abs(x[1])
    return linear_rates(x, v, load + drag, values)


def rates_with_cogging(x, v, load, values):
    pull = values["amplitude_Nm"] * np.sin(values["periods"] * x[2] + values["phase_rad"])
    return [*linear_rates(x, v, load + pull, values), x[1]]


def rates_with_ripple(x, v, load, values):
    wave = values["amplitude"] * np.sin(values["periods"] * x[2] + values["phase_rad"])
    Kt = PAPER["Kt"] * (1 + wave)
    emf = 1 + values["emf_share"] * wave
    return [current_rate(x[0], emf * x[1], v), acceleration(x[0], x[1], load, Kt=Kt), x[1]]


def rates_with_saturation(x, v, load, values):
    flux = 1 / (1 + values["per_A2"] * x[0] ** 2)
    emf = 1 - values["emf_share"] * (1 - flux)
    return [current_rate(x[0], emf * x[1], v), acceleration(x[0], x[1], load, Kt=PAPER["Kt"] * flux)]


def rates_of_two_inertias(x, v, load, values, torque):
    i, w, load_speed, _ = x
    share = values["load_share"]
    return [
        current_rate(i, w, v),
        acceleration(i, w, torque, J=(1 - share) * PAPER["J"]),
        (torque - load) / (share * PAPER["J"]),
        w - load_speed,
    ]


def rates_with_compliance(x, v, load, values):
    torque = values["stiffness_Nm_rad"] * x[3] + values["damping_Nms_rad"] * (x[1] - x[2])
    return rates_of_two_inertias(x, v, load, values, torque)


def rates_with_backlash(x, v, load, values):
    """Spring and damper act only if the teeth touch, which push and never pull."""
    side, beyond = np.sign(x[3]), abs(x[3]) - values["gap_rad"] / 2
    push = values["stiffness_Nm_rad"] * beyond + side * values["damping_Nms_rad"] * (x[1] - x[2])
    return rates_of_two_inertias(x, v, load, values, side * max(push, 0.0) if beyond > 0 else 0.0)


def rates_with_lag(x, v, load, values):
    return [*linear_rates(x[:2], v, load, values), (x[1] - x[2]) / values["time_constant_s"]]


def stribeck_torque(speed, direction, values):
    slow = np.exp(-((speed / values["speed_rad_s"]) ** 2))
    return values["coulomb_Nm"] + (values["static_Nm"] - values["coulomb_Nm"]) * slow


WAVE = {"phase_rad": 0.7, "periods": 6.0}

CASES = {
    "coulomb_friction": Case(
        {"torque_Nm": 0.15}, "torque_Nm", bench=lambda p: {"coulomb_Nm": p["torque_Nm"]}, tolerance=2e-3
    ),
    "stribeck_friction": Case(
        {"coulomb_Nm": 0.1, "static_Nm": 0.2, "speed_rad_s": 15.0},
        "coulomb_Nm static_Nm",
        friction=stribeck_torque,
        tolerance=1e-3,
    ),
    "asymmetric_friction": Case(
        {"forward_Nm": 0.2, "backward_Nm": 0.1},
        "forward_Nm backward_Nm",
        friction=lambda w, direction, p: p["forward_Nm"] if direction > 0 else p["backward_Nm"],
        tolerance=2e-3,
    ),
    "quadratic_drag": Case({"drag_Nms2_rad2": 6e-5}, "drag_Nms2_rad2", rates=rates_with_drag),
    "cogging_torque": Case(
        {"amplitude_Nm": 0.1} | WAVE,
        "amplitude_Nm",
        rates=rates_with_cogging,
        start=lambda w, load, p: [0.0],
        dissipates=False,
        min_change=0.01,
    ),
    "torque_ripple": Case(
        {"amplitude": 0.3, "emf_share": 0.4} | WAVE,
        "amplitude",
        rates=rates_with_ripple,
        start=lambda w, load, p: [0.0],
        dissipates=False,
        min_change=0.01,
    ),
    "constant_load": Case(
        {"torque_Nm": 0.2},
        "torque_Nm",
        rates=lambda x, v, load, p: linear_rates(x, v, load + p["torque_Nm"], p),
        dissipates=False,
    ),
    "shaft_compliance": Case(
        {"stiffness_Nm_rad": 10.0, "damping_Nms_rad": 3e-3, "load_share": 0.5},
        "",
        rates=rates_with_compliance,
        start=lambda w, load, p: [w, load / p["stiffness_Nm_rad"]],
        dissipates=False,
    ),
    "gear_backlash": Case(
        {"gap_rad": 0.1, "stiffness_Nm_rad": 10.0, "damping_Nms_rad": 3e-3, "load_share": 0.5},
        "",
        rates=rates_with_backlash,
        start=lambda w, load, p: [w, load / p["stiffness_Nm_rad"] + np.sign(load) * p["gap_rad"] / 2],
        dissipates=False,
    ),
    "brush_voltage_drop": Case(
        {"voltage_V": 1.2}, "voltage_V", bench=lambda p: {"brush_drop_V": p["voltage_V"]}, tolerance=1e-3
    ),
    "resistance_heating": Case(
        {"rise_per_W": 1e-2, "time_constant_s": 0.3},
        "rise_per_W",
        rates=rates_with_heating,
        start=lambda w, load, p: [0.0],
    ),
    "torque_constant_saturation": Case(
        {"per_A2": 3e-4, "emf_share": 0.4}, "per_A2", rates=rates_with_saturation, dissipates=False
    ),
    "inductance_saturation": Case(
        {"per_A2": 5e-4},
        "per_A2",
        min_change=0.01,
        rates=lambda x, v, load, p: [
            current_rate(x[0], x[1], v, L=PAPER["L"] / (1 + p["per_A2"] * x[0] ** 2)),
            acceleration(x[0], x[1], load),
        ],
        dissipates=False,
    ),
    "input_dead_zone": Case(
        {"width_V": 1.5},
        "width_V",
        rates=lambda x, v, load, p: linear_rates(x, np.sign(v) * max(abs(v) - p["width_V"], 0.0), load, p),
    ),
    "speed_sensor_lag": Case(
        {"time_constant_s": 5e-3},
        "time_constant_s",
        rates=rates_with_lag,
        start=lambda w, load, p: [w],
        reported=lambda x, p: x[[0, 2]],
        dissipates=False,
    ),
    "speed_sensor_delay": Case(
        {"delay_s": 3.4e-3}, "delay_s", rates=linear_rates, reported=lambda x, p: x[:2], dissipates=False
    ),
    "current_sensor_offset": Case(
        {"offset_A": 4.0},
        "offset_A",
        rates=linear_rates,
        reported=lambda x, p: np.stack([x[0] + p["offset_A"], x[1]]),
        dissipates=False,
    ),
}
LINEAR = Motor(**{n: np.asarray(x) for n, x in PAPER.items()})
every_effect = pytest.mark.parametrize("name", EFFECTS)
# one that sticks, one of the winding, one with a state of its own: the others take minutes to compile
FAST_TO_COMPILE = {"coulomb_friction", "brush_voltage_drop", "resistance_heating"}
each_simulated = pytest.mark.parametrize(
    "name", [n if n in FAST_TO_COMPILE else pytest.param(n, marks=pytest.mark.slow) for n in EFFECTS]
)


def with_effect(name: str, values: Values | None = None, **changes: float) -> Motor:
    values = CASES[name].values if values is None else values
    effect = EFFECTS[name](**{n: np.asarray(x) for n, x in values.items()})
    constants = {n: np.asarray(x, float) for n, x in (PAPER | changes).items()}
    return Motor(**constants, effects=(effect,))


def recordings(step: float = 1e-3, **changes) -> list[Recording]:
    """Three runs through standstill and both directions, of 256, 128 and 128 samples.

    The inputs change every 16 ms whatever the `step`; `changes` replaces them by other functions of
    time. All of the same shape, so that simulating an effect is compiled once.
    """
    rng, runs = np.random.default_rng(1), []
    for k, samples in enumerate((256, 128, 128)):
        levels = rng.uniform([-8, -0.1], [8, 0.1], (16, 2))
        levels[k::3, 0] *= 0.1  # so that motor and current come to rest as well
        time = step * np.arange(samples)
        voltage, load = levels[np.minimum(time / 0.016 + 1e-6, 15).astype(int)].T
        current, speed = (np.full(samples, x) for x in STARTS[k])
        columns = {"voltage": voltage, "load": load, "current": current, "speed": speed}
        for column, value in changes.items():
            columns[column] = None if value is None else value + 0 * time
        runs.append(Recording(f"run {k}", time, **columns))
    return runs


RUNS = recordings()


def averaged(runs: list[Recording], *means: Averaging | None) -> list[Recording]:
    """The runs with speeds that are such means; beside a mean over the last sample, so is the current."""
    return [
        evolve(run, averaging=mean, current_averaged=mean == OVER_LAST) for run, mean in zip(runs, means, strict=True)
    ]


def simulated(motor: Motor, runs: list[Recording]) -> list[np.ndarray]:
    """Current and speed of every run, (samples, 2)."""
    tape = Tape.from_recordings(runs)
    outputs = free_run(motor, tape)
    return [np.stack([tape.samples_of(k, outputs[:, c], len(run)) for c in range(2)], 1) for k, run in enumerate(runs)]


def reference(name: str, run: Recording) -> np.ndarray:
    """Current and speed of a run by scipy or by the virtual bench, (samples, 2)."""
    case = CASES[name]
    values = case.values
    start = (run.current[0], run.speed[0])
    if case.bench:
        motor = dataclasses.replace(vb.paper_motor(), **case.bench(values))
        return vb.simulate(motor, vb.Excitation(run.time, run.voltage, run.load), (*start, 0.0))[:, :2]
    if case.friction:
        return integrated_with_sticking(case, run)
    own = case.start(run.speed[0], run.load[0], values) if case.start else []
    states = integrated(case, run, np.array([*start, *own]), run.time)
    if "delay_s" in values:
        late, back = np.unique(np.maximum(run.time - values["delay_s"], 0.0), return_inverse=True)
        states[1] = integrated(case, run, np.array(start), late)[1, back]
    return (case.reported or (lambda x, p: x[:2]))(states, values).T


def stretches_of_held_inputs(run: Recording) -> list[tuple[float, float, float, float]]:
    """Begin, end, voltage and load of every stretch with constant inputs."""
    changes = np.flatnonzero(np.diff(run.voltage) != 0) + 1
    first = np.append(0, changes)
    ends = np.append(run.time[changes], run.time[-1] + run.sample_time)
    return list(zip(run.time[first], ends, run.voltage[first], run.load[first], strict=True))


PRECISE = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}


def integrated(case: Case, run: Recording, x: np.ndarray, times: np.ndarray) -> np.ndarray:
    """States (states, samples) at `times`, restarted wherever the inputs jump."""
    outputs = []
    for begin, end, v, load in stretches_of_held_inputs(run):
        inside = times[(times >= begin - 1e-12) & (times < end - 1e-12)]
        solved = solve_ivp(
            lambda t, x, v=v, load=load: case.rates(x, v, load, case.values),
            (begin, end),
            x,
            t_eval=np.append(np.maximum(inside, begin), end),
            # so as not to miss contact of the teeth
            max_step=1e-3 if case.amplitude == "" else np.inf,
            **PRECISE,
        )
        x = solved.y[:, -1]
        outputs.append(solved.y[:, :-1])
    return np.concatenate(outputs, 1)


def integrated_with_sticking(case: Case, run: Recording) -> np.ndarray:
    """Slipping and sticking in turn, each an ordinary differential equation, with the changes found as events."""
    x, outputs = np.array([run.current[0], run.speed[0]]), []
    for begin, end, v, load in stretches_of_held_inputs(run):
        inside = run.time[(run.time >= begin - 1e-12) & (run.time < end - 1e-12)]
        sampled, t = np.zeros((2, len(inside))), begin
        while t < end - 1e-12:
            t, x = _integrate_to_next_change(case, t, end, x, v, load, inside, sampled)
        outputs.append(sampled)
    return np.concatenate(outputs, 1).T


def _integrate_to_next_change(case, t, end, x, v, load, inside, sampled):
    """To the next change between slipping and sticking, or to the end."""

    def driving(x):
        return PAPER["Kt"] * x[0] - load

    direction = np.sign(x[1]) or np.sign(driving(x))
    limit = case.friction(0.0, direction, case.values) * (1 + 1e-9)
    sticks = x[1] == 0 and abs(driving(x)) <= limit

    def rates(t, x):
        i, w = x
        friction = direction * case.friction(w, direction, case.values)
        change = 0.0 if sticks else acceleration(i, w, load + friction)
        return [current_rate(i, w, v), change]

    def stops(t, x):
        return x[1] * direction + (t <= start + 1e-9)

    def slips(t, x):
        side = np.sign(driving(x))
        return abs(driving(x)) - case.friction(0.0, side, case.values) * (1 + 2e-9)

    start, event = t, slips if sticks else stops
    event.terminal, event.direction = True, 1 if sticks else -1
    solved = solve_ivp(rates, (t, end), x, events=event, dense_output=True, max_step=2e-3, **PRECISE)
    now = (inside >= t - 1e-12) & (inside < solved.t[-1] + 1e-12)
    if now.any():
        sampled[:, now] = solved.sol(np.maximum(inside[now], t))
    x = solved.y[:, -1]
    if solved.status == 1 and not sticks:
        x[1] = 0.0
    return solved.t[-1], x


def relative_errors(found: list[np.ndarray], expected: list[np.ndarray]) -> np.ndarray:
    """Largest and root mean square error over all samples, over the largest value of each output."""
    errors = np.concatenate(found) - np.concatenate(expected)
    scaled = errors / np.abs(np.concatenate(expected)).max(0)
    return np.array([np.abs(scaled).max(), np.sqrt(np.mean(scaled**2))])


def test_every_effect_has_a_case():
    assert set(CASES) == set(EFFECTS)


@each_simulated
def test_agrees_with_an_independent_integrator(x64, name):
    expected = [reference(name, run) for run in RUNS]
    plain = relative_errors(simulated(LINEAR, RUNS), expected)
    found = relative_errors(simulated(with_effect(name), RUNS), expected)
    assert plain[1] > CASES[name].min_change, "the effect is too weak for this test"
    assert found[0] < CASES[name].tolerance, found


FINE_STEPS = 50


def mean_reference(name: str, run: Recording) -> np.ndarray:
    """Mean currents and speeds of a run, (samples, 2), NaN where they are no means: from differences of charge and
    angle, which are integrated by the trapezoidal rule in fine steps."""
    step = run.sample_time / FINE_STEPS
    finely = {c: np.repeat(getattr(run, c), FINE_STEPS) for c in ("voltage", "load", "current", "speed")}
    fine = Recording("fine", step * np.arange(FINE_STEPS * len(run)), **finely)
    outputs = reference(name, fine)
    integral = cumulative_trapezoid(outputs, dx=step, axis=0, initial=0.0)
    ends = integral[FINE_STEPS // 2 if run.averaging == AROUND else 0 :: FINE_STEPS]
    last = np.pad(np.diff(ends, axis=0) / run.sample_time, ((1, 0), (0, 0)))
    means = (last + np.roll(last, -1, axis=0)) / 2 if run.averaging == OVER_BOTH else last
    means[0 if run.averaging == OVER_LAST else [0, -1]] = np.nan
    means[:, 0] = means[:, 0] if run.current_averaged else np.nan
    return means


@pytest.mark.parametrize(
    "name",
    [
        n if n in FAST_TO_COMPILE | {"speed_sensor_delay", "constant_load"} else pytest.param(n, marks=pytest.mark.slow)
        for n in EFFECTS
    ],
)
def test_means_agree_with_an_independent_integrator(x64, name):
    """Means over the last sample, over two or around each instant, as from encoder counts; at 2 ms, within which the
    acceleration changes."""
    runs = averaged(recordings(2e-3), OVER_LAST, OVER_BOTH, AROUND)
    expected = np.concatenate([mean_reference(name, run) for run in runs])
    found, sampled = (np.concatenate(simulated(with_effect(name), of)) for of in (runs, recordings(2e-3)))
    size = np.nanmax(np.abs(expected), axis=0)
    differing, error = (np.nanmax(np.abs(x - expected), axis=0) / size for x in (sampled, found))
    assert (differing > 0.02).all(), "the means hardly differ from samples"
    # if an element switches within a sample, its mean is corrected as if the speed changed linearly
    worst = max(5 * CASES[name].tolerance, 2e-3 if name == "gear_backlash" else 0.0)
    assert (error < worst).all(), error


@pytest.mark.parametrize(("name", "max_ratio"), [("cogging_torque", 0.1), ("torque_ripple", 3.0)])
@pytest.mark.parametrize("periods", [12.0, 24.0])
def test_a_torque_wave_with_about_one_period_or_more_per_sample(x64, name, max_ratio, periods):
    """At full speed, 5.8 and 11.5 rad per sample. Evaluated at the samples only, the wave would cause errors of 3 to 24
    times its effect on the speed. Of torque ripple, with which the current ripples too, some error remains."""
    values = CASES[name].values | {"periods": periods}
    values[CASES[name].amplitude] /= 5
    fast = recordings(voltage=24.0, load=0.0, current=2.4, speed=480.0)
    start, turning = np.array([2.4, 480.0, 0.0]), CASES[name]._replace(values=values)
    expected = np.concatenate([integrated(turning, run, start, run.time)[1] for run in fast])
    plain, found = (np.concatenate(simulated(motor, fast))[:, 1] for motor in (LINEAR, with_effect(name, values)))
    assert np.std(found - expected) < max_ratio * np.std(plain - expected)


@pytest.mark.parametrize("size", [1.0, 1e3, 1e6, 1e8])
def test_sine_and_cosine_are_exact_to_rounding(x64, size):
    x = size * np.concatenate([np.linspace(-4, 4, 20001), np.arange(-2, 3) * np.pi / 2])
    error = 5e-16 if size < 1e8 else np.spacing(x.max())  # beyond, that of x itself
    for found, expected in ((sine, np.sin), (cosine, np.cos)):
        np.testing.assert_allclose(found(x), expected(x), rtol=0, atol=error)
    for found, slope in ((sine, np.cos), (cosine, lambda x: -np.sin(x))):
        slopes = jax.vmap(jax.grad(found))(jnp.asarray(x))
        np.testing.assert_allclose(slopes, slope(x), rtol=0, atol=error)
    assert sine(jnp.float32(1.0)).dtype == cosine(jnp.float32(1.0)).dtype == jnp.float32


@pytest.mark.parametrize("name", sorted(FAST_TO_COMPILE))
def test_a_locked_rotor_stays_at_rest(x64, name):
    """Its current is that of a motor too heavy to move."""
    at_rest = [attrs.evolve(run, speed=0 * run.time) for run in RUNS]
    locked = simulated(with_effect(name), [attrs.evolve(r, speed=None, held=True) for r in at_rest])
    heavy = simulated(with_effect(name, J=1e9), at_rest)
    for one, other in zip(locked, heavy, strict=True):
        assert not one[:, 1].any()
        np.testing.assert_allclose(one[:, 0], other[:, 0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["resistance_heating", "stribeck_friction", "speed_sensor_delay"])
def test_slow_sampling_is_as_accurate(x64, name):
    """At 10 ms, five times L / R, in equal steps of at most a millisecond; a delay is a fraction of a sample."""
    runs = [
        Recording(r.name, *(c[:64] for c in (r.time, r.voltage, r.current, r.speed, r.load))) for r in recordings(1e-2)
    ]
    found = relative_errors(simulated(with_effect(name), runs), [reference(name, r) for r in runs])
    assert found[0] < CASES[name].tolerance, found


COLUMNS = ("voltage", "current", "speed", "load")
HAS_LONGER_STEP = [n for n, e in EFFECTS.items() if e.longer_step is not AbstractEffect.longer_step]
OF_SPEED = [n for n in HAS_LONGER_STEP if EFFECTS[n].variable == "speed"]
# effects, by how much inertia and inductance are larger, and steps in 10 ms
HEAVY_ROTORS = [(name, *case) for name in OF_SPEED for case in ((5, 1, 8), (100, 1, 2))]
SLOW_WINDINGS = [
    *((name, 5, 20, 2) for name in HAS_LONGER_STEP if name != "inductance_saturation"),
    ("inductance_saturation", 5, 20, 4),
    *((name, 5, 1, 8) for name in HAS_LONGER_STEP if name not in (*OF_SPEED, "inductance_saturation")),
]
# in a sample in which speed or current reverses, and of all: a tenth of the noise of good sensors; more where current
# and speed change as slowly as each other, but still less than that noise
HEAVY_ERRORS, SLOW_ERRORS = (3e-4, 2e-5), (1e-3, 1e-4)
SLOW_MOTORS = [*((*case, HEAVY_ERRORS) for case in HEAVY_ROTORS), *((*case, SLOW_ERRORS) for case in SLOW_WINDINGS)]


@pytest.mark.parametrize(("name", "inertia", "inductance", "steps", "errors"), SLOW_MOTORS)
def test_slow_samples_of_a_slow_motor_take_fewer_steps(x64, name, inertia, inductance, steps, errors):
    """Of 10 ms, instead of ten or more: current and speed are those at samples of 0.5 ms, and the rotor reverses."""
    motor = with_effect(name, J=inertia * PAPER["J"], L=inductance * PAPER["L"])
    slow = recordings(1e-2)
    fine = [
        Recording(r.name, 5e-4 * np.arange(20 * len(r)), **{c: np.repeat(getattr(r, c), 20) for c in COLUMNS})
        for r in slow
    ]
    assert int(steps_within(motor, jnp.asarray(1e-2), jnp.asarray(100.0), 1e-2)) == steps
    expected = [outputs[::20] for outputs in simulated(motor, fine)]
    assert any((np.diff(np.sign(outputs[:, 1])) != 0).any() for outputs in expected)
    largest, rms = relative_errors(simulated(motor, slow), expected)
    assert largest < errors[0]
    assert rms < errors[1]


def test_a_strongly_saturated_inductance_is_nearly_as_accurate(x64):
    """At the highest current it is a tenth of that at zero; with the steps of weak saturation the error is 2 %."""
    name = "inductance_saturation"
    case, motor = CASES[name]._replace(values={"per_A2": 5e-3}), with_effect(name, {"per_A2": 5e-3})
    expected = [integrated(case, r, np.array([r.current[0], r.speed[0]]), r.time).T for r in RUNS]
    runs = [evolve(r, current=e[:, 0]) for r, e in zip(RUNS, expected, strict=True)]
    highest = max(np.abs(e[:, 0]).max() for e in expected)
    assert 5e-3 * highest**2 > 10
    assert relative_errors(simulated(motor, runs), expected)[0] < 5e-3


@pytest.mark.parametrize(
    ("gap_rad", "drag"), [(1e-3, 0.0), (0.07, 0.0), pytest.param(0.07, 6e-5, marks=pytest.mark.slow)]
)
def test_stiff_teeth_are_nearly_as_accurate(x64, gap_rad, drag):
    """They ring at 840 Hz, about once per sample, as those of real gears do; also with drag, which is not linear."""
    stiff = {"stiffness_Nm_rad": 2800.0, "damping_Nms_rad": 0.3, "load_share": 0.7}
    values = {**stiff, "gap_rad": gap_rad}

    def rates(x, v, load, values):
        i, w, *others = rates_with_backlash(x, v, load, values)
        return [i, w - drag * x[1] * abs(x[1]) / ((1 - stiff["load_share"]) * PAPER["J"]), *others]

    case = CASES["gear_backlash"]._replace(values=values, rates=rates)
    expected = []
    for run in RUNS:
        start = case.start(run.speed[0], run.load[0], values)
        x = np.array([run.current[0], run.speed[0], *start])
        expected.append(integrated(case, run, x, run.time)[:2].T)
    motor = with_effect("gear_backlash", values)
    if drag:
        also = with_effect("quadratic_drag", {"drag_Nms2_rad2": drag})
        motor = motor.with_effects(motor.effects + also.effects)
    # an impact lasts for a fraction of a sample, so a small error of its time shows in the speed; with steps half as
    # long the error is a tenth of this
    assert relative_errors(simulated(motor, RUNS), expected)[1] < 2e-3


@each_simulated
def test_converges_to_the_independent_integrator(x64, name):
    """With samples four times as short, better than first order over the common time."""
    if EFFECTS[name].affine:
        pytest.skip("exact at every step, by test_agrees_with_an_independent_integrator")
    errors = []
    longest = EFFECTS[name].longest_step  # longer samples are divided into steps
    for step in (longest, longest / 4):
        runs = recordings(step)
        window = [run.time < len(run) * longest / 4 for run in runs]
        found, expected = (
            [x[inside] for x, inside in zip(states, window, strict=True)]
            for states in (simulated(with_effect(name), runs), [reference(name, r) for r in runs])
        )
        errors.append(relative_errors(found, expected)[1])
    assert errors[1] < errors[0] / 6, errors


@pytest.mark.parametrize("name", ["shaft_compliance", "gear_backlash"])
def test_a_run_may_begin_with_a_twisted_shaft(x64, name):
    case, tape, twist = CASES[name], Tape.from_recordings(RUNS), 0.02
    expected = []
    for run in RUNS:
        start = np.array([run.current[0], run.speed[0], *case.start(run.speed[0], run.load[0], case.values)])
        start[-1] += twist
        expected.append(integrated(case, run, start, run.time)[:2])
    twisted = RunUnknowns.as_recorded(tape)._replace(twist=jnp.full(tape.runs, twist))
    outputs = free_run(with_effect(name), tape, twisted)
    for k, (run, right) in enumerate(zip(RUNS, expected, strict=True)):
        for channel in range(2):
            found = tape.samples_of(k, outputs[:, channel], len(run))
            assert np.max(np.abs(found - right[channel])) < case.tolerance * np.max(right[channel])


@pytest.mark.parametrize("name", ["shaft_compliance", pytest.param("gear_backlash", marks=pytest.mark.slow)])
def test_a_constant_load_acts_on_the_same_inertia_as_a_recorded_one(x64, name):
    """On the load's side of the shaft or gear, which it twists already before a run begins."""
    weight, motor = 0.1, with_effect(name)
    loaded = motor.with_effects([*motor.effects, EFFECTS["constant_load"](jnp.asarray(weight))])
    tape, heavier = (
        Tape.from_recordings([evolve(run, load=run.load + more) for run in RUNS]) for more in (0.0, weight)
    )
    found = free_run(loaded, tape, RunUnknowns.as_recorded(tape))
    expected = free_run(motor, heavier, RunUnknowns.as_recorded(heavier))
    for k, run in enumerate(RUNS):
        for channel in range(2):
            both, one = (tape.samples_of(k, outputs[:, channel], len(run)) for outputs in (found, expected))
            np.testing.assert_allclose(both, one, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_many_short_blocks_of_a_run_with_backlash_are_joined(x64):
    """A slow, small sine at 0.2 ms: some sixty blocks, half as long as the motor's response to its initial state."""
    time = 2e-4 * np.arange(8000)
    volts, at_rest = 4 * np.sin(2 * np.pi * 2 * time), np.zeros(len(time))
    tape = Tape.from_recordings([Recording("wave", time, volts, at_rest, at_rest, load=at_rest)])
    values = {"stiffness_Nm_rad": 770.0, "damping_Nms_rad": 0.162, "load_share": 0.647}
    gear = EFFECTS["gear_backlash"](**jax.tree.map(jnp.asarray, {**values, "gap_rad": 0.0765}))
    numbers = (4.47, 0.0011, 0.1294, 0.131, 2.11e-4, 8.3e-5)
    motor = Motor(*map(jnp.asarray, numbers), effects=(gear,))
    outputs, *_ = sensitivities(lambda nothing: motor, jnp.zeros(1), tape)
    assert np.max(np.abs(outputs - free_run(motor, tape))) < 1e-4 * np.max(np.abs(outputs))


def without_amplitude(name: str) -> dict[str, float]:
    return {**CASES[name].values, **dict.fromkeys(CASES[name].amplitude.split(), 0.0)}


@each_simulated
def test_an_effect_without_amplitude_leaves_the_linear_motor(x64, name):
    linear = simulated(LINEAR, RUNS)
    if not CASES[name].amplitude:
        pytest.skip("two inertias never become one")
    lowest = dict(CASES[name].values)
    for amplitude in CASES[name].amplitude.split():
        if EFFECTS[name].ranges[amplitude].scale == "log":
            lowest[amplitude] = EFFECTS[name].ranges[amplitude].lower
        else:
            lowest[amplitude] = 0.0
    if name != "speed_sensor_lag":  # whose step is undefined at zero itself
        found = simulated(with_effect(name, without_amplitude(name)), RUNS)
        assert relative_errors(found, linear)[0] < 1e-9
    assert relative_errors(simulated(with_effect(name, lowest), RUNS), linear)[0] < 1e-4


@each_simulated
def test_sensitivities_match_central_differences(x64, name):
    """By every parameter of motor and effect, and all that a run has of its own; of instantaneous and mean speeds."""
    bounds = {n: (x / 2, x * 2) for n, x in PAPER.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name]])
    truth = PAPER | {f"{name}.{n}": x for n, x in CASES[name].values.items()}
    scales = zip(parameters.names, parameters.logarithmic, strict=True)
    at = np.array([np.log(truth[n]) if log else truth[n] for n, log in scales])
    tape = Tape.from_recordings(averaged(RUNS, AROUND, None, OVER_BOTH))
    own = np.column_stack([tape.initial, np.full((tape.runs, 4), [0.01, 0.2, 0.02, 0.1])])
    # away from zero, where a dry element has no derivative
    own[2:, :2] = 1.0, 5.0
    start_of_runs = RunUnknowns(*jnp.asarray(own.T))
    outputs, jacobian, *_ = sensitivities(parameters, jnp.asarray(at), tape, start_of_runs)

    def run(at, own):
        start_of_runs = RunUnknowns(*jnp.asarray(own.T))
        return np.asarray(free_run(parameters(jnp.asarray(at)), tape, start_of_runs))

    np.testing.assert_allclose(outputs, run(at, own), rtol=1e-9, atol=1e-9)
    count = len(at)
    for column in range(count + UNKNOWNS_PER_RUN):
        step = np.zeros(count + UNKNOWNS_PER_RUN)
        step[column] = CASES[name].difference * max(1.0, np.abs(np.r_[at, own.max(0)][column]))
        up, down = (run(at + s * step[:count], own + s * step[count:]) for s in (1, -1))
        expected = (up - down) / (2 * step[column])
        if not expected.any():
            assert not jacobian[..., column].any()
            continue
        error = np.linalg.norm(jacobian[..., column] - expected) / np.linalg.norm(expected)
        assert error < CASES[name].slope_tolerance, (column, parameters.names[column : column + 1], error)


@each_simulated
def test_squared_errors_of_the_search_match_the_free_run(x64, name):
    """Also for a population; the search rounds delays to whole samples."""
    motor = with_effect(name, CASES[name].values | ({"delay_s": 3e-3} if "delay" in name else {}))
    tape = Tape.from_recordings(averaged(RUNS, OVER_LAST, None, OVER_LAST))
    outputs = free_run(motor, tape)
    expected = (((outputs - tape.measured) ** 2) * tape.weight).sum((0, 2))
    found = squared_errors(jax.tree.map(lambda x: np.full(2, x), motor), tape)
    np.testing.assert_allclose(np.array(found)[:, 1], expected, rtol=1e-6)


STIFF = "R or L several times that of the linear part, on a stiff motor: diverges"
CHAOS = "1 kN m at 200 periods a turn: the sensitivity of a block's end to its start overflows"
STIFF_TEETH = "teeth that ring hundreds of times in the shortest of steps: diverges"
STIFF_DRAG = "a ship's drag on a small motor stops it within a millionth of the shortest step: diverges"
STIFF_DAMPING = "a ship's damping without a spring, on a small motor: its exponential overflows"
NOT_FINITE = {
    "quadratic_drag": STIFF_DRAG,
    "shaft_compliance": STIFF_DAMPING,
    "resistance_heating": STIFF,
    "inductance_saturation": STIFF,
    "cogging_torque": CHAOS,
    "gear_backlash": STIFF_TEETH,
}


def _may_diverge(name: str):
    reason = NOT_FINITE.get(name)
    return pytest.mark.xfail(strict=True, reason=reason) if reason else ()


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=_may_diverge(name)) for name in EFFECTS])
def test_outputs_are_finite_over_the_whole_ranges(x64, name):
    """At every corner of the ranges of the parameters, outputs and sensitivities are finite."""
    bounds = {n: (x / 2, x * 2) for n, x in PAPER.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name]])
    tape = Tape.from_recordings(RUNS)
    base = np.log(list(PAPER.values()))
    limits = np.stack([parameters.lower[6:], parameters.upper[6:]])
    for corner in np.ndindex(*(2,) * limits.shape[1]):
        at = jnp.asarray(np.append(base, limits[list(corner), np.arange(limits.shape[1])]))
        outputs, jacobian, *_ = sensitivities(parameters, at, tape)
        assert jnp.all(jnp.isfinite(outputs)) and jnp.all(jnp.isfinite(jacobian)), (corner, at[6:])


# ----------------------------------------------------------------------------------- physics


@each_simulated
@pytest.mark.parametrize("step", [1e-3, 2e-2])
def test_stored_energy_never_rises_without_a_drive(x64, name, step):
    """With shorted terminals, without load and with Kt = Kb, the energy falls at every sample, however long that is."""
    if not CASES[name].dissipates:
        pytest.skip("it may return stored energy")
    motor = with_effect(name, Kt=PAPER["Kb"])
    silent = recordings(step, voltage=0.0, load=0.0)
    for x, run in zip(simulated(motor, silent), silent, strict=True):
        energy = (motor.L * x[:, 0] ** 2 + motor.J * x[:, 1] ** 2) / 2
        assert energy[0] > 0 or run.name == "run 2"
        assert np.all(np.diff(energy) <= 1e-12 * energy[0])


def steady(name: str, values: Values, voltage: float, load: float = 0.0) -> np.ndarray:
    """Current and speed from rest at one voltage and load, (samples, 2)."""
    return simulated(with_effect(name, values), recordings(voltage=voltage, load=load))[2]


def test_stribeck_friction_may_not_rise_from_standstill():
    one = {"coulomb_Nm": np.float64(0.2), "static_Nm": np.float64(0.3), "speed_rad_s": 5.0}
    other = {**one, "coulomb_Nm": np.float64(0.4)}
    assert EFFECTS["stribeck_friction"](**one).is_possible()
    assert not EFFECTS["stribeck_friction"](**other).is_possible()


@pytest.mark.parametrize("direction", [1, -1])
def test_friction_sticks_below_break_away_and_slips_above(x64, direction):
    """At standstill the torque is Kt v / R; below the friction torque the speed is exactly zero."""
    values = CASES["coulomb_friction"].values
    limit = direction * values["torque_Nm"] * PAPER["R"] / PAPER["Kt"]
    sticking = steady("coulomb_friction", values, 0.999 * limit)
    assert np.all(sticking[:, 1] == 0)
    assert sticking[-1, 0] == pytest.approx(0.999 * limit / PAPER["R"])
    slipping = steady("coulomb_friction", values, 1.01 * limit)
    assert np.all(np.diff(direction * slipping[:, 1]) >= 0)
    assert direction * slipping[-1, 1] > 0


@pytest.mark.parametrize("direction", [1, -1])
def test_friction_holds_a_load(x64, direction):
    values = CASES["coulomb_friction"].values
    limit = direction * values["torque_Nm"]
    assert np.all(steady("coulomb_friction", values, 0.0, 0.999 * limit)[:, 1] == 0)
    pushed = steady("coulomb_friction", values, 0.0, 1.001 * limit)[:, 1]
    assert np.all(np.diff(direction * pushed) <= 0)
    assert direction * pushed[-1] < 0


def test_friction_stops_a_coasting_rotor_for_good(x64):
    """Driven by a torque of zero, it stops as by the closed form, and stays at exactly zero."""
    coasting = recordings(voltage=None, current=None, torque=0.0, load=0.0)
    pull = CASES["coulomb_friction"].values["torque_Nm"] / PAPER["f"]
    for run, x in zip(coasting, simulated(with_effect("coulomb_friction"), coasting), strict=True):
        direction, decay = np.sign(run.speed[0]), np.exp(-PAPER["f"] / PAPER["J"] * run.time)
        expected = direction * np.maximum((abs(run.speed[0]) + pull) * decay - pull, 0.0)
        assert expected[-1] == 0
        np.testing.assert_allclose(x[:, 1], expected, rtol=1e-9, atol=1e-9)
        assert np.all(x[expected == 0, 1] == 0)


@pytest.mark.parametrize("direction", [1, -1])
def test_brushes_block_the_current_below_their_voltage_drop(x64, direction):
    values = CASES["brush_voltage_drop"].values
    limit = direction * values["voltage_V"]
    assert np.all(steady("brush_voltage_drop", values, 0.999 * limit)[:, 0] == 0)
    assert np.all(direction * steady("brush_voltage_drop", values, 1.05 * limit)[1:, 0] > 0)


def test_brushes_reduce_the_steady_speed_by_their_voltage_drop(x64):
    """In steady state R i = v - drop - Kb w and Kt i = f w."""
    runs = recordings(0.02, voltage=12.0, load=0.0)
    current, speed = simulated(with_effect("brush_voltage_drop"), runs)[0][-1]
    drop = CASES["brush_voltage_drop"].values["voltage_V"]
    m = PAPER
    expected = (12 - drop) / (m["Kb"] + m["R"] * m["f"] / m["Kt"])
    assert (speed, current) == pytest.approx((expected, m["f"] * expected / m["Kt"]), rel=1e-9)


def test_the_steady_temperature_rise_matches_the_loss(x64):
    """Kept at standstill by a huge inertia: rise = rise_per_W R i^2 (1 + rise) and i = v / (R (1 + rise))."""
    values = {"rise_per_W": 0.05, "time_constant_s": 0.3}
    runs = recordings(0.02, voltage=2.0, load=0.0)
    current = simulated(with_effect("resistance_heating", values, J=1e9), runs)[2][-1, 0]
    rise = (-1 + np.sqrt(1 + 4 * values["rise_per_W"] * 4 / PAPER["R"])) / 2
    assert rise > 0.5
    assert current == pytest.approx(2 / (PAPER["R"] * (1 + rise)), rel=1e-5)


# ------------------------------------------------------------------------------- descriptions


@every_effect
def test_every_effect_is_documented(name):
    """Name, fields, units, ranges and source, on which search, reports and readers rely."""
    effect = EFFECTS[name]
    snake = re.sub(r"(?<!^)(?=[A-Z])", "_", effect.__name__).lower()
    assert (effect.name, snake) == (name, name)
    parameters = [f.name for f in dataclasses.fields(effect)]
    assert parameters == list(effect.ranges)
    for section in ("**Fields**", "**Excitation needed**", "**Source**"):
        assert section in effect.__doc__
    for field, r in effect.ranges.items():
        assert field in effect.__doc__
        assert r.lower < r.upper
        assert r.scale == "linear" or r.lower > 0
        assert r.lower <= CASES[name].values[field] <= r.upper
        # the name of a field ends with its unit, if it has one
        assert pint.Unit(r.unit).dimensionality is not None
        unit = r.unit.replace("1/", "per_").replace("/", "_")
        assert field.endswith(unit.replace(" ", "").replace("^", ""))


@every_effect
def test_every_effect_is_on_the_page_of_effects(name):
    rows = DOCUMENTED.read_text(encoding="utf-8").splitlines()
    (row,) = [line for line in rows if line.startswith(f"| `{name}` |")]
    shares_row_above = name == "gear_backlash"  # of `shaft_compliance`, which it extends
    fields = EFFECTS[name].ranges.keys() - (EFFECTS["shaft_compliance"].ranges.keys() if shares_row_above else set())
    assert all(f"`{field}`" in row for field in fields)


def test_effects_that_share_a_state_agree_on_it(x64):
    """Cogging and ripple share the angle, with one rate and one initial value."""
    motors = {name: with_effect(name) for name in EFFECTS}
    speed, load, angle = (jnp.asarray(x) for x in (10.0, 0.3, 0.5))
    known = {}
    for name, motor in motors.items():
        assert not set(motor.states) & {"current", "speed"}
        state = motor.initial_state(jnp.asarray(5.0), speed, load, angle)
        rate = motor.derivative(state, jnp.asarray(3.0), load)
        for extra in motor.states:
            both = float(state.extra[extra]), float(rate.extra[extra])
            assert known.setdefault(extra, both) == both, (name, extra)


@every_effect
def test_every_state_has_a_rate(x64, name):
    """An effect gives rates of all its own states, and of no others."""
    motor = with_effect(name)
    state = motor.initial_state(jnp.asarray(5.0), jnp.asarray(10.0))
    rates = motor.derivative(state, jnp.asarray(3.0), jnp.asarray(0.0))
    assert set(rates.extra) == set(EFFECTS[name].states) == set(motor.states)
    assert jax.tree.structure(rates) == jax.tree.structure(state)


@every_effect
def test_only_dry_elements_grip(name):
    motor = with_effect(name)
    state = motor.initial_state(jnp.asarray(0.0), jnp.asarray(0.0))
    for holds in ("current", "speed"):
        grip = motor.grip(holds, state)
        assert (grip is not None) == (EFFECTS[name].holds == holds)
        assert grip is None or min(grip) >= 0
    if EFFECTS[name].holds is None:
        with pytest.raises(NotImplementedError, match=name):
            motor.effects[0].grip(state)
