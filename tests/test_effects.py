"""Every effect of the table: against independent integrators, its derivatives, and what physics demands."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pint
import pytest
from scipy.integrate import solve_ivp

from benchmarks import virtual_bench as vb
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.parameters import Parameters
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.recording import Recording
from pmdc_jax.simulate import Tape, free_run, sensitivities

PAPER = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
STARTS = ((5.0, 60.0), (-3.0, -8.0), (0.0, 0.0))  # current A, speed rad/s of each run

Values = Mapping[str, float]


class Case(NamedTuple):
    """An effect large enough to matter, and who else can simulate it."""

    values: Values
    amplitude: str  # of no effect at zero
    bench: Callable[[Values], dict[str, float]] | None = (
        None  # keywords of the virtual bench's motor
    )
    rates: Callable | None = None  # for smooth effects: (x, v, load, values) to dx/dt, written out
    # worst error at 1 ms, relative to the largest value of each output; dry elements start and stop
    # within a sample, which costs the current a share of what it changes by in one
    tolerance: float = 1e-4
    dissipates: bool = True  # takes energy whatever the motor does


def heated(x, v, load, values):
    """Copper loss warms the winding, whose resistance rises with its temperature."""
    i, w, rise = x
    m, R = PAPER, PAPER["R"] * (1 + rise)
    return [
        (v - R * i - m["Kb"] * w) / m["L"],
        (m["Kt"] * i - m["f"] * w - load) / m["J"],
        (values["rise_per_W"] * R * i**2 - rise) / values["time_constant_s"],
    ]


CASES = {
    "coulomb_friction": Case(
        {"torque_Nm": 0.15},
        "torque_Nm",
        bench=lambda p: {"coulomb_Nm": p["torque_Nm"]},
        tolerance=2e-3,
    ),
    "brush_voltage_drop": Case(
        {"voltage_V": 1.2},
        "voltage_V",
        bench=lambda p: {"brush_drop_V": p["voltage_V"]},
        tolerance=3e-2,
    ),
    "resistance_heating": Case(
        {"rise_per_W": 1e-2, "time_constant_s": 0.3}, "rise_per_W", rates=heated
    ),
}
every_effect = pytest.mark.parametrize("name", EFFECTS)


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


def simulated(motor: Motor, runs: list[Recording]) -> list[np.ndarray]:
    """Current and speed of every run, (samples, 2)."""
    tape = Tape.from_recordings(runs)
    seen = free_run(motor, tape, jnp.asarray(tape.initial), jnp.zeros(len(runs)))
    return [
        np.stack([tape.samples_of(k, seen[:, c], len(run)) for c in range(2)], 1)
        for k, run in enumerate(runs)
    ]


def reference(name: str, run: Recording) -> np.ndarray:
    """The same run by scipy or by the virtual bench."""
    case = CASES[name]
    start = (run.current[0], run.speed[0], 0.0)
    if case.bench:
        motor = dataclasses.replace(vb.paper_motor(), **case.bench(case.values))
        return vb.simulate(motor, vb.Excitation(run.time, run.voltage, run.load), start)[:, :2]
    states = [np.array(start)]
    for v, load in zip(run.voltage[:-1], run.load[:-1], strict=True):
        held = solve_ivp(
            lambda t, x, v=v, load=load: case.rates(x, v, load, case.values),
            (0.0, run.sample_time),
            states[-1],
            "DOP853",
            rtol=1e-10,
            atol=1e-10,
        )
        states.append(held.y[:, -1])
    return np.array(states)[:, :2]


def relative_errors(found: list[np.ndarray], expected: list[np.ndarray]) -> np.ndarray:
    """Largest and root mean square error over all samples, over the largest value of each output."""
    errors = np.concatenate(found) - np.concatenate(expected)
    scaled = errors / np.abs(np.concatenate(expected)).max(0)
    return np.array([np.abs(scaled).max(), np.sqrt(np.mean(scaled**2))])


def test_every_effect_has_a_case():
    assert set(CASES) == set(EFFECTS)


@every_effect
def test_agrees_with_an_independent_integrator(x64, name):
    expected = [reference(name, run) for run in RUNS]
    plain = relative_errors(simulated(with_effect(name, zero(name)), RUNS), expected)
    found = relative_errors(simulated(with_effect(name), RUNS), expected)
    assert plain[1] > 0.02, "the effect hardly shows, so this test would prove nothing"
    assert found[0] < CASES[name].tolerance, found


@every_effect
def test_converges_to_the_independent_integrator(x64, name):
    """Samples four times as short: better than first order, over the time that both cover."""
    errors = []
    for step in (2e-3, 5e-4):
        runs = recordings(step)
        window = [run.time < len(run) * 5e-4 for run in runs]
        found, expected = (
            [x[inside] for x, inside in zip(states, window, strict=True)]
            for states in (simulated(with_effect(name), runs), [reference(name, r) for r in runs])
        )
        errors.append(relative_errors(found, expected)[1])
    assert errors[1] < errors[0] / 6, errors


def zero(name: str) -> dict[str, float]:
    return {**CASES[name].values, CASES[name].amplitude: 0.0}


@every_effect
def test_without_amplitude_it_is_the_linear_motor(x64, name):
    linear = simulated(Motor(**{n: np.asarray(x) for n, x in PAPER.items()}), RUNS)
    lowest = {
        **CASES[name].values,
        CASES[name].amplitude: EFFECTS[name].ranges[CASES[name].amplitude].lower,
    }
    assert relative_errors(simulated(with_effect(name, zero(name)), RUNS), linear)[0] < 1e-9
    assert relative_errors(simulated(with_effect(name, lowest), RUNS), linear)[0] < 1e-4


@every_effect
def test_sensitivities_are_central_differences(x64, name):
    """By every parameter of motor and effect, and each run's own start and load offset."""
    bounds = {n: (x / 2, x * 2) for n, x in PAPER.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name]])
    truth = PAPER | {f"{name}.{n}": x for n, x in CASES[name].values.items()}
    scales = zip(parameters.names, parameters.logarithmic, strict=True)
    at = np.array([np.log(truth[n]) if log else truth[n] for n, log in scales])
    tape = Tape.from_recordings(RUNS)
    local = np.column_stack([tape.initial, np.full(3, 0.01)])
    # away from zero, where a dry element has no derivative
    local[2, :2] = 1.0, 5.0
    seen, jacobian = sensitivities(parameters, jnp.asarray(at), tape, local[:, :2], local[:, 2])

    def run(at, local):
        return np.asarray(free_run(parameters(jnp.asarray(at)), tape, local[:, :2], local[:, 2]))

    np.testing.assert_allclose(seen, run(at, local), rtol=1e-9, atol=1e-9)
    count = len(at)
    for column in range(count + 3):
        step = np.zeros(count + 3)
        step[column] = 1e-5 * max(1.0, np.abs(np.r_[at, local.max(0)][column]))
        up, down = (run(at + s * step[:count], local + s * step[count:]) for s in (1, -1))
        expected = (up - down) / (2 * step[column])
        error = np.linalg.norm(jacobian[..., column] - expected) / np.linalg.norm(expected)
        assert error < 1e-4, (column, parameters.names[column : column + 1], error)


