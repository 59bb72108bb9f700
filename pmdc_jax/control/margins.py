"""Stability margins and noise amplification of a sampled loop, by exact analysis of its linear range."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from attrs import frozen
from jaxtyping import Array, Complex, Float

from ..effects import ShaftCompliance
from ..effects.base import State
from ..motor import Drive, Motor
from ..simulate.propagator import make_propagator, state_of
from .law import Law, LawState

# Angles, in rad per sample, at which a tuning evaluates the sensitivity, few for speed, and at which margins are found
SENSITIVITY_ANGLES = np.geomspace(1e-3, np.pi, 48)
MARGIN_ANGLES = np.geomspace(1e-5, np.pi, 20_000)
UNSTABLE_FROM = 1 - 1e-12  # largest modulus of an eigenvalue: 1, but for rounding
TINY = 1e-300  # against division by zero
# Squarings after which the growth of a loop is known to 1 %, and how its excess over that counts while tuning
SQUARINGS, LEAST_GROWTH, INSTABILITY_FACTOR = 12, 1.01, 100.0

Matrix = Float[Array | np.ndarray, "n n"]
Vector = Float[Array | np.ndarray, " n"]


class Loop(NamedTuple):
    """The loop, opened at the motor's terminals, over one sample: z[k+1] = A z + B v + N n. The law would apply the
    voltage C z + D n; n is an error of the measured speed Y z.

    All for a sensor without delay. Behind one, the law sees that speed `late` samples later, interpolated linearly:
    like an error, with N and D, of the difference.
    """

    A: Matrix
    B: Vector
    C: Vector
    N: Vector
    D: Float[Array | np.ndarray, ""]
    Y: Vector
    late: Float[Array | np.ndarray, ""] | None

    @property
    def closed(self) -> Matrix:
        """State matrix of the closed loop."""
        return self.A + self.B[:, None] * self.C


def linear_loop(motor: Motor, law: Law) -> Loop:
    """The loop linearised at rest, with the motor's linear part, a compliant shaft and its sensors. The law itself is
    linear until its limits bind, so its derivatives describe it exactly."""
    step = jnp.asarray(law.hardware.sample_time, float)
    motor = motor.with_effects(e for e in motor.effects if e.equation == "sensor" or isinstance(e, ShaftCompliance))
    transition, drive, *_ = make_propagator(motor, step, Drive())
    motor_size, delay = len(transition), motor.speed_delay()
    at_rest = State(jnp.zeros(()), jnp.zeros(()), {})
    law_state = law.start(0.0, at_rest, jnp.zeros(()))
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, law_state))

    def sample(inputs: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        x, (*law_leaves, voltage, error) = inputs[:motor_size], inputs[motor_size:]
        state: LawState = jax.tree.unflatten(tree, law_leaves)
        current, speed = motor.sensors(state_of(motor, tuple(x), {}))
        next_state, decided = law.step(state, 0.0, speed + error, current)
        acting = state.voltage if law.hardware.delay else decided
        motion = transition @ x + drive[:, 0] * voltage
        return jnp.stack([*motion, *jax.tree.leaves(next_state), acting, speed])

    size = motor_size + len(leaves)
    jacobian = jax.jacfwd(sample)(jnp.zeros(size + 2))
    of_state, by_voltage, by_error = jacobian[:, :size], jacobian[:, size], jacobian[:, size + 1]
    return Loop(
        of_state[:size],
        by_voltage[:size],
        of_state[size],
        by_error[:size],
        by_error[size],
        of_state[size + 1],
        None if delay is None else delay / step,
    )


def sensitivity_peak(loop: Loop) -> Float[Array, ""]:
    """Largest |S| = |1 / (1 + loop gain)| over frequency: 1 / distance of the loop gain from -1. Of an unstable loop,
    it is larger by `INSTABILITY_FACTOR` times the growth beyond `LEAST_GROWTH` in a sample.

    S(z) = det(z - A) / det(z - A_closed), as polynomials in z - 1 to avoid cancellation at short sample times. A delay
    of the sensor changes both matrices by a multiple of a matrix of rank 1, and the determinants in proportion.
    """
    eye = jnp.eye(loop.A.shape[0])
    angle = jnp.asarray(SENSITIVITY_ANGLES)
    z_minus_1 = jnp.exp(1j * angle) - 1

    def determinant(matrix: Matrix) -> Complex[Array, " frequencies"]:
        polynomial = _characteristic_polynomial(matrix - eye)
        return jnp.polyval(polynomial.astype(z_minus_1.dtype), z_minus_1)

    def seen_late(matrix: Matrix, by_error: Vector) -> Complex[Array, " frequencies"]:
        in_time = determinant(matrix)
        if loop.late is None:
            return in_time
        unseen = determinant(matrix - by_error[:, None] * loop.Y)
        return unseen + _delay(angle, loop.late) * (in_time - unseen)

    opened = seen_late(loop.A, loop.N)
    closed = seen_late(loop.closed, loop.N + loop.B * loop.D)
    instability = jax.nn.relu(_growth(loop.closed) - LEAST_GROWTH)
    return jnp.max(jnp.abs(opened) / jnp.maximum(jnp.abs(closed), TINY)) * (1 + INSTABILITY_FACTOR * instability)


def _growth(matrix: Matrix) -> Float[Array, ""]:
    """About the largest modulus of an eigenvalue, by repeated squaring; it has a gradient, unlike the eigenvalues of
    some matrices."""
    log_norm, power = jnp.zeros(()), jnp.asarray(matrix)
    for _ in range(SQUARINGS):
        norm = jnp.sqrt(jnp.sum(jnp.square(power)))
        power = power / norm
        power, log_norm = power @ power, 2 * (log_norm + jnp.log(norm))
    return jnp.exp(log_norm / 2**SQUARINGS)


def _delay(
    angle: Float[Array | np.ndarray, " frequencies"], samples: Float[Array | np.ndarray, ""]
) -> Complex[Array, " frequencies"]:
    """Frequency response of a delay of the sensor, linearly interpolated between samples."""
    whole = jnp.floor(samples)
    between = 1 + (samples - whole) * (jnp.exp(-1j * angle) - 1)
    return jnp.exp(-1j * angle * whole) * between


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
    loop = _without_unused_states(jax.tree.map(np.asarray, linear_loop(motor, law)))
    step = float(law.hardware.sample_time)
    delayed = _with_delay_line(loop)
    closed = np.asarray(delayed.closed)
    if np.abs(np.linalg.eigvals(closed)).max() >= UNSTABLE_FROM:
        return Margins(False, None, None, None, None, None, None)
    gain = loop_gain(loop, MARGIN_ANGLES)
    covariance = _stationary_covariance(closed, np.asarray(delayed.N + delayed.B * delayed.D))
    phase, delay = _phase_and_delay_margin(MARGIN_ANGLES, gain, step)
    return Margins(
        stable=True,
        gain_margin=_gain_margin(gain),
        phase_margin_deg=phase,
        delay_margin_s=delay,
        sensitivity_peak=float(np.max(1 / np.abs(1 + gain))),
        voltage_per_noise=float(np.sqrt(delayed.C @ covariance @ delayed.C + delayed.D**2)),
        speed_per_noise=float(np.sqrt(covariance[1, 1])),
    )


def _without_unused_states(loop: Loop) -> Loop:
    """The loop without the law's unused states, such as the filter of a PI controller: no voltage depends on them."""
    # in one sample, and in any number of samples: entry (i, j) is positive if state i depends on state j
    direct = (loop.A != 0).astype(int) + np.outer(loop.B != 0, loop.C != 0) + np.eye(len(loop.A), dtype=int)
    depends = np.linalg.matrix_power(direct, len(direct))
    needed = (depends[:2] > 0).any(axis=0) | ((loop.C != 0) @ depends > 0)
    A, B, C, N, D, Y, late = loop
    return Loop(A[np.ix_(needed, needed)], B[needed], C[needed], N[needed], D, Y[needed], late)


