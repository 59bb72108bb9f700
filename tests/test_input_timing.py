"""Voltages that are not held from their samples on: simulated as scipy does, and told from those that are."""

from __future__ import annotations

import attrs
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

from pmdc_jax import identify
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.parameters import Parameters
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.recording import Recording
from pmdc_jax.simulate import UNKNOWNS_PER_RUN, RunUnknowns, Tape, free_run, sensitivities

# sampled more slowly than its current settles: 2 ms beside L / R of 1.25 ms
SMALL = {"R": 0.8, "L": 1e-3, "Kb": 0.04, "Kt": 0.039, "J": 4e-5, "f": 3e-5}
STEP = 2e-3
FROM_REST = RunUnknowns(*np.zeros((UNKNOWNS_PER_RUN, 1)))


def driven(seed: int, samples: int, load: float = 0.0) -> Recording:
    """A voltage of several sines, which an amplifier follows; nothing measured yet."""
    rng, time = np.random.default_rng(seed), STEP * np.arange(samples)
    frequencies = np.geomspace(0.4, 40.0, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    voltage = 4 * np.sin(2 * np.pi * frequencies * time[:, None] + phases).sum(1) + 3
    return Recording(f"run{seed}", time, voltage, speed=np.zeros(samples), load=load + 0 * time)


def seen(run: Recording, motor: Motor) -> np.ndarray:
    """The package's free run from rest, (samples, 2)."""
    tape = Tape.from_recordings([run], straight=True)
    outputs = free_run(motor, tape, FROM_REST)
    return np.stack([tape.samples_of(0, outputs[:, c], len(run)) for c in range(2)], 1)


def motor_with(*effects) -> Motor:
    return Motor(**{n: np.asarray(x) for n, x in SMALL.items()}, effects=effects)


def largest_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float((np.abs(found - expected).max(0) / np.abs(expected).max(0)).max())


def by_scipy(run: Recording, straight: bool = True) -> np.ndarray:
    """Current, speed and angle of the linear motor: `lsim` goes straight between the samples, `dlsim` holds them."""
    m = SMALL
    A = np.array(
        [
            [-m["R"] / m["L"], -m["Kb"] / m["L"], 0],
            [m["Kt"] / m["J"], -m["f"] / m["J"], 0],
            [0, 1, 0],
        ]
    )
    B = np.array([[1 / m["L"], 0], [0, -1 / m["J"]], [0, 0]])
    system, inputs = (A, B, np.eye(3), np.zeros((3, 2))), np.stack([run.voltage, run.load], 1)
    if straight:
        return signal.lsim(system, inputs, run.time)[1]
    return signal.dlsim(signal.cont2discrete(system, STEP), inputs)[1]


def test_the_linear_motor_is_exact(x64):
    run = driven(1, 500, load=0.02)
    assert largest_error(seen(run, motor_with()), by_scipy(run)[:, :2]) < 1e-10


def heated(i, w, v, rise):
    R = SMALL["R"] * (1 + rise)
    return [
        (v - R * i - SMALL["Kb"] * w) / SMALL["L"],
        (SMALL["Kt"] * i - SMALL["f"] * w) / SMALL["J"],
        (0.02 * R * i**2 - rise) / 0.5,
    ]


def dead(i, w, v, _):
    return [*heated(i, w, v - np.clip(v, -2.0, 2.0), 0.0)[:2], 0.0]


def rubbed(i, w, v, _):
    # smooth within 1e-4 rad/s of rest, which is passed in an instant
    torque = 0.02 * np.tanh(w / 1e-4)
    di, dw, _ = heated(i, w, v, 0.0)
    return [di, dw - torque / SMALL["J"], 0.0]


# by how much each may be off: a step of ETDRK4; where a line crosses the edge of the dead zone within
# a sample, or rest
WITH = {
    "resistance_heating": ({"rise_per_W": 0.02, "time_constant_s": 0.5}, heated, 1e-4),
    "input_dead_zone": ({"width_V": 2.0}, dead, 0.03),
    "coulomb_friction": ({"torque_Nm": 0.02}, rubbed, 0.005),
}


@pytest.mark.parametrize("name", WITH)
def test_effects_follow_an_independent_integrator(x64, name):
    values, rates, tolerance = WITH[name]
    run = driven(2, 300)

    def slope(t, x):
        return rates(x[0], x[1], np.interp(t, run.time, run.voltage), x[2])

    settings = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-11, "max_step": STEP / 2}
    exact = solve_ivp(slope, run.time[[0, -1]], [0, 0, 0], t_eval=run.time, **settings).y[:2].T
    effect = EFFECTS[name](**{k: np.asarray(x) for k, x in values.items()})
    assert largest_error(seen(run, motor_with(effect)), exact) < tolerance


