"""The sampled closed loop: one exact step of the motor per sample, or several to resolve the time between samples."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled import compiled
from ..effects.base import Scalars, State
from ..motor import Drive, Motor
from ..simulate.propagator import make_propagator
from ..simulate.solver import Input, held_step
from .controllers import Number
from .law import Law, LawState
from .steady import steady_state

REMEMBERED_SAMPLES = 32  # of the speed, for a sensor with delay

# States of motor and law, voltage computed at the previous sample (V), and past speeds (rad/s), latest first
LoopState = tuple[State, LawState, Number, Float[Array, " remembered"]]
# Current, speed and voltage at one instant, or at all instants of a sample
Instants = tuple[Scalars, Scalars, Scalars]


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
    propagator = make_propagator(motor, jnp.asarray(hardware.sample_time / substeps), drive)
    at, voltage = steady_state(motor, course.initial)
    late = motor.speed_delay()
    memory = law.start(course.initial, at, voltage)
    start = (at, memory, voltage, jnp.full(REMEMBERED_SAMPLES, motor.sensors(at)[1]))

    def sample(
        carry: LoopState, now: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]
    ) -> tuple[LoopState, Instants]:
        state, memory, acting, past = carry
        reference, load, noise = now
        current, speed = motor.sensors(state)
        past = jnp.concatenate([speed[None], past[:-1]])
        if late is not None:
            speed = _earlier(past, late / hardware.sample_time)
        speed = _quantised(speed + noise, hardware.speed_step)
        memory, decided = law.step(memory, reference, speed, current)
        applied = jnp.asarray(acting if hardware.delay else decided)

        def between(state: State, _: None) -> tuple[State, Instants]:
            seen = (state.current, state.speed, applied)
            return held_step(motor, propagator, Input(drive, applied, load), state), seen

        # not unrolled: a step with effects is a long program, and a sample may have dozens
        state, instants = jax.lax.scan(between, state, length=substeps, unroll=substeps == 1)
        return (state, memory, decided, past), instants

    _, (current, speed, voltage) = jax.lax.scan(
        sample, start, (course.reference, course.load, course.speed_noise)
    )
    instants = jnp.arange(current.size)
    time = instants * (hardware.sample_time / substeps)
    return Response(time, current.ravel(), speed.ravel(), voltage.ravel())


closed_loop_jit = compiled(closed_loop)


def _earlier(past: Float[Array, " remembered"], samples: Number) -> Float[Array, ""]:
    """The value `samples` ago, linearly interpolated; `past` is latest first."""
    place = jnp.clip(samples, 0.0, REMEMBERED_SAMPLES - 1.001)
    k = jnp.floor(place).astype(int)
    return past[k] + (place - k) * (past[k + 1] - past[k])


def _quantised(speed: Number, step: Number | None) -> Number:
    """Speed rounded to the sensor's quantum; the gradient ignores the rounding (straight-through)."""
    if step is None:
        return speed
    return speed + jax.lax.stop_gradient(jnp.round(speed / step) * step - speed)