# ----------------------------------------------------------------------------------- physics


@every_effect
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
        # the unit in the name is the unit of the table
        assert pint.Unit(r.unit).dimensionality is not None
        assert field.endswith(r.unit.replace("1/", "per_").replace(" ", ""))


def test_states_belong_to_one_effect_each():
    states = [state for effect in EFFECTS.values() for state in effect.states]
    assert len(set(states)) == len(states)
    assert not set(states) & {"current", "speed"}


@every_effect
def test_states_have_rates(x64, name):
    """An effect moves its own states, all of them, and no other."""
    motor = with_effect(name)
    state = motor.rest(jnp.asarray(5.0), jnp.asarray(10.0))
    rates = motor.derivative(state, jnp.asarray(3.0), jnp.asarray(0.0))
    assert set(rates.extra) == set(EFFECTS[name].states) == set(motor.states)
    assert jax.tree.structure(rates) == jax.tree.structure(state)


@every_effect
def test_only_dry_elements_grip(name):
    motor = with_effect(name)
    state = motor.rest(jnp.asarray(0.0), jnp.asarray(0.0))
    for holds in ("current", "speed"):
        grip = motor.grip(holds, state)
        assert (grip is not None) == (EFFECTS[name].holds == holds)
        assert grip is None or min(grip) >= 0
    if EFFECTS[name].holds is None:
        with pytest.raises(NotImplementedError, match=name):
            motor.effects[0].grip(state)
