"""The motor of the wheelchair paper, and the exact step of linear motors by scipy."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import expm

from benchmarks import virtual_bench as vb

PAPER = {name: getattr(vb.paper_motor(), name) for name in vb.SIX}


def state_space(motor: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the linear motor: states current and speed, inputs voltage and load."""
    R, L, Kb, Kt, J, f = (motor[name] for name in vb.SIX)
    A = np.array([[-R / L, -Kb / L], [Kt / J, -f / J]])
    return A, np.array([[1 / L, 0.0], [0.0, -1 / J]])


def exact_step(motor: Mapping[str, float], step: float) -> tuple[np.ndarray, np.ndarray]:
    """A and B over one sample with held inputs, by the matrix exponential."""
    A, B = state_space(motor)
    both = expm(np.block([[A, B], [np.zeros((2, 4))]]) * step)
    return both[:2, :2], both[:2, 2:]
