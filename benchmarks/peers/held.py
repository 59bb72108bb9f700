"""A record as the peers take it, and the exact step of the linear motor between samples."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Run(NamedTuple):
    """A uniformly sampled record with known load: SI units, contiguous columns."""

    dt: float
    voltage: NDArray[np.float64]
    load: NDArray[np.float64]
    current: NDArray[np.float64]
    speed: NDArray[np.float64]

    @classmethod
    def of(cls, columns: Mapping[str, NDArray]) -> "Run":
        """From canonical columns; a record without a load column is one without load."""
        time, voltage = columns["time_s"], columns["voltage_V"]
        load = columns.get("load_torque_Nm", np.zeros_like(voltage))
        dt = float((time[-1] - time[0]) / (len(time) - 1))
        signals = (voltage, load, columns["current_A"], columns["speed_rad_s"])
        return cls(dt, *(np.ascontiguousarray(s, float) for s in signals))


def exact_step(parameters: NDArray, dt: float) -> NDArray:
    """The held step x+ = Phi x + Gv v + Gl load, by Sylvester's formula, for any leading shape.

    Returns (..., 2, 4), rows current and speed, columns current, speed, voltage, load. Analytic in
    the parameters: complex ones give derivatives by the complex step.
    """
    R, L, Kb, Kt, J, f = np.moveaxis(np.asarray(parameters), -1, 0)
    a, b, c, d = -R / L, -Kb / L, Kt / J, -f / J
    mean, square = (a + d) / 2, (a - d) ** 2 / 4 + b * c
    oscillates = square.real < 0  # two branches keep real arithmetic real, as the complex step needs
    gap = np.sqrt(np.where(oscillates, -square, square))
    gap = np.where(np.abs(gap * dt) < 1e-7, 1e-7 / dt, gap)
    apart, turn, decay = (np.where(oscillates, 0.0, gap), np.where(oscillates, gap, 0.0), np.exp(mean * dt))
    slow, fast = np.exp((mean + apart) * dt), np.exp((mean - apart) * dt)
    even = np.where(oscillates, decay * np.cos(turn * dt), (slow + fast) / 2)
    odd = np.where(oscillates, decay * np.sin(turn * dt), (slow - fast) / 2) / gap
    phi = [[even + odd * (a - mean), odd * b], [odd * c, even + odd * (d - mean)]]
    # A^-1 (Phi - I) applied to the columns (1/L, 0) of the voltage and (0, -1/J) of the load
    det = a * d - b * c
    p, q, r, s = phi[0][0] - 1, phi[0][1], phi[1][0], phi[1][1] - 1
    gains = [[(d * p - b * r) / det / L, -(d * q - b * s) / det / J]]
    gains += [[(a * r - c * p) / det / L, -(a * s - c * q) / det / J]]
    return np.stack([np.stack([*phi[k], *gains[k]], -1) for k in (0, 1)], -2)
