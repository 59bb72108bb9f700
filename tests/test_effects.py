"""Every effect of the table: against independent integrators, its derivatives, and what physics demands."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import attrs
import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest
from attrs import evolve
from scipy.integrate import cumulative_trapezoid, solve_ivp

from benchmarks import virtual_bench as vb
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.parameters import Parameters
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.recording import OVER_BOTH, OVER_LAST, Averaging, Recording
from pmdc_jax.simulate import (
    UNKNOWNS_PER_RUN,
    RunUnknowns,
    Tape,
    free_run,
    sensitivities,
    squared_errors,
)

PAPER = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
STARTS = ((5.0, 60.0), (-3.0, -8.0), (0.0, 0.0))  # current A, speed rad/s of each run

Values = Mapping[str, float]


class Case(NamedTuple):
    """An effect large enough to matter, and who else can simulate it.

    Either `bench`, keywords of the virtual bench's motor; or `rates`, for (x, v, load, values) the whole of
    dx/dt, x beginning with current and speed, integrated by scipy; for friction of its own kind, `friction` gives
    the torque at which it slips, for (speed, direction, values), and scipy's events find where it does.
    """

    values: Values
    amplitude: str  # of no effect at zero
    bench: Callable[[Values], dict[str, float]] | None = None
    rates: Callable | None = None
    friction: Callable | None = None
    start: Callable | None = None  # of the effect's own states, for (speed, load, values)
    reported: Callable | None = None  # current and speed of x (states, samples), for (x, values)
    # worst error at 1 ms, relative to the largest value of each output; dry elements start and stop
    # within a sample
    tolerance: float = 1e-4
    # of the sensitivities, relative to central differences over this step
    slope_tolerance: float = 1e-4
    difference: float = 1e-5
    dissipates: bool = True  # takes energy whatever the motor does
    shows: float = (
        0.02  # by how much at least the outputs change, root mean square over the largest
    )


def electrical(i, w, v, L=None, R=None):
    """di/dt of the linear motor, written out."""
    return (v - (R or PAPER["R"]) * i - PAPER["Kb"] * w) / (L or PAPER["L"])


def mechanical(i, w, load, Kt=None, J=None):
    """dw/dt of the linear motor, written out."""
    return ((Kt or PAPER["Kt"]) * i - PAPER["f"] * w - load) / (J or PAPER["J"])


def linear(x, v, load, values):
    return [electrical(x[0], x[1], v), mechanical(x[0], x[1], load)]


def heated(x, v, load, values):
    """Copper loss warms the winding, whose resistance rises with its temperature."""
    i, w, rise = x
    R = PAPER["R"] * (1 + rise)
    warming = (values["rise_per_W"] * R * i**2 - rise) / values["time_constant_s"]
    return [electrical(i, w, v, R=R), mechanical(i, w, load), warming]


def dragged(x, v, load, values):
    drag = values["drag_Nms2_rad2"] * x[1] * abs(x[1])
    return linear(x, v, load + drag, values)


def cogged(x, v, load, values):
    pull = values["amplitude_Nm"] * np.sin(values["periods"] * x[2] + values["phase_rad"])
    return [*linear(x, v, load + pull, values), x[1]]


def rippled(x, v, load, values):
    wave = values["amplitude"] * np.sin(values["periods"] * x[2] + values["phase_rad"])
    Kt = PAPER["Kt"] * (1 + wave)
    emf = 1 + values["emf_share"] * wave
    return [electrical(x[0], emf * x[1], v), mechanical(x[0], x[1], load, Kt=Kt), x[1]]


def saturated(x, v, load, values):
    flux = 1 / (1 + values["per_A2"] * x[0] ** 2)
    emf = 1 - values["emf_share"] * (1 - flux)
    return [electrical(x[0], emf * x[1], v), mechanical(x[0], x[1], load, Kt=PAPER["Kt"] * flux)]


def two_inertias(x, v, load, values, torque):
    i, w, load_speed, _ = x
    share = values["load_share"]
    return [
        electrical(i, w, v),
        mechanical(i, w, torque, J=(1 - share) * PAPER["J"]),
        (torque - load) / (share * PAPER["J"]),
        w - load_speed,
    ]


def sprung(x, v, load, values):
    torque = values["stiffness_Nm_rad"] * x[3] + values["damping_Nms_rad"] * (x[1] - x[2])
    return two_inertias(x, v, load, values, torque)


def geared(x, v, load, values):
    """Spring and damper only beyond the flanks, which push and never pull."""
    side, beyond = np.sign(x[3]), abs(x[3]) - values["gap_rad"] / 2
    push = values["stiffness_Nm_rad"] * beyond + side * values["damping_Nms_rad"] * (x[1] - x[2])
    return two_inertias(x, v, load, values, side * max(push, 0.0) if beyond > 0 else 0.0)


def lagging(x, v, load, values):
    return [*linear(x[:2], v, load, values), (x[1] - x[2]) / values["time_constant_s"]]


def stribeck(speed, direction, values):
    slow = np.exp(-((speed / values["speed_rad_s"]) ** 2))
    return values["coulomb_Nm"] + (values["static_Nm"] - values["coulomb_Nm"]) * slow


WAVE = {"phase_rad": 0.7, "periods": 6.0}

CASES = {
    "coulomb_friction": Case(
        {"torque_Nm": 0.15},
        "torque_Nm",
        bench=lambda p: {"coulomb_Nm": p["torque_Nm"]},
        tolerance=2e-3,
    ),
    "stribeck_friction": Case(
        {"coulomb_Nm": 0.1, "static_Nm": 0.2, "speed_rad_s": 15.0},
        "coulomb_Nm static_Nm",
        friction=stribeck,
        tolerance=1e-3,
    ),
    "asymmetric_friction": Case(
        {"forward_Nm": 0.2, "backward_Nm": 0.1},
        "forward_Nm backward_Nm",
        friction=lambda w, way, p: p["forward_Nm"] if way > 0 else p["backward_Nm"],
        tolerance=2e-3,
    ),
    "quadratic_drag": Case({"drag_Nms2_rad2": 6e-5}, "drag_Nms2_rad2", rates=dragged),
    "cogging_torque": Case(
        {"amplitude_Nm": 0.1} | WAVE,
        "amplitude_Nm",
        rates=cogged,
        start=lambda w, load, p: [0.0],
        dissipates=False,
        shows=0.01,
    ),
    "torque_ripple": Case(
        {"amplitude": 0.3, "emf_share": 0.4} | WAVE,
        "amplitude",
        rates=rippled,
        start=lambda w, load, p: [0.0],
        dissipates=False,
        shows=0.01,
    ),
    "constant_load": Case(
        {"torque_Nm": 0.2},
        "torque_Nm",
        rates=lambda x, v, load, p: linear(x, v, load + p["torque_Nm"], p),
        dissipates=False,
    ),
    "shaft_compliance": Case(
        {"stiffness_Nm_rad": 10.0, "damping_Nms_rad": 3e-3, "load_share": 0.5},
        "",
        rates=sprung,
        start=lambda w, load, p: [w, load / p["stiffness_Nm_rad"]],
        dissipates=False,
    ),
    "gear_backlash": Case(
        {
            "gap_rad": 0.1,
            "stiffness_Nm_rad": 10.0,
            "damping_Nms_rad": 3e-3,
            "load_share": 0.5,
        },
        "",
        rates=geared,
        start=lambda w, load, p: [
            w,
            load / p["stiffness_Nm_rad"] + np.sign(load) * p["gap_rad"] / 2,
        ],
        dissipates=False,
    ),
    "brush_voltage_drop": Case(
        {"voltage_V": 1.2},
        "voltage_V",
        bench=lambda p: {"brush_drop_V": p["voltage_V"]},
        tolerance=1e-3,
    ),
    "resistance_heating": Case(
        {"rise_per_W": 1e-2, "time_constant_s": 0.3},
        "rise_per_W",
        rates=heated,
        start=lambda w, load, p: [0.0],
    ),
    "torque_constant_saturation": Case(
        {"per_A2": 3e-4, "emf_share": 0.4},
        "per_A2",
        rates=saturated,
        dissipates=False,
    ),
    "inductance_saturation": Case(
        {"per_A2": 5e-4},
        "per_A2",
        shows=0.01,
        rates=lambda x, v, load, p: [
            electrical(x[0], x[1], v, L=PAPER["L"] / (1 + p["per_A2"] * x[0] ** 2)),
            mechanical(x[0], x[1], load),
        ],
        dissipates=False,
    ),
    "input_dead_zone": Case(
        {"width_V": 1.5},
        "width_V",
        rates=lambda x, v, load, p: linear(
            x, np.sign(v) * max(abs(v) - p["width_V"], 0.0), load, p
        ),
    ),
    "speed_sensor_lag": Case(
        {"time_constant_s": 5e-3},
        "time_constant_s",
        rates=lagging,
        start=lambda w, load, p: [w],
        reported=lambda x, p: x[[0, 2]],
        dissipates=False,
    ),
    "speed_sensor_delay": Case(
        {"delay_s": 3.4e-3}, "delay_s", rates=linear, reported=lambda x, p: x[:2], dissipates=False
    ),
    "current_sensor_offset": Case(
        {"offset_A": 4.0},
        "offset_A",
        rates=linear,
        reported=lambda x, p: np.stack([x[0] + p["offset_A"], x[1]]),
        dissipates=False,
    ),
}
LINEAR = Motor(**{n: np.asarray(x) for n, x in PAPER.items()})
every_effect = pytest.mark.parametrize("name", EFFECTS)
# one that sticks, one of the winding, one with a state: the others compile for minutes
QUICK = {"coulomb_friction", "brush_voltage_drop", "resistance_heating"}
each_simulated = pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in EFFECTS]
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
    """The runs with speeds that are such means."""
    return [evolve(run, averaging=mean) for run, mean in zip(runs, means, strict=True)]


def simulated(motor: Motor, runs: list[Recording]) -> list[np.ndarray]:
    """Current and speed of every run, (samples, 2)."""
    tape = Tape.from_recordings(runs)
    seen = free_run(motor, tape)
    return [
        np.stack([tape.samples_of(k, seen[:, c], len(run)) for c in range(2)], 1)
        for k, run in enumerate(runs)
    ]


def reference(name: str, run: Recording) -> np.ndarray:
    """The same run by scipy or by the virtual bench."""
    case = CASES[name]
    values = case.values
    start = (run.current[0], run.speed[0])
    if case.bench:
        motor = dataclasses.replace(vb.paper_motor(), **case.bench(values))
        return vb.simulate(motor, vb.Excitation(run.time, run.voltage, run.load), (*start, 0.0))[
            :, :2
        ]
    if case.friction:
        return sticking(case, run)
    own = case.start(run.speed[0], run.load[0], values) if case.start else []
    states = integrated(case, run, np.array([*start, *own]), run.time)
    if "delay_s" in values:
        late, back = np.unique(np.maximum(run.time - values["delay_s"], 0.0), return_inverse=True)
        states[1] = integrated(case, run, np.array(start), late)[1, back]
    return (case.reported or (lambda x, p: x[:2]))(states, values).T


def held(run: Recording) -> list[tuple[float, float, float, float]]:
    """Begin, end, voltage and load of every stretch over which the inputs hold."""
    changes = np.flatnonzero(np.diff(run.voltage) != 0) + 1
    first = np.append(0, changes)
    ends = np.append(run.time[changes], run.time[-1] + run.sample_time)
    return list(zip(run.time[first], ends, run.voltage[first], run.load[first], strict=True))


PRECISE = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}


def integrated(case: Case, run: Recording, x: np.ndarray, times: np.ndarray) -> np.ndarray:
    """States (states, samples) at `times`, restarted wherever the inputs jump."""
    seen = []
    for begin, end, v, load in held(run):
        inside = times[(times >= begin - 1e-12) & (times < end - 1e-12)]
        solved = solve_ivp(
            lambda t, x, v=v, load=load: case.rates(x, v, load, case.values),
            (begin, end),
            x,
            t_eval=np.append(np.maximum(inside, begin), end),
            max_step=1e-3 if case.amplitude == "" else np.inf,  # not to step over a gap
            **PRECISE,
        )
        x = solved.y[:, -1]
        seen.append(solved.y[:, :-1])
    return np.concatenate(seen, 1)


def sticking(case: Case, run: Recording) -> np.ndarray:
    """Sliding and sticking by turns, each an ordinary differential equation, the changes found as events."""
    x, seen = np.array([run.current[0], run.speed[0]]), []
    for begin, end, v, load in held(run):
        inside = run.time[(run.time >= begin - 1e-12) & (run.time < end - 1e-12)]
        got, t = np.zeros((2, len(inside))), begin
        while t < end - 1e-12:
            t, x = _one_mode(case, t, end, x, v, load, inside, got)
        seen.append(got)
    return np.concatenate(seen, 1).T


def _one_mode(case, t, end, x, v, load, inside, got):
    """On to the next change between sliding and sticking, or to the end."""

    def driving(x):
        return PAPER["Kt"] * x[0] - load

    way = np.sign(x[1]) or np.sign(driving(x))
    sticks = x[1] == 0 and abs(driving(x)) <= case.friction(0.0, way, case.values) * (1 + 1e-9)

    def rates(t, x):
        i, w = x
        friction = way * case.friction(w, way, case.values)
        change = 0.0 if sticks else mechanical(i, w, load + friction)
        return [electrical(i, w, v), change]

    def stops(t, x):
        return x[1] * way + (t <= start + 1e-9)

    def slips(t, x):
        side = np.sign(driving(x))
        return abs(driving(x)) - case.friction(0.0, side, case.values) * (1 + 2e-9)

    start, event = t, slips if sticks else stops
    event.terminal, event.direction = True, 1 if sticks else -1
    solved = solve_ivp(
        rates, (t, end), x, events=event, dense_output=True, max_step=2e-3, **PRECISE
    )
    now = (inside >= t - 1e-12) & (inside < solved.t[-1] + 1e-12)
    if now.any():
        got[:, now] = solved.sol(np.maximum(inside[now], t))
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
    assert plain[1] > CASES[name].shows, "the effect hardly shows, so this test would prove nothing"
    assert found[0] < CASES[name].tolerance, found


FINE = 50


def mean_reference(name: str, run: Recording) -> np.ndarray:
    """The speed of a run as the difference of angles that it is, these by the trapezoidal rule over fine samples."""
    step = run.sample_time / FINE
    finely = {c: np.repeat(getattr(run, c), FINE) for c in ("voltage", "load", "current", "speed")}
    speed = reference(name, Recording("fine", step * np.arange(FINE * len(run)), **finely))[:, 1]
    angle = cumulative_trapezoid(speed, dx=step, initial=0.0)[::FINE]
    last = np.diff(angle) / run.sample_time
    both = (last[:-1] + last[1:]) / 2
    return (
        np.append(np.nan, last)
        if run.averaging == OVER_LAST
        else np.pad(both, 1, constant_values=np.nan)
    )


@pytest.mark.parametrize(
    "name",
    [
        n
        if n in QUICK | {"speed_sensor_delay", "constant_load"}
        else pytest.param(n, marks=pytest.mark.slow)
        for n in EFFECTS
    ],
)
def test_mean_speeds_agree_with_an_independent_integrator(x64, name):
    """As counters report them, over the last sample or two; at 2 ms, in which the voltage bends the motion."""
    runs = averaged(recordings(2e-3), OVER_LAST, OVER_BOTH, OVER_LAST)
    expected = np.concatenate([mean_reference(name, run) for run in runs])
    found, sampled = (
        np.concatenate(simulated(with_effect(name), of))[:, 1] for of in (runs, recordings(2e-3))
    )
    known, size = ~np.isnan(expected), np.nanmax(np.abs(expected))
    assert np.abs(sampled - expected)[known].max() > 0.02 * size, "a mean like any sample"
    # where something switches, the mean is mended along straight lines
    worst = max(5 * CASES[name].tolerance, 2e-3 if name == "gear_backlash" else 0.0)
    assert np.abs(found - expected)[known].max() < worst * size


@pytest.mark.parametrize("name, most", [("cogging_torque", 0.1), ("torque_ripple", 3.0)])
@pytest.mark.parametrize("periods", [12.0, 24.0])
def test_a_wave_that_comes_round_within_a_sample(x64, name, most, periods):
    """At full speed, by 5.8 and 11.5 rad a sample. If it were taken at samples, the speed would be off by 3 to 24 times
    what the wave does; of a ripple, whose current ripples as well, some is left."""
    values = CASES[name].values | {"periods": periods}
    values[CASES[name].amplitude] /= 5
    fast = recordings(voltage=24.0, load=0.0, current=2.4, speed=480.0)
    start, turning = np.array([2.4, 480.0, 0.0]), CASES[name]._replace(values=values)
    expected = np.concatenate([integrated(turning, run, start, run.time)[1] for run in fast])
    plain, found = (
        np.concatenate(simulated(motor, fast))[:, 1]
        for motor in (LINEAR, with_effect(name, values))
    )
    assert np.std(found - expected) < most * np.std(plain - expected)


@pytest.mark.parametrize("name", sorted(QUICK))
def test_a_held_rotor_stays_where_it_is(x64, name):
    """What acts on its winding acts as before: as on a motor too heavy to move."""
    still = [attrs.evolve(run, speed=0 * run.time) for run in RUNS]
    held = simulated(with_effect(name), [attrs.evolve(r, speed=None, held=True) for r in still])
    heavy = simulated(with_effect(name, J=1e9), still)
    for one, other in zip(held, heavy, strict=True):
        assert not one[:, 1].any()
        np.testing.assert_allclose(one[:, 0], other[:, 0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["resistance_heating", "stribeck_friction", "speed_sensor_delay"])
def test_slow_sampling_is_as_exact(x64, name):
    """At 10 ms, five times L / R, in equal steps of a millisecond or less; a delay is a part of a sample."""
    runs = [
        Recording(r.name, *(c[:64] for c in (r.time, r.voltage, r.current, r.speed, r.load)))
        for r in recordings(1e-2)
    ]
    found = relative_errors(simulated(with_effect(name), runs), [reference(name, r) for r in runs])
    assert found[0] < CASES[name].tolerance, found


def test_a_much_saturated_inductance_is_nearly_as_exact(x64):
    """Ten times as fast at the highest current as at none; with the steps of a little saturation it is 2 % off."""
    name = "inductance_saturation"
    case, motor = CASES[name]._replace(values={"per_A2": 5e-3}), with_effect(name, {"per_A2": 5e-3})
    expected = [integrated(case, r, np.array([r.current[0], r.speed[0]]), r.time).T for r in RUNS]
    runs = [evolve(r, current=e[:, 0]) for r, e in zip(RUNS, expected, strict=True)]
    highest = max(np.abs(e[:, 0]).max() for e in expected)
    assert 5e-3 * highest**2 > 10
    assert relative_errors(simulated(motor, runs), expected)[0] < 5e-3


@pytest.mark.parametrize(
    ("gap_rad", "drag"),
    [(1e-3, 0.0), (0.07, 0.0), pytest.param(0.07, 6e-5, marks=pytest.mark.slow)],
)
def test_hard_teeth_are_nearly_as_exact(x64, gap_rad, drag):
    """They ring at 840 Hz, hardly once in a sample, as those of a real gear do; beside drag, which is not linear."""
    hard = {"stiffness_Nm_rad": 2800.0, "damping_Nms_rad": 0.3, "load_share": 0.7}
    values = {**hard, "gap_rad": gap_rad}

    def rates(x, v, load, values):
        i, w, *others = geared(x, v, load, values)
        return [i, w - drag * x[1] * abs(x[1]) / ((1 - hard["load_share"]) * PAPER["J"]), *others]

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
    # an impact is over in a fraction of a sample, so a moment too late shows at once in the speed; steps half as long
    # are off by a tenth of this
    assert relative_errors(simulated(motor, RUNS), expected)[1] < 2e-3


@each_simulated
def test_converges_to_the_independent_integrator(x64, name):
    """Samples four times as short: better than first order, over the time that both cover."""
    if EFFECTS[name].affine:
        pytest.skip("exact at every step, as the test before has seen")
    errors = []
    longest = EFFECTS[name].longest_step  # longer samples are divided
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
def test_a_run_may_begin_twisted(x64, name):
    case, tape, twist = CASES[name], Tape.from_recordings(RUNS), 0.02
    expected = []
    for run in RUNS:
        start = np.array(
            [run.current[0], run.speed[0], *case.start(run.speed[0], run.load[0], case.values)]
        )
        start[-1] += twist
        expected.append(integrated(case, run, start, run.time)[:2])
    twisted = RunUnknowns.as_recorded(tape)._replace(twist=jnp.full(tape.runs, twist))
    seen = free_run(with_effect(name), tape, twisted)
    for k, (run, right) in enumerate(zip(RUNS, expected, strict=True)):
        for channel in range(2):
            found = tape.samples_of(k, seen[:, channel], len(run))
            assert np.max(np.abs(found - right[channel])) < case.tolerance * np.max(right[channel])


@pytest.mark.parametrize("name", ["shaft_compliance", "gear_backlash"])
def test_a_constant_load_acts_where_recorded_ones_do(x64, name):
    """Behind the shaft or gear, which it twists before a run begins, too."""
    weight, motor = 0.1, with_effect(name)
    loaded = motor.with_effects([*motor.effects, EFFECTS["constant_load"](jnp.asarray(weight))])
    tape, heavier = (
        Tape.from_recordings([evolve(run, load=run.load + more) for run in RUNS])
        for more in (0.0, weight)
    )
    found = free_run(loaded, tape, RunUnknowns.as_recorded(tape))
    expected = free_run(motor, heavier, RunUnknowns.as_recorded(heavier))
    for k, run in enumerate(RUNS):
        for channel in range(2):
            both, one = (
                tape.samples_of(k, seen[:, channel], len(run)) for seen in (found, expected)
            )
            np.testing.assert_allclose(both, one, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_teeth_in_many_short_blocks_are_joined(x64):
    """A slow small wave at 0.2 ms: some sixty blocks, each half as long as the motor remembers how it began."""
    time = 2e-4 * np.arange(8000)
    volts, still = 4 * np.sin(2 * np.pi * 2 * time), np.zeros(len(time))
    tape = Tape.from_recordings([Recording("wave", time, volts, still, still, load=still)])
    values = {"stiffness_Nm_rad": 770.0, "damping_Nms_rad": 0.162, "load_share": 0.647}
    gear = EFFECTS["gear_backlash"](**jax.tree.map(jnp.asarray, {**values, "gap_rad": 0.0765}))
    numbers = (4.47, 0.0011, 0.1294, 0.131, 2.11e-4, 8.3e-5)
    motor = Motor(*map(jnp.asarray, numbers), effects=(gear,))
    seen, _ = sensitivities(lambda nothing: motor, jnp.zeros(1), tape)
    assert np.max(np.abs(seen - free_run(motor, tape))) < 1e-4 * np.max(np.abs(seen))


def zero(name: str) -> dict[str, float]:
    return {**CASES[name].values, **dict.fromkeys(CASES[name].amplitude.split(), 0.0)}


@each_simulated
def test_without_amplitude_it_is_the_linear_motor(x64, name):
    linear = simulated(LINEAR, RUNS)
    if not CASES[name].amplitude:
        pytest.skip("two inertias are never one")
    lowest = dict(CASES[name].values)
    for amplitude in CASES[name].amplitude.split():
        if EFFECTS[name].ranges[amplitude].scale == "log":
            lowest[amplitude] = EFFECTS[name].ranges[amplitude].lower
        else:
            lowest[amplitude] = 0.0
    if name != "speed_sensor_lag":  # whose step has no limit at zero, only close to it
        assert relative_errors(simulated(with_effect(name, zero(name)), RUNS), linear)[0] < 1e-9
    assert relative_errors(simulated(with_effect(name, lowest), RUNS), linear)[0] < 1e-4


@each_simulated
def test_sensitivities_are_central_differences(x64, name):
    """By every parameter of motor and effect, and each run's own start and load offset; of speeds as they are and as
    means."""
    bounds = {n: (x / 2, x * 2) for n, x in PAPER.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name]])
    truth = PAPER | {f"{name}.{n}": x for n, x in CASES[name].values.items()}
    scales = zip(parameters.names, parameters.logarithmic, strict=True)
    at = np.array([np.log(truth[n]) if log else truth[n] for n, log in scales])
    tape = Tape.from_recordings(averaged(RUNS, OVER_LAST, None, OVER_BOTH))
    own = np.column_stack([tape.initial, np.full((tape.runs, 3), [0.01, 0.2, 0.02])])
    # away from zero, where a dry element has no derivative
    own[2:, :2] = 1.0, 5.0
    begun = RunUnknowns(*jnp.asarray(own.T))
    seen, jacobian = sensitivities(parameters, jnp.asarray(at), tape, begun)

    def run(at, own):
        begun = RunUnknowns(*jnp.asarray(own.T))
        return np.asarray(free_run(parameters(jnp.asarray(at)), tape, begun))

    np.testing.assert_allclose(seen, run(at, own), rtol=1e-9, atol=1e-9)
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
        assert error < CASES[name].slope_tolerance, (
            column,
            parameters.names[column : column + 1],
            error,
        )


@each_simulated
def test_the_search_sees_what_the_free_run_sees(x64, name):
    """Sums of squared errors of a population are those of its members; the search rounds delays to samples."""
    motor = with_effect(name, CASES[name].values | ({"delay_s": 3e-3} if "delay" in name else {}))
    tape = Tape.from_recordings(averaged(RUNS, OVER_LAST, None, OVER_LAST))
    seen = free_run(motor, tape)
    expected = (((seen - tape.measured) ** 2) * tape.weight).sum((0, 2))
    found = squared_errors(jax.tree.map(lambda x: np.full(2, x), motor), tape)
    np.testing.assert_allclose(np.array(found)[:, 1], expected, rtol=1e-6)


STIFF = "R or L several times that of the linear part, on a stiff motor: diverges"
CHAOS = "1 kN m at 200 periods a turn: what a start does to the end of a block is beyond any double"
STIFF_TEETH = "teeth that ring hundreds of times in the shortest of steps: diverges"
STIFF_DRAG = (
    "a ship's drag on a small motor stops it within a millionth of the shortest step: diverges"
)
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
def test_finite_all_over_its_ranges(x64, name):
    """At every corner of the table's ranges, values and sensitivities are numbers."""
    bounds = {n: (x / 2, x * 2) for n, x in PAPER.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name]])
    tape = Tape.from_recordings(RUNS)
    base = np.log(list(PAPER.values()))
    limits = np.stack([parameters.lower[6:], parameters.upper[6:]])
    for corner in np.ndindex(*(2,) * limits.shape[1]):
        at = jnp.asarray(np.append(base, limits[list(corner), np.arange(limits.shape[1])]))
        seen, jacobian = sensitivities(parameters, at, tape)
        assert jnp.all(jnp.isfinite(seen)) and jnp.all(jnp.isfinite(jacobian)), (corner, at[6:])


