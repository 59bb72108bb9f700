"""A fit without dry friction says so where there is some, and only there."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.signal import lsim

from benchmarks import virtual_bench as vb
from pmdc_jax import Motor, identify
from pmdc_jax.identify.friction_test import (
    MissingFriction,
    _load_filter,
    _load_response,
    friction_messages,
)
from pmdc_jax.identify.identification import Identification
from pmdc_jax.recording import Recording
from pmdc_jax.simulate import Tape

PAPER = vb.paper_motor()
SHAKEN = {"torque_Nm": 0.01, "torque_correlation_s": 0.05}


def recorded(coulomb_Nm: float, seed: int, **torque: float) -> list[Recording]:
    motor = replace(PAPER, coulomb_Nm=coulomb_Nm)
    rng = np.random.default_rng(seed)
    noise = vb.Noise(current_A=0.5, speed_rad_s=3.0, **torque)
    runs = {"stairs": vb.staircase(2.0), "loaded": vb.loaded(rng, 2.0, 1e-3, hold=0.125)}
    found = []
    for name, driven in runs.items():
        columns = vb.record(motor, driven, rng, noise)
        signals = (columns[q] for q in ("time_s", "voltage_V", "current_A", "speed_rad_s"))
        found.append(Recording(name, *signals, load=columns["load_torque_Nm"]))
    return found


def said(messages: tuple[str, ...]) -> list[str]:
    return [m for m in messages if "dry friction" in m]


def test_friction_that_hides_in_the_viscous_one_is_told():
    """Hidden in noise so large that nothing else says a word, and f more than half too large."""
    runs = recorded(0.04, seed=31)
    found = identify(runs)
    assert found.parameters["f"].value > 1.5 * PAPER.f
    (message,) = found.messages
    assert "f is biased" in message
    friction = float(message.split("about ")[1].split()[0])
    assert friction == pytest.approx(0.04, rel=0.2)
    assert not said(identify(runs, effects=["coulomb_friction"]).messages)


@pytest.mark.parametrize("torque", [{}, SHAKEN], ids=["white", "coloured"])
@pytest.mark.parametrize("seed", range(3))
def test_none_is_told_where_there_is_none(seed, torque):
    assert not said(identify(recorded(0.0, seed, **torque)).messages)


@pytest.mark.parametrize(
    ("error", "missed", "told"),
    [
        (0.1, {}, ", and without it f is biased by more than its standard error"),
        (1.0, {"current": 4.6}, ": add"),
        (1.0, {}, ""),
    ],
)
def test_friction_is_told_where_a_parameter_makes_up_for_it_or_far_more_than_noise_is_left(
    error, missed, told
):
    """An error of a fit that leaves far more than noise may be as large as what the friction moves."""
    found = Mock(spec=Identification)
    found.covariance, found.covariance_names = np.diag([1.0, error**2]), ("J", "f")
    found.missed = missed
    messages = list(friction_messages(MissingFriction(0.01, 27.0, np.array([0.01, -0.6])), found))
    assert len(messages) == bool(told)
    assert all(f"(27 standard errors){told}" in message for message in messages)


def test_the_response_to_a_load_is_that_of_the_linear_motor(x64):
    """Against scipy, with a load that is held from sample to sample."""
    (run, _) = recorded(0.0, seed=1)
    motor = Motor(*(getattr(PAPER, name) for name in vb.SIX))
    load = np.sign(np.sin(7 * run.time))
    found = _load_response(_load_filter(motor, Tape.from_recordings([run]), 0), load)
    A, B = map(np.asarray, motor.state_space())
    system = (A, B[:, 1:], np.eye(2), np.zeros((2, 1)))
    _, expected, _ = lsim(system, load, run.time, interp=False)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.ptp(expected[:, 1]))
