"""Stability margins and noise amplification of a sampled loop, by exact analysis of its linear range."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from attrs import frozen
from jaxtyping import Array, Float

from ..effects.base import State
from ..motor import Motor
from .law import Law, LawState, SampledMotor

FREQUENCIES = 48  # at which a tuning evaluates the sensitivity

Matrix = Float[Array | np.ndarray, "n n"]
Vector = Float[Array | np.ndarray, " n"]


class Loop(NamedTuple):
    """The loop, opened at the motor's terminals, over one sample: z[k+1] = A z + B v + N n. The law would apply the
    voltage C z + D n; n is an error of the measured speed."""

    A: Matrix
    B: Vector
    C: Vector
    N: Vector
    D: Float[Array | np.ndarray, ""]

    @property
    def closed(self) -> Matrix:
        """State matrix of the closed loop."""
        return self.A + self.B[:, None] * self.C


def linear_loop(motor: Motor, law: Law) -> Loop:
    """The loop linearised at rest, with the motor's linear part. The law itself is linear until its limits bind, so
    its derivatives describe it exactly."""
    model = SampledMotor.of(motor, law.hardware.sample_time)
    at_rest = State(jnp.zeros(()), jnp.zeros(()), {})
    law_state = law.start(0.0, at_rest, jnp.zeros(()))
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, law_state))

    def sample(inputs: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        current, speed, *law_leaves, voltage, error = inputs
        state: LawState = jax.tree.unflatten(tree, law_leaves)
        next_state, decided = law.step(state, 0.0, speed + error, current)
        acting = state.voltage if law.hardware.delay else decided
        motion = model.next(current, speed, voltage)
        return jnp.stack([*motion, *jax.tree.leaves(next_state), acting])

    size = 2 + len(leaves)
    jacobian = jax.jacfwd(sample)(jnp.zeros(size + 2))
    A, B, N = jacobian[:size, :size], jacobian[:size, size], jacobian[:size, size + 1]
    return Loop(A, B, jacobian[size, :size], N, jacobian[size, size + 1])


def sensitivity_peak(loop: Loop) -> Float[Array, ""]:
    """Largest |S| = |1 / (1 + loop gain)| over frequency: 1 / distance of the loop gain from -1.

    S(z) = det(z - A) / det(z - A_closed), as polynomials in z - 1 to avoid cancellation at short sample times.
    """
    eye = jnp.eye(loop.A.shape[0])
    angle = jnp.asarray(np.geomspace(1e-3, np.pi, FREQUENCIES))
    z_minus_1 = jnp.exp(1j * angle) - 1
    opened, closed = (
        jnp.polyval(_characteristic_polynomial(matrix - eye).astype(z_minus_1.dtype), z_minus_1)
        for matrix in (loop.A, loop.closed)
    )
    return jnp.max(jnp.abs(opened) / jnp.maximum(jnp.abs(closed), 1e-300))


def _characteristic_polynomial(matrix: Matrix) -> Float[Array, " n+1"]:
    """Coefficients of det(x - matrix), highest power first, by the Faddeev-LeVerrier algorithm."""
    size = matrix.shape[0]
    eye = jnp.eye(size)

    def next_coefficient(product: Matrix, k: Float[Array, ""]) -> tuple[Matrix, Float[Array, ""]]:
        product = matrix @ product
        coefficient = -jnp.trace(product) / k
        return product + coefficient * eye, coefficient

    _, coefficients = jax.lax.scan(next_coefficient, eye, jnp.arange(1.0, size + 1))
    return jnp.concatenate([jnp.ones(1), coefficients])


@frozen
class Margins:
    """Margins of a loop; all but `stable` are None where it is unstable. None also means no limit: no higher gain
    makes the loop unstable, or its gain never crosses 1, so that phase and delay margins do not exist."""

    stable: bool
    gain_margin: float | None  # as a factor, > 1
    phase_margin_deg: float | None
    delay_margin_s: float | None
    sensitivity_peak: float | None
    voltage_per_noise: float | None  # rms V per 1 rad/s rms of white speed noise
    speed_per_noise: float | None  # rms rad/s, likewise


def margins(motor: Motor, law: Law) -> Margins:
    """Margins of the loop within its limits, and its amplification of white noise on the measured speed."""
    loop = _without_unused_states(Loop(*map(np.asarray, linear_loop(motor, law))))
    step = float(law.hardware.sample_time)
    closed = np.asarray(loop.closed)
    if np.abs(np.linalg.eigvals(closed)).max() >= 1 - 1e-12:
        return Margins(False, None, None, None, None, None, None)
    angle = np.geomspace(1e-5, np.pi, 20_000)
    gain = loop_gain(loop, angle)
    covariance = _stationary_covariance(closed, np.asarray(loop.N + loop.B * loop.D))
    phase, delay = _phase_and_delay_margin(angle, gain, step)
    return Margins(
        stable=True,
        gain_margin=_gain_margin(gain),
        phase_margin_deg=phase,
        delay_margin_s=delay,
        sensitivity_peak=float(np.max(1 / np.abs(1 + gain))),
        voltage_per_noise=float(np.sqrt(loop.C @ covariance @ loop.C + loop.D**2)),
        speed_per_noise=float(np.sqrt(covariance[1, 1])),
    )


def _without_unused_states(loop: Loop) -> Loop:
    """The loop without the law's unused states, such as the filter of a PI controller: no voltage depends on them."""
    # in one sample, and in any number of samples: entry (i, j) is positive if state i depends on state j
    direct = (
        (loop.A != 0).astype(int)
        + np.outer(loop.B != 0, loop.C != 0)
        + np.eye(len(loop.A), dtype=int)
    )
    depends = np.linalg.matrix_power(direct, len(direct))
    needed = (depends[:2] > 0).any(axis=0) | ((loop.C != 0) @ depends > 0)
    A, B, C, N, D = loop
    return Loop(A[np.ix_(needed, needed)], B[needed], C[needed], N[needed], D)