# ----------------------------------------------------------------------------------- physics


@each_simulated
@pytest.mark.parametrize("step", [1e-3, 2e-2])
def test_stored_energy_only_falls_when_nothing_drives(x64, name, step):
    """Shorted and unloaded, a motor with Kt = Kb loses energy at every sample, however long that is."""
    if not CASES[name].dissipates:
        pytest.skip("it may return energy that it stores")
    motor = with_effect(name, Kt=PAPER["Kb"])
    silent = recordings(step, voltage=0.0, load=0.0)
    for x, run in zip(simulated(motor, silent), silent, strict=True):
        energy = (motor.L * x[:, 0] ** 2 + motor.J * x[:, 1] ** 2) / 2
        assert energy[0] > 0 or run.name == "run 2"
        assert np.all(np.diff(energy) <= 1e-12 * energy[0])


def steady(name: str, values: Values, voltage: float, load: float = 0.0) -> np.ndarray:
    """Current and speed from rest at one voltage and load, (samples, 2)."""
    return simulated(with_effect(name, values), recordings(voltage=voltage, load=load))[2]


def test_friction_that_rises_from_standstill_is_no_stribeck_friction():
    one = {"coulomb_Nm": np.float64(0.2), "static_Nm": np.float64(0.3), "speed_rad_s": 5.0}
    other = {**one, "coulomb_Nm": np.float64(0.4)}
    assert EFFECTS["stribeck_friction"](**one).is_possible()
    assert not EFFECTS["stribeck_friction"](**other).is_possible()


