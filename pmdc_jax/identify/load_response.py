"""The response of the linear motor to a load, sample by sample."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.signal import cont2discrete, lfilter, ss2tf

from ..motor import Motor
from ..simulate import Tape

# Numerators for current and speed, and the common denominator
LoadFilter = tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "3"]]


def load_filter(motor: Motor, tape: Tape, run: int) -> LoadFilter:
    """Discrete transfer functions of the linear motor, from a load held between samples to current and speed."""
    A, B = map(np.asarray, motor.state_space(tape.drive_of(run)))
    continuous = (A, B[:, 1:], np.eye(2), np.zeros((2, 1)))
    discrete: Any = cont2discrete(continuous, tape.sample_time_of(run), method="zoh")
    numerators, denominator = ss2tf(*discrete[:4])
    return numerators, np.asarray(denominator)


def load_response(
    of_load: LoadFilter, load: Float[np.ndarray, "samples *columns"]
) -> Float[np.ndarray, "samples 2 *columns"]:
    """Current, A, and speed, rad/s, that loads in N m make, from rest."""
    numerators, denominator = of_load
    return np.stack([lfilter(numerator, denominator, load, axis=0) for numerator in numerators], 1)
