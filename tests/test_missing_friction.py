"""The test for dry friction in a fit without it: reported if the motor has some, and only then."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.signal import lsim

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import Motor, identify
from pmdc_jax.identify.identification import Identification
from pmdc_jax.identify.load_response import load_filter, load_response
from pmdc_jax.identify.missing_friction import MissingFriction, friction_messages
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.simulate import Tape

PAPER = vb.paper_motor()
TORQUE_NOISE = {"torque_Nm": 0.01, "torque_correlation_s": 0.05}


def recorded(coulomb_Nm: float, seed: int, **torque_noise: float) -> list[Recording]:
    motor = replace(PAPER, coulomb_Nm=coulomb_Nm)
    rng = np.random.default_rng(seed)
    noise = vb.Noise(current_A=0.5, speed_rad_s=3.0, **torque_noise)
    runs = {"stairs": vb.staircase(2.0), "loaded": vb.loaded(rng, 2.0, 1e-3, hold=0.125)}
    found = []
    for name, driven in runs.items():
        columns = vb.record(motor, driven, rng, noise)
        found.append(recording(name, columns))
    return found


def friction_messages_of(messages: tuple[str, ...]) -> list[str]:
    return [m for m in messages if "dry friction" in m]


@pytest.mark.slow
def test_dry_friction_that_biases_viscous_friction_is_reported():
    """In noise so large that there is no other message, and with f too large by more than half."""
    runs = recorded(0.04, seed=31)
    found = identify(runs)
    assert found.parameters["f"].value > 1.5 * PAPER.f
    (message,) = found.messages
    assert "f is biased" in message
    friction = float(message.split("about ")[1].split()[0])
    assert friction == pytest.approx(0.04, rel=0.2)
    assert not friction_messages_of(identify(runs, effects=["coulomb_friction"]).messages)


@pytest.mark.parametrize("torque_noise", [{}, TORQUE_NOISE], ids=["white", "coloured"])
@pytest.mark.parametrize("seed", range(3))
def test_no_message_without_dry_friction(seed, torque_noise):
    assert not friction_messages_of(identify(recorded(0.0, seed, **torque_noise)).messages)


@pytest.mark.parametrize(
    ("error", "residual_over_noise", "expected_text"),
    [
        (0.1, {}, ", and without it f is biased by more than its standard error"),
        (1.0, {"current": 4.6}, ": add"),
        (1.0, {}, ""),
    ],
)
def test_dry_friction_is_reported_if_it_biases_a_parameter_or_the_residual_exceeds_noise(
    error, residual_over_noise, expected_text
):
    """If residuals exceed the noise by far, so do standard errors, and a bias below them is reported all the same."""
    found = Mock(spec=Identification)
    found.covariance, found.covariance_names = np.diag([1.0, error**2]), ("J", "f")
    found.missed = residual_over_noise
    messages = list(friction_messages(MissingFriction(0.01, 27.0, np.array([0.01, -0.6])), found))
    assert len(messages) == bool(expected_text)
    assert all(f"(27 standard errors){expected_text}" in message for message in messages)


def test_the_response_to_a_load_matches_scipy(x64):
    """With a load that is held from sample to sample."""
    (run, _) = recorded(0.0, seed=1)
    motor = Motor(*(getattr(PAPER, name) for name in vb.SIX))
    load = np.sign(np.sin(7 * run.time))
    found = load_response(load_filter(motor, Tape.from_recordings([run]), 0), load)
    A, B = map(np.asarray, motor.state_space())
    system = (A, B[:, 1:], np.eye(2), np.zeros((2, 1)))
    _, expected, _ = lsim(system, load, run.time, interp=False)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.ptp(expected[:, 1]))