def _with_delay_line(loop: Loop) -> Loop:
    """The loop with the last measured speeds as further states, of which the law sees one, or the mean of two."""
    if loop.late is None:
        return loop
    A, B, C, N, D, Y, _ = loop
    late = float(loop.late)
    whole = int(late)
    # of the measured speeds, the latest first
    weights = np.zeros(whole + 2)
    weights[whole:] = 1 - (late - whole), late - whole
    line, none = np.eye(whole + 1, k=-1), np.zeros(whole + 1)
    latest = np.outer(np.eye(whole + 1)[0], Y)
    unseen = (weights[0] - 1) * Y
    return Loop(
        np.block([[A + np.outer(N, unseen), np.outer(N, weights[1:])], [latest, line]]),
        np.append(B, none),
        np.append(C + D * unseen, D * weights[1:]),
        np.append(N, none),
        D,
        np.append(Y, none),
        None,
    )


def loop_gain(loop: Loop, angle: np.ndarray) -> np.ndarray:
    """-C (e^j angle - A)^-1 B, the loop gain under negative feedback; `angle` in radians per sample."""
    A, B, C, N, D, Y = (np.asarray(x) for x in loop[:6])
    resolvent = np.exp(1j * angle)[:, None, None] * np.eye(len(A)) - A
    if loop.late is not None:
        unseen = (np.asarray(_delay(angle, loop.late)) - 1)[:, None] * Y
        resolvent = resolvent - N[:, None] * unseen[:, None, :]
        C = C + D * unseen
    states = np.linalg.solve(resolvent, np.broadcast_to(B[:, None], (len(angle), len(A), 1)))
    return -np.sum(C * states[:, :, 0], -1)


def _gain_margin(gain: np.ndarray) -> float | None:
    """The smallest factor above 1 that brings the loop gain to -1."""
    x, y = np.real(gain), np.imag(gain)
    k = np.flatnonzero((y[:-1] * y[1:] <= 0) & (x[:-1] < 0))
    share = y[k] / (y[k] - y[k + 1] + TINY)
    # of the real axis, where the gain is at half the sampling frequency, too
    crossing = np.append(x[k] + share * (x[k + 1] - x[k]), x[-1])
    factors = -1 / crossing[(crossing > -1) & (crossing < 0)]
    return float(factors.min()) if factors.size else None


def _phase_and_delay_margin(angle: np.ndarray, gain: np.ndarray, step: float) -> tuple[float | None, float | None]:
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