@pytest.mark.parametrize("names", [("coulomb_friction",), ("speed_sensor_delay",)])
def test_sensitivities_are_central_differences(x64, names):
    bounds = {n: (x / 2, x * 2) for n, x in SMALL.items()}
    parameters = Parameters.of(bounds, [EFFECTS[name] for name in names])
    at = np.log([*SMALL.values(), *[{"coulomb_friction": 0.02}.get(n, 0.003) for n in names]])
    tape = Tape.from_recordings([driven(3, 300)], straight=True)
    found, jacobian = sensitivities(parameters, jnp.asarray(at), tape, FROM_REST)

    def run(at):
        return np.asarray(free_run(parameters(jnp.asarray(at)), tape, FROM_REST))

    np.testing.assert_allclose(found, run(at), rtol=1e-9, atol=1e-9)
    assert jacobian.shape[-1] == len(at) + UNKNOWNS_PER_RUN
    for column, step in enumerate(1e-5 * np.eye(len(at))):
        expected = (run(at + step) - run(at - step)) / 2e-5
        error = np.linalg.norm(jacobian[..., column] - expected) / np.linalg.norm(expected)
        assert error < 1e-4, (parameters.names[column], error)


# how runs are driven and logged, and what is said of it
LOGS = {
    "held": None,
    "straight": "is linear between samples",
    "recorded late": "recorded one sample late",
    "acts late": "acts one sample later",
    "straight, counted": "is linear between samples",
}
LINES = 2048


def logged(how: str) -> list[Recording]:
    """Three runs with noise, one of them under a load that comes and goes."""
    rng, runs = np.random.default_rng(11), []
    for seed, load in ((21, 0.0), (22, 0.05), (23, 0.0)):
        run = driven(seed, 2501)
        run = attrs.evolve(run, load=load * (np.sin(8 * run.time) > 0))
        outputs = by_scipy(run, "straight" in how)[:, :2]
        outputs += np.array([0.02, 0.2]) * rng.standard_normal(outputs.shape)
        v, measured = run.voltage[:-1], outputs[:-1]
        load = run.load[:-1]
        if how == "recorded late":  # with what came of it, and so is the load
            measured = outputs[1:]
        if "counted" in how:  # of an encoder, over the last sample
            angle = np.round(by_scipy(run)[:, 2] * LINES / (2 * np.pi)) * 2 * np.pi / LINES
            measured[:, 1] = np.diff(angle, prepend=angle[0])[:-1] / STEP
        if how == "acts late":
            v, measured, load = run.voltage[1:], outputs[:-1], run.load[:-1]
        runs.append(Recording(run.name, run.time[:-1], v, *measured.T, load=load))
    return runs


@pytest.mark.parametrize(
    "how", [pytest.param(k, marks=pytest.mark.slow) if "counted" in k else k for k in LOGS]
)
def test_a_voltage_acts_when_it_did(how):
    """Held from their rows on, these voltages would make L wrong by up to 60 % and R by 5 %."""
    found = identify(logged(how))
    said = [message for message in found.messages if message.startswith("the voltage")]
    assert len(said) == (LOGS[how] is not None)
    assert all(LOGS[how] in message for message in said)
    for name in PARAMETERS:
        estimate = found.parameters[name]
        assert abs(estimate.value - SMALL[name]) < 3 * estimate.stderr, name
        assert estimate.stderr < 0.02 * SMALL[name], name
