"""Simulation of motors on recorded inputs."""

from __future__ import annotations

import attrs
import jax
import jax.numpy as jnp
import numpy as np

from ..motor import Motor
from ..precision import double_precision
from ..recording import Recording, Run, recordings_of
from .population import squared_errors
from .reference import reference_solution
from .shooting import LOCAL, free_run, sensitivities
from .tape import Tape
from .uniform import uniform

__all__ = [
    "LOCAL",
    "Tape",
    "free_run",
    "reference_solution",
    "sensitivities",
    "simulate",
    "squared_errors",
    "uniform",
]


@double_precision
def simulate(motor: Motor, recording: Run) -> Recording:
    """Simulate a motor on what drives a recording, from the recorded start.

    **Arguments**: `motor`, of scalars; `recording` or its file, whose voltage (or current, or torque), load and time
    stamps are used; its first current and speed, where recorded, are the initial state, otherwise the motor
    starts at rest. An unknown load is taken as zero, and a rotor that stood still throughout as held.

    **Returns**: the recording with current (A) and speed (rad/s) simulated at the same time stamps. A run that
    is not driven by voltage has no simulated current.
    """
    motor = jax.tree.map(jnp.asarray, motor)
    (recording,) = recordings_of(recording)
    even = uniform(recording)
    tape = Tape.from_recordings([even], unloaded=True)
    outputs = free_run(motor, tape, jnp.asarray(tape.initial), jnp.zeros(1))
    current, speed = (
        np.interp(recording.time, even.time, tape.samples_of(0, outputs[:, c], len(even.time)))
        for c in range(2)
    )
    driven = recording.voltage is not None and recording.torque is None
    return attrs.evolve(
        recording, current=current if driven else recording.current, speed=speed, angle=None
    )