@pytest.mark.parametrize("direction", [1, -1])
def test_friction_sticks_below_break_away_and_slips_above(x64, direction):
    """Locked, the torque is Kt v / R; below the friction torque nothing moves, not even a little."""
    values = CASES["coulomb_friction"].values
    limit = direction * values["torque_Nm"] * PAPER["R"] / PAPER["Kt"]
    held = steady("coulomb_friction", values, 0.999 * limit)
    assert np.all(held[:, 1] == 0)
    assert held[-1, 0] == pytest.approx(0.999 * limit / PAPER["R"])
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
    """Driven by a torque of zero: stops when the closed form says so, and stays at exactly zero."""
    coasting = recordings(voltage=None, current=None, torque=0.0, load=0.0)
    pull = CASES["coulomb_friction"].values["torque_Nm"] / PAPER["f"]
    for run, x in zip(coasting, simulated(with_effect("coulomb_friction"), coasting), strict=True):
        way, decay = np.sign(run.speed[0]), np.exp(-PAPER["f"] / PAPER["J"] * run.time)
        expected = way * np.maximum((abs(run.speed[0]) + pull) * decay - pull, 0.0)
        assert expected[-1] == 0
        np.testing.assert_allclose(x[:, 1], expected, rtol=1e-9, atol=1e-9)
        assert np.all(x[expected == 0, 1] == 0)


