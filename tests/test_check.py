"""The check is silent on good data and finds each injected fault."""

from __future__ import annotations

import time

import numpy as np
import pytest
from attrs import evolve
from scipy.linalg import expm

from pmdc_jax.check import check
from pmdc_jax.recording import Recording

EXCITATIONS = ("steps", "prbs", "staircase", "triangle", "load_cycles", "spin_up")


def simulate(motor, dt, voltage, load, coulomb=0.0):
    """Current and speed of a motor by the exact step between samples, from rest."""
    R, L, Kb, Kt, J, f = motor
    A = np.array([[-R / L, -Kb / L], [Kt / J, -f / J]])
    B = np.array([[1 / L, 0.0], [0.0, -1 / J]])
    step = expm(np.block([[A, B], [np.zeros((2, 4))]]) * dt)
    state, states = np.zeros(2), []
    for v, torque in zip(voltage, load, strict=True):
        states.append(state)
        state = step[:2, :2] @ state + step[:2, 2:] @ [v, torque]
        slowed = abs(state[1]) - dt * coulomb / J
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


def good_run(seed, kind=None, samples=3000, noise=None, coulomb=None):
    """A recording of a random motor with plausible noise, and sometimes with rounded speed."""
    rng = np.random.default_rng(seed)
    kind = kind or EXCITATIONS[seed % len(EXCITATIONS)]
    R, Kb = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-2, np.log10(0.5))
    mechanical = 10 ** rng.uniform(-1.7, -0.3)
    J = mechanical * Kb**2 / R
    motor = (R, R * mechanical * 10 ** rng.uniform(-2.5, -0.8), Kb, Kb, J, 0.03 * Kb**2 / R)
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


def told(recordings, severity=("warning", "error")):
    return [finding for finding in check(recordings) if finding.severity in severity]
