"""The sampled closed loop: one exact step of the motor per sample, or several to resolve the time between samples."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from ..runtime.compiled import compiled
from ..simulate.propagator import make_propagator
from ..simulate.solver import Input, held_step
from .controllers import Number
from .law import Law, LawState
from .steady import steady_state

REMEMBERED_SAMPLES = 32  # of the speed, for a sensor with delay

# Current, speed and voltage at one instant, or at all instants of a sample
Instants = tuple[Scalars, Scalars, Scalars]


class LoopState(NamedTuple):
    """States of motor and law, voltage computed at the previous sample (V), and past speeds (rad/s), latest first."""

    motor: State
    law: LawState
    voltage: Number
    past_speeds: Float[Array, " remembered"]


class Course(NamedTuple):
    """Inputs of the loop, held from sample to sample.

    `reference`, rad/s; `load`, N m, opposes positive motion; `speed_noise`, rad/s, added to the measured speed;
    `initial`, rad/s, the steady speed at the start, without load.
    """

    reference: Float[Array, " samples"]
    load: Float[Array, " samples"]
    speed_noise: Float[Array, " samples"]
    initial: Number = 0.0


class Response(NamedTuple):
    """A simulated response: time (s), current (A) and speed (rad/s) at each instant, voltage (V) held from then on."""

    time: Float[Array | np.ndarray, " instants"]
    current: Float[Array | np.ndarray, " instants"]
    speed: Float[Array | np.ndarray, " instants"]
    voltage: Float[Array | np.ndarray, " instants"]


def closed_loop(motor: Motor, law: Law, course: Course, substeps: int = 1) -> Response:
    """Simulate a motor under a sampled law.

    **Arguments**: `motor`, with scalar fields, simulated with its effects; `law`; `course`, one value per sample;
    `substeps`, instants per sample in the response, at each of which the speed is exact.

    **Returns**: `Response` with samples x substeps instants. Differentiable in gains, motor and course, and works under
    `jax.vmap` over any of them.
    """
    drive, hardware = Drive(), law.hardware
    step_matrices = make_propagator(motor, jnp.asarray(hardware.sample_time / substeps), drive)
    sensor_delay = motor.speed_delay()
    state, voltage = steady_state(motor, course.initial)
    law_state = law.start(course.initial, state, voltage)
    past_speeds = jnp.full(REMEMBERED_SAMPLES, motor.sensors(state)[1])
    start = LoopState(state, law_state, voltage, past_speeds)

    def sample(
        loop: LoopState, inputs: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]
    ) -> tuple[LoopState, Instants]:
        state, law_state, previous_voltage, past_speeds = loop
        reference, load, noise = inputs
        current, speed = motor.sensors(state)
        past_speeds = jnp.concatenate([speed[None], past_speeds[:-1]])
        if sensor_delay is not None:
            speed = _delayed(past_speeds, sensor_delay / hardware.sample_time)
        speed = _quantised(speed + noise, hardware.speed_step)
        law_state, voltage = law.step(law_state, reference, speed, current)
        applied = jnp.asarray(previous_voltage if hardware.delay else voltage)

        def substep(state: State, _: None) -> tuple[State, Instants]:
            before = (state.current, state.speed, applied)
            return held_step(motor, step_matrices, Input(drive, applied, load), state), before

        # not unrolled: a step with effects is a long program, and a sample may have dozens
        state, instants = jax.lax.scan(substep, state, length=substeps, unroll=substeps == 1)
        return LoopState(state, law_state, voltage, past_speeds), instants

    _, (current, speed, voltage) = jax.lax.scan(sample, start, (course.reference, course.load, course.speed_noise))
    instants = jnp.arange(current.size)
    time = instants * (hardware.sample_time / substeps)
    return Response(time, current.ravel(), speed.ravel(), voltage.ravel())


closed_loop_jit = compiled(closed_loop)


def _delayed(past_speeds: Float[Array, " remembered"], samples: Number) -> Float[Array, ""]:
    """The speed `samples` ago, linearly interpolated."""
    # just short of the oldest speed, because interpolation also takes the one after
    place = jnp.clip(samples, 0.0, REMEMBERED_SAMPLES - 1.001)
    k = jnp.floor(place).astype(int)
    return past_speeds[k] + (place - k) * (past_speeds[k + 1] - past_speeds[k])


def _quantised(speed: Number, step: Number | None) -> Number:
    """Speed rounded to the sensor's quantum; the gradient ignores the rounding (straight-through)."""
    if step is None:
        return speed
    return speed + jax.lax.stop_gradient(jnp.round(speed / step) * step - speed)