def loop_gain(loop: Loop, angle: np.ndarray) -> np.ndarray:
    """-C (e^j angle - A)^-1 B, the loop gain under negative feedback; `angle` in radians per sample."""
    A, B, C = (np.asarray(x) for x in loop[:3])
    resolvent = np.exp(1j * angle)[:, None, None] * np.eye(len(A)) - A
    states = np.linalg.solve(resolvent, np.broadcast_to(B[:, None], (len(angle), len(A), 1)))
    return -(C @ states)[:, 0]


def _gain_margin(gain: np.ndarray) -> float | None:
    """The smallest factor above 1 that brings the loop gain to -1."""
    x, y = np.real(gain), np.imag(gain)
    k = np.flatnonzero((y[:-1] * y[1:] <= 0) & (x[:-1] < 0))
    share = y[k] / (y[k] - y[k + 1] + 1e-300)
    # of the real axis, where the gain is at half the sampling frequency, too
    crossing = np.append(x[k] + share * (x[k + 1] - x[k]), x[-1])
    factors = -1 / crossing[(crossing > -1) & (crossing < 0)]
    return float(factors.min()) if factors.size else None


def _phase_and_delay_margin(
    angle: np.ndarray, gain: np.ndarray, step: float
) -> tuple[float | None, float | None]:
    """The smallest phase shift (degrees) and the smallest delay (s) that bring the loop gain to -1."""
    magnitude = np.log(np.abs(gain))
    k = np.flatnonzero(magnitude[:-1] * magnitude[1:] <= 0)
    if not k.size:
        return None, None
    share = magnitude[k] / (magnitude[k] - magnitude[k + 1])
    crossover_angle = angle[k] + share * (angle[k + 1] - angle[k])
    crossover_gain = gain[k] + share * (gain[k + 1] - gain[k])
    lag = np.mod(np.angle(-crossover_gain), 2 * np.pi)  # that brings the gain to -1
    shift = np.minimum(lag, 2 * np.pi - lag)
    return float(np.degrees(shift.min())), float((lag / crossover_angle).min() * step)


def _stationary_covariance(closed: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Covariance of the states under white noise of variance 1."""
    from scipy.linalg import solve_discrete_lyapunov

    return solve_discrete_lyapunov(closed, np.outer(noise, noise))
