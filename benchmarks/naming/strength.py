"""Strength of an effect: its response relative to noise, without the part that a refit would absorb.

The response is the difference between the motor with and without the effect, both simulated without
noise. Its projection (least squares) on the sensitivities of the linear motor to its six constants
is subtracted. The rest, over the noise of each channel, is what the residuals of a baseline fit
would contain in addition to the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from benchmarks.naming.plant import Plant, compiled
from benchmarks.virtual_bench import SIX, Excitation

Outputs = NDArray[np.float64]  # current (A) and speed (rad/s), shape (samples, 2)
DETECTABLE = 30.0  # chi-square that a single effect needs: p < 1e-7, to allow for many tests


class Response(NamedTuple):
    """The unexplained response to an effect, relative to noise.

    `peak` is its largest root mean square in any run; `chi_square` the sum of squares over all.
    """

    peak: float
    chi_square: float

    @property
    def residual(self) -> float:
        """Baseline residual over noise in the run where it is largest; 1 is a perfect model."""
        return math.sqrt(1.0 + self.peak**2)

    @property
    def visible(self) -> float:
        """Amplitude as a multiple of the smallest detectable in white noise."""
        return math.sqrt(self.chi_square / DETECTABLE)


@compiled
def _scan(step, force, inputs):
    out = np.zeros((len(inputs), 2))
    i, w = 0.0, 0.0
    for k in range(len(inputs)):
        out[k, 0], out[k, 1] = i, w
        v, load = inputs[k, 0], inputs[k, 1]
        i, w = (
            step[0, 0] * i + step[0, 1] * w + force[0, 0] * v + force[0, 1] * load,
            step[1, 0] * i + step[1, 1] * w + force[1, 0] * v + force[1, 1] * load,
        )
    return out


@lru_cache(maxsize=16)  # the runs of a case have the same sample time
def _exact_step(p: Plant, dt: float) -> NDArray[np.float64]:
    """Current and speed one interval later, from current, speed, voltage, load; shape (2, 4)."""
    system = np.zeros((4, 4))
    system[0] = -p.R / p.L, -p.Kb / p.L, 1.0 / p.L, 0.0
    system[1] = p.Kt / p.J, -p.f / p.J, 0.0, -1.0 / p.J
    return expm(system * dt)[:2]


def linear(plant: Plant, excitation: Excitation) -> Outputs:
    """The motor without any effect, on an even clock, by the exact step; starts at rest."""
    dt = (excitation.time[-1] - excitation.time[0]) / (excitation.time.size - 1)
    step = _exact_step(plant, round(float(dt), 12))
    inputs = np.column_stack([excitation.voltage, excitation.load])
    return _scan(step[:, :2].copy(), step[:, 2:].copy(), inputs)


def sensitivities(plant: Plant, excitation: Excitation) -> NDArray[np.float64]:
    """Derivatives by the logarithms of R, L, Kb, Kt, J, f, shape (samples, 2, 6)."""
    d = 1e-4

    def moved(name: str, by: float) -> Outputs:
        return linear(plant._replace(**{name: getattr(plant, name) * math.exp(by)}), excitation)

    return np.stack([(moved(n, d) - moved(n, -d)) / (2.0 * d) for n in SIX], axis=-1)


class Gauge:
    """Measures responses in one set of runs, given the noise of current and speed."""

    def __init__(self, plant: Plant, runs: Mapping[str, Excitation], noise: tuple[float, float]):
        self.noise = np.asarray(noise)
        blocks = [sensitivities(plant, e) / self.noise[:, None] for e in runs.values()]
        self.lengths = [b.shape[0] for b in blocks]
        self.basis, _ = np.linalg.qr(np.concatenate(blocks).reshape(-1, len(SIX)))

    def __call__(self, differences: list[Outputs]) -> Response:
        """The response, from the differences of the outputs with and without the effect in each run."""
        d = np.concatenate(differences) / self.noise
        flat = d.reshape(-1)
        left = (flat - self.basis @ (self.basis.T @ flat)).reshape(d.shape)
        parts = np.split(left, np.cumsum(self.lengths)[:-1])
        return Response(peak=max(math.sqrt(float(np.mean(p**2))) for p in parts), chi_square=float(np.sum(left**2)))


def amplitude_for(
    wanted: float,
    measure: Callable[[float], float],
    limits: tuple[float, float],
    tolerance: float = 0.2,
    tries: int = 6,
) -> float:
    """The amplitude factor whose measure is `wanted` within the tolerance, or the nearest tried.

    Responses are about proportional to it, so each try is scaled by the ratio that is missing, within
    the bracket found so far; by bisection if that would leave the bracket.
    """
    low, high = math.log(limits[0]), math.log(limits[1])
    x, best, nearest = min(0.0, high), 0.0, math.inf
    for _ in range(tries):
        lacking = math.log(wanted / max(measure(math.exp(x)), 1e-12))
        if abs(lacking) < nearest:
            best, nearest = x, abs(lacking)
        if nearest < tolerance:
            break
        low, high = (x, high) if lacking > 0 else (low, x)
        x += lacking
        if not low < x < high:
            x = high if lacking > 3.0 and high - low < 0.7 else 0.5 * (low + high)
    return math.exp(best)
