"""From a motor and a recording to the recording as simulated."""

from __future__ import annotations

from pathlib import Path

import attrs
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..motor import Motor
from ..motor_file import load_motor
from ..recordings.recording import Recording
from ..recordings.recording_file import Run, recordings_of
from ..runtime.precision import double_precision
from .even_clock import on_even_clock
from .shooting import free_run
from .tape import Tape
from .uneven import simulated_at_stamps


@double_precision
def simulate(motor: Motor | str | Path, recording: Run) -> Recording:
    """Simulate a motor with the inputs of a recording, from its recorded initial state.

    **Arguments**: `motor`, of scalars, or its file; `recording` or its file, whose voltage (or current, or torque),
    load and time stamps are used; its first current and speed, where recorded, are the initial state, otherwise the
    motor starts at rest. An unknown load is taken as zero, and a rotor that stood still throughout as held.

    **Returns**: the recording with current (A) and speed (rad/s) simulated at the same time stamps. A run that
    is not driven by voltage has no simulated current.

    **Raises**: `InputError` if the simulation diverges.
    """
    (recording,) = recordings_of(recording, to_simulate=True)
    if not isinstance(motor, Motor):
        motor = load_motor(motor, "held" if recording.stands_still else recording.drive)
    subject: Motor = jax.tree.map(jnp.asarray, motor)
    # the instantaneous speed is simulated, even if the recorded one is a mean
    even = attrs.evolve(on_even_clock(recording), averaging=None)
    tape = Tape.from_recordings([even], unloaded=True)
    simulated = tape.samples_of(0, free_run(subject, tape), len(even))
    if not even.has_even_clock:
        simulated = simulated_at_stamps(subject, tape.drive_of(0), even, simulated)
    finite = np.isfinite(simulated).all(1)
    if not finite.all():
        raise InputError(
            "motor",
            f"its simulation of {recording.name} diverges at {recording.time[finite.argmin()]:.6g} s",
            "Check the parameters of the motor and its effects",
        )
    current = simulated[:, 0] if recording.drive == "voltage" else recording.current
    return attrs.evolve(recording, current=current, speed=simulated[:, 1], angle=None)
