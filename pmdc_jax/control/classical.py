"""Textbook design rules: Ziegler-Nichols, and pole placement by Ackermann's formula."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..motor import Motor
from ..runtime.precision import double_precision
from .controllers import CONTROLLERS, PI, PID, AbstractController, StateFeedback, StateFeedbackIntegral
from .gains import reference_gain
from .hardware import Hardware
from .law import Law, SampledMotor
from .margins import linear_loop, loop_gain
from .metrics import BAND
from .objective import Task

ZIEGLER_NICHOLS_CONTROLLERS = ("pi", "pid")  # controllers with a Ziegler-Nichols rule
MAX_TEXTBOOK_OVERSHOOT = 50.0  # %, of the poles: nearer to 100 % they hardly decay

Poles = Sequence[complex | float] | np.ndarray


def textbook_controller(motor: Motor, task: Task, kind: str) -> tuple[str, AbstractController]:
    """The rule for a kind of controller, and the controller that it gives: Ziegler-Nichols for PI and PID, Ackermann's
    formula for state feedback, with the poles of the fastest loop that the limits allow.

    **Arguments**: `motor`; `task`, the loop with its limits; `kind`, a key of `CONTROLLERS`.
    """
    if kind in ZIEGLER_NICHOLS_CONTROLLERS:
        return "Ziegler-Nichols", ziegler_nichols(motor, task.hardware, kind)
    overshoot = min(float(task.max_overshoot), MAX_TEXTBOOK_OVERSHOOT)
    poles = standard_poles(float(task.settling_scale), overshoot, CONTROLLERS[kind].integrates)
    return "Ackermann", state_feedback(motor, poles, float(task.setpoint), float(task.hardware.sample_time))


@double_precision
def ultimate_gain(motor: Motor, hardware: Hardware | None) -> tuple[float, float]:
    """Ultimate gain (V s/rad) and period (s): those of the sustained oscillation under proportional control.

    **Arguments**: `hardware`, whose sampling and delay make the oscillation possible; None means the ideal loop.

    **Raises**: `InputError` for the ideal loop: the phase of a two-pole motor reaches -180 degrees only at infinite
    frequency, so no gain makes it oscillate.
    """
    if hardware is None:
        raise InputError(
            "Ziegler-Nichols",
            "the ideal motor has two poles, so its phase never reaches -180 degrees and no gain makes"
            " the loop oscillate",
            "Give the sample time and the delay of the real loop",
        )
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    law = Law.of(PI(1.0, 0.0, 1.0, 1.0), hardware, motor)
    loop = linear_loop(motor, law)
    angle = np.geomspace(1e-5, np.pi, 200_000)
    gain = loop_gain(loop, angle)
    phase = np.unwrap(np.angle(gain))
    # without delay the phase may reach -180 degrees only at the Nyquist frequency, the last angle
    k = min(int(np.argmax(phase <= -np.pi)) or len(angle) - 1, len(angle) - 1)
    period = 2 * np.pi / angle[k] * float(hardware.sample_time)
    return float(1 / np.abs(gain[k])), period


def ziegler_nichols(motor: Motor, hardware: Hardware | None, kind: str) -> PI | PID:
    """PI or PID gains by the sustained-oscillation rule, for the sampled loop.

    PI: Kp = 0.45 Ku, Ti = Tu / 1.2. PID: Kp = 0.6 Ku, Ti = Tu / 2, Td = Tu / 8, filter Td / 10. The tracking
    time of the anti-windup is Ti.

    **Raises**: `InputError` for the ideal loop, which never oscillates, and for state feedback, which has no rule.

    **Source**: Ziegler, Nichols, Transactions of the ASME 64 (1942).
    """
    if kind not in ZIEGLER_NICHOLS_CONTROLLERS:
        raise InputError("Ziegler-Nichols", f"there is no rule for {kind}", "Choose pi or pid")
    gain, period = ultimate_gain(motor, hardware)
    if kind == "pi":
        integral_time = period / 1.2
        return PI(
            proportional=0.45 * gain,
            integral=0.45 * gain / integral_time,
            setpoint_weight=1.0,
            tracking_time=integral_time,
        )
    integral_time, derivative_time = period / 2, period / 8
    return PID(
        proportional=0.6 * gain,
        integral=0.6 * gain / integral_time,
        derivative=0.6 * gain * derivative_time,
        filter_time=derivative_time / 10,
        setpoint_weight=1.0,
        tracking_time=integral_time,
    )


def standard_poles(settling: float, overshoot: float, with_integral: bool = False) -> np.ndarray:
    """The poles, rad/s, of a second-order system with this settling time and overshoot; and a real one as far from the
    imaginary axis for integral action.

    overshoot = exp(-pi zeta / sqrt(1 - zeta^2)),  settling = -ln(band sqrt(1 - zeta^2)) / (zeta omega)

    **Arguments**: `settling`, s, to within the 2 % band; `overshoot`, %, between 0 and 100.

    **Source**: Franklin, Powell, Emami-Naeini, "Feedback Control of Dynamic Systems" (2015), section 3.4.
    """
    log_overshoot = np.log(overshoot / 100)
    damping = -log_overshoot / np.hypot(np.pi, log_overshoot)
    decay = -np.log(BAND * np.sqrt(1 - damping**2)) / settling
    frequency = decay * np.sqrt(1 - damping**2) / damping
    pair = [complex(-decay, frequency), complex(-decay, -frequency)]
    return np.array([*pair, -decay] if with_integral else pair)


def ackermann(A: np.ndarray, B: np.ndarray, poles: Poles) -> np.ndarray:
    """Gain K that gives A - B K the eigenvalues `poles`: K = (0 ... 0 1) [B AB ...]^-1 p(A).

    **Arguments**: `A` (n, n); `B` (n,); `poles`, n of them, complex ones in conjugate pairs.

    **Source**: Ackermann, at - Automatisierungstechnik 20 (1972).
    """
    size = len(A)
    controllability = np.stack([np.linalg.matrix_power(A, k) @ B for k in range(size)], axis=1)
    polynomial_of_A = np.zeros_like(A)  # by Horner's scheme
    for coefficient in np.poly(np.asarray(poles)):
        polynomial_of_A = polynomial_of_A @ A + np.real(coefficient) * np.eye(size)
    return np.linalg.solve(controllability.T, np.eye(size)[-1]) @ polynomial_of_A


@double_precision
def state_feedback(
    motor: Motor, poles: Poles, setpoint: float, sample_time: float | None = None
) -> StateFeedback | StateFeedbackIntegral:
    """State feedback by pole placement; a third pole adds integral action.

    **Arguments**: `poles`, rad/s, two or three, complex ones in conjugate pairs; `setpoint`, rad/s, held exactly
    without load; `sample_time`, s, with which the sampled loop has the poles exp(pole sample_time), None for
    continuous time.
    """
    motor = jax.tree.map(lambda x: jnp.asarray(x, float), motor)
    loop_poles = np.asarray(poles)
    if sample_time is not None:
        loop_poles = np.exp(loop_poles * sample_time)
    A, B = _state_space(motor, sample_time)
    if len(loop_poles) == 3:
        A, B = _with_error_integral(A, B, sample_time)
    K = ackermann(A, B, loop_poles)
    gains = {
        "reference_gain": float(reference_gain(motor, setpoint, K[0], K[1])),
        "current_gain": float(K[0]),
        "speed_gain": float(K[1]),
    }
    if len(loop_poles) == 2:
        return StateFeedback(**gains)
    slowest_time_constant = float(1 / np.min(np.abs(np.real(np.asarray(poles)))))
    return StateFeedbackIntegral(**gains, integral=float(-K[2]), tracking_time=slowest_time_constant)


def _state_space(motor: Motor, sample_time: float | None) -> tuple[np.ndarray, np.ndarray]:
    """A (2, 2) and B (2,) of the states current and speed for the input voltage; continuous, or sampled."""
    if sample_time is None:
        A, B = (np.asarray(matrix) for matrix in motor.state_space())
        return A, B[:, 0]
    model = SampledMotor.of(motor, sample_time)
    A = np.array([[model.ii, model.iw], [model.wi, model.ww]], float)
    return A, np.array([model.iv, model.wv], float)


def _with_error_integral(A: np.ndarray, B: np.ndarray, sample_time: float | None) -> tuple[np.ndarray, np.ndarray]:
    """A and B with a third state, the integral of set point minus speed."""
    # row of d(integral)/dt = -w, or of integral[k+1] = integral[k] - step w[k]
    row = [0.0, -1.0, 0.0] if sample_time is None else [0.0, -sample_time, 1.0]
    A = np.block([[A, np.zeros((2, 1))], [np.array([row])]])
    return A, np.append(B, 0.0)
