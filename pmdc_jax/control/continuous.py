"""The ideal closed loop in continuous time, without sampling or delay, but with the limits."""

from __future__ import annotations

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import State
from ..motor import Motor
from ..runtime.compiled import compiled
from .controllers import AbstractController, Memory, Number
from .loop import Response
from .steady import steady_state

# The current limit is enforced by a current loop this many times faster than the winding, R / L.
CURRENT_LOOP_GAIN = 50.0


@compiled
def continuous_loop(
    motor: Motor,
    controller: AbstractController,
    times: Float[Array, " instants"],
    reference: Number,
    voltage_limit: Number,
    current_limit: Number | None = None,
    load: Number = 0.0,
    initial: Number = 0.0,
    tolerance: float = 1e-9,
) -> Response:
    """Simulate a motor under a controller in continuous time, from steady state at `initial` without load.

    Solved by Tsit5 with adaptive steps; differentiable in gains, motor and reference. Only for motors with smooth
    effects; a delay of the speed sensor is ignored.

    **Arguments**: `times`, s, increasing from 0; `reference` and `initial`, rad/s; `voltage_limit`, V;
    `current_limit`, A, None for no limit; `load`, N m, from the start; `tolerance`, relative, and absolute in A,
    rad/s and V.
    """

    def voltages(state: State, memory: Memory) -> tuple[Number, Number]:
        """Commanded and applied."""
        current, speed = motor.sensors(state)
        commanded = controller.command(memory, reference, speed, current, 0.0)
        return commanded, _limited(motor, state, commanded, voltage_limit, current_limit)

    def rate(t: Number, y: tuple[State, Memory], args: None) -> tuple[State, Memory]:
        state, memory = y
        commanded, applied = voltages(state, memory)
        _, speed = motor.sensors(state)
        memory_rates = controller.rates(memory, reference, speed, applied - commanded, 0.0)
        motor_rates = motor.derivative(state, jnp.asarray(applied), jnp.asarray(load, float))
        return motor_rates, memory_rates

    state, voltage = steady_state(motor, initial)
    memory = controller.equilibrium(initial, state.speed, state.current, voltage, 0.0)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Tsit5(),
        t0=times[0],
        t1=times[-1],
        dt0=None,
        y0=(state, Memory(*(jnp.asarray(m, float) for m in memory))),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=200_000,
    )
    assert solution.ys is not None
    states, memories = solution.ys
    _, applied = voltages(states, memories)
    return Response(times, states.current, states.speed, jnp.asarray(applied))


def _limited(
    motor: Motor, state: State, voltage: Number, voltage_limit: Number, current_limit: Number | None
) -> Number:
    """The voltage limited by the current loop, then by the voltage limit."""
    if current_limit is not None:
        holding_voltage = motor.R * state.current + motor.Kb * state.speed
        lowest, highest = (
            holding_voltage + CURRENT_LOOP_GAIN * motor.R * (sign * current_limit - state.current) for sign in (-1, 1)
        )
        voltage = jnp.clip(voltage, lowest, highest)
    return jnp.clip(voltage, -voltage_limit, voltage_limit)