@pytest.mark.parametrize("direction", [1, -1])
def test_brushes_let_no_current_through_below_their_drop(x64, direction):
    values = CASES["brush_voltage_drop"].values
    limit = direction * values["voltage_V"]
    assert np.all(steady("brush_voltage_drop", values, 0.999 * limit)[:, 0] == 0)
    assert np.all(direction * steady("brush_voltage_drop", values, 1.05 * limit)[1:, 0] > 0)


def test_brushes_take_their_drop_of_the_steady_speed(x64):
    """In steady state R i = v - drop - Kb w and Kt i = f w."""
    runs = recordings(0.02, voltage=12.0, load=0.0)
    current, speed = simulated(with_effect("brush_voltage_drop"), runs)[0][-1]
    drop = CASES["brush_voltage_drop"].values["voltage_V"]
    m = PAPER
    expected = (12 - drop) / (m["Kb"] + m["R"] * m["f"] / m["Kt"])
    assert (speed, current) == pytest.approx((expected, m["f"] * expected / m["Kt"]), rel=1e-9)


def test_a_warm_winding_settles_where_its_loss_keeps_it(x64):
    """Stalled by a huge inertia: rise = rise_per_W R i^2 (1 + rise) and i = v / (R (1 + rise))."""
    values = {"rise_per_W": 0.05, "time_constant_s": 0.3}
    runs = recordings(0.02, voltage=2.0, load=0.0)
    current = simulated(with_effect("resistance_heating", values, J=1e9), runs)[2][-1, 0]
    rise = (-1 + np.sqrt(1 + 4 * values["rise_per_W"] * 4 / PAPER["R"])) / 2
    assert rise > 0.5
    assert current == pytest.approx(2 / (PAPER["R"] * (1 + rise)), rel=1e-5)


# ------------------------------------------------------------------------------- the table


@every_effect
def test_is_described(name):
    """Name, fields, units, ranges and source: what search, report and reader rely on."""
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
        # the unit in the name is the unit of the table; a plain number has none
        assert pint.Unit(r.unit).dimensionality is not None
        unit = r.unit.replace("1/", "per_").replace("/", "_")
        assert field.endswith(unit.replace(" ", "").replace("^", ""))


def test_a_state_is_the_same_in_all_effects_that_have_it(x64):
    """Cogging and ripple share the angle: one name, one rate and one start."""
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
def test_states_have_rates(x64, name):
    """An effect moves its own states, all of them, and no other."""
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
