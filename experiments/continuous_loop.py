"""The ideal closed loop in continuous time: without sampling or delay, but with the limit of the voltage."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from pmdc_jax.control import Response
from pmdc_jax.control.controllers import AbstractController, Memory
from pmdc_jax.motor import Motor

TOLERANCE = 1e-9  # of the solver: relative, and absolute in A, rad/s and V


@eqx.filter_jit
def continuous_loop(
    motor: Motor,
    controller: AbstractController,
    times: Float[Array, " instants"],
    reference: float,
    voltage_limit: Float[Array, ""] | float,
) -> Response:
    """Simulate a motor under a controller in continuous time, from rest and without load.

    Only for motors with smooth effects; a delay of the speed sensor is ignored.

    **Arguments**: `times`, s, increasing from 0; `reference`, rad/s; `voltage_limit`, V.
    """

    def commanded_and_applied(state, memory):
        current, speed = motor.sensors(state)
        commanded = controller.command(memory, reference, speed, current, 0.0)
        return commanded, jnp.clip(commanded, -voltage_limit, voltage_limit)

    def rate(t, y, args):
        state, memory = y
        commanded, applied = commanded_and_applied(state, memory)
        _, speed = motor.sensors(state)
        memory_rates = controller.rates(memory, reference, speed, applied - commanded, 0.0)
        return motor.derivative(state, applied, jnp.zeros(())), memory_rates

    rest, zero = motor.initial_state(0.0, 0.0), jnp.zeros(())
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Tsit5(),
        t0=times[0],
        t1=times[-1],
        dt0=None,
        y0=(rest, Memory(zero, zero)),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=200_000,
    )
    states, memories = solution.ys
    _, applied = commanded_and_applied(states, memories)
    return Response(times, states.current, states.speed, applied)
