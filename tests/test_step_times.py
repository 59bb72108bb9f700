"""Voltage steps between two samples, simulated in closed form at their exact times."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from pmdc_jax import Identification, diagnose, identify
from pmdc_jax.recording import Recording

TRUE = {"R": 1.2, "L": 1.8e-3, "Kb": 0.05, "Kt": 0.05, "J": 6e-5, "f": 4e-5}
STEP, SAMPLES, CHANGES = 1e-3, 2000, 11
NOISE = np.array([0.05, 0.5])


def run_with_steps(seed: int, *, synchronous: bool, load: float = 0.0) -> Recording:
    """A run from rest with 11 voltage steps, at samples if `synchronous` and at any time otherwise."""
    rng, time = np.random.default_rng(seed), STEP * np.arange(SAMPLES)
    changes = np.sort(rng.uniform(0, time[-1], CHANGES))
    if synchronous:
        changes = STEP * np.ceil(changes / STEP)
    levels = 20 * rng.uniform(-1, 1, CHANGES + 1)
    m = TRUE
    rates = np.zeros((4, 4))
    rates[0] = -m["R"] / m["L"], -m["Kb"] / m["L"], 1 / m["L"], 0
    rates[1] = m["Kt"] / m["J"], -m["f"] / m["J"], 0, -1 / m["J"]
    state, seen = np.zeros(2), np.zeros((SAMPLES, 2))
    now = np.searchsorted(changes, time + 1e-9, side="right")
    for k in range(SAMPLES):
        seen[k] = state
        ends = [time[k], *changes[(changes > time[k] + 1e-9) & (changes < time[k] + STEP - 1e-9)]]
        for level, length in enumerate(np.diff([*ends, time[k] + STEP]), start=now[k]):
            state = (expm(rates * length) @ [*state, levels[level], load])[:2]
    seen += NOISE * rng.standard_normal(seen.shape)
    return Recording(f"run{seed}", time, levels[now], *seen.T, load=load + 0 * time)


def runs(*, synchronous: bool) -> list[Recording]:
    return [
        run_with_steps(seed, synchronous=synchronous, load=load)
        for seed, load in ((1, 0.0), (2, 0.15))
    ]


def error_of(found: Identification, name: str) -> float:
    return abs(found.parameters[name].value - TRUE[name])


@pytest.mark.parametrize("synchronous", [pytest.param(False, marks=pytest.mark.slow), True])
def test_step_times_are_estimated(synchronous):
    """A voltage held from its sample on is up to a sample late: the standard error of L is then 4.7 %, not 0.3 %."""
    found = identify(runs(synchronous=synchronous))
    for name, right in TRUE.items():
        estimate = found.parameters[name]
        assert error_of(found, name) < 3 * estimate.stderr
        assert estimate.stderr < 0.01 * right
    reported = any("steps between samples" in message for message in found.messages)
    assert reported != synchronous


@pytest.mark.slow
def test_steps_between_samples_are_not_diagnosed_as_a_missing_effect():
    assert diagnose(runs(synchronous=False)).verdict == "none_detected"
