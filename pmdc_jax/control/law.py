"""The sampled control law, exactly as the processor computes it, with limits and anti-windup."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..effects.base import State
from ..motor import Drive, Motor
from ..simulate.propagator import make_propagator
from .controllers import AbstractController, Memory, Number
from .hardware import Hardware

# Least distance of an eigenvalue of the motor from the mean of the two, over that mean: at a critically damped motor,
# where they are equal, the formula for the peak of the current has a limit, but divides by zero
LEAST_SPLIT = 1e-6


class SampledMotor(NamedTuple):
    """The law's discrete model of the linear motor: i[k+1] = ii i[k] + iw w[k] + iv v[k], and w[k+1] likewise.

    `pi`, `pw` and `pv` likewise give the current at its peak within the sample, after a step of the voltage from zero;
    they are those of i[k+1] if it then still rises at the end of the sample.
    """

    ii: Number
    iw: Number
    iv: Number
    wi: Number
    ww: Number
    wv: Number
    pi: Number
    pw: Number
    pv: Number

    @classmethod
    def of(cls, motor: Motor, sample_time: Number) -> SampledMotor:
        """Exact discretisation, with held voltage and no load, of the motor without its effects."""
        linear, sample_time = motor.with_effects(()), jnp.asarray(sample_time, float)
        A, B, *_ = make_propagator(linear, sample_time, Drive())
        to_peak = jnp.minimum(sample_time, _time_to_peak_current(linear))
        P, Q, *_ = make_propagator(linear, to_peak, Drive())
        return cls(
            ii=A[0, 0], iw=A[0, 1], iv=B[0, 0], wi=A[1, 0], ww=A[1, 1], wv=B[1, 0], pi=P[0, 0], pw=P[0, 1], pv=Q[0, 0]
        )

    def next(self, current: Number, speed: Number, voltage: Number) -> tuple[Number, Number]:
        """Current and speed one sample later."""
        return (
            self.ii * current + self.iw * speed + self.iv * voltage,
            self.wi * current + self.ww * speed + self.wv * voltage,
        )


def _time_to_peak_current(motor: Motor) -> Number:
    """When the current of the linear motor peaks after a step of the voltage from rest, s: where the derivative of
    (s + f/J) / ((s - a) (s - b)) in the time domain is zero, with the eigenvalues a and b."""
    A, _ = motor.state_space()
    middle, decay = (A[0, 0] + A[1, 1]) / 2, -A[1, 1]
    root = jnp.sqrt((middle**2 - A[0, 0] * A[1, 1] + A[0, 1] * A[1, 0]).astype(complex))
    least = LEAST_SPLIT * jnp.abs(middle)
    root = jnp.where(jnp.abs(root) < least, least, root)
    a, b = middle + root, middle - root
    return jnp.real(jnp.log((b + decay) / (a + decay)) / (a - b))


class LawState(NamedTuple):
    """State of the law: the controller's memory, the current estimated for this sample (A), the voltage computed at the
    previous one (V), and the voltage missing in the model, by the currents measured so far (V)."""

    memory: Memory
    current: Number
    voltage: Number
    missing_voltage: Number


class Law(eqx.Module):
    """A controller on its hardware.

    **Fields**: `controller`; `hardware`; `model`, the motor that the law is designed for, used to enforce the current
    limit, to predict the fed-back state over the delay, and to estimate a current that is not measured.

    The limit must hold for the real motor too, with hot magnets or brushes. Where a current is measured, what its
    prediction lacked, as a voltage at the terminals, is integrated with half of the gain that would remove it in the
    steady state of the winding, so that a resistance up to four times smaller than the model's is stable, and added in
    the predictions for the limit; feedback is left alone, because the loop is tuned and its margins hold without it.
    """

    controller: AbstractController
    hardware: Hardware
    model: SampledMotor

    @classmethod
    def of(cls, controller: AbstractController, hardware: Hardware, motor: Motor) -> Law:
        """The law for a motor."""
        return cls(controller, hardware, SampledMotor.of(motor, hardware.sample_time))

    def start(self, reference: Number, at: State, voltage: Number) -> LawState:
        """State of the law in steady state: motor state `at`, held by `voltage`, V, at `reference`, rad/s."""
        step = self.hardware.sample_time
        memory = self.controller.equilibrium(reference, at.speed, at.current, voltage, step)
        predicted, _ = self.model.next(at.current, at.speed, voltage)
        missing = (
            (at.current - predicted) / self.model.iv if self.hardware.measures_current else jnp.zeros_like(voltage)
        )
        return LawState(memory, at.current, voltage, missing)

    def step(self, state: LawState, reference: Number, speed: Number, current: Number) -> tuple[LawState, Number]:
        """Compute one sample: the next state and the voltage (V) from the measured speed (rad/s) and current (A).

        The current is ignored where the hardware does not measure it. The voltage takes effect after the hardware's
        delay.
        """
        hardware, model = self.hardware, self.model
        if not hardware.measures_current:
            current = state.current
        missing = state.missing_voltage + (1 - model.ii) / (2 * model.iv) * (current - state.current)
        ahead_current, ahead_speed = self._ahead(current, speed, state.voltage)
        fed_back_speed = ahead_speed if self.controller.feeds_back_current else speed
        period = hardware.sample_time
        commanded = self.controller.command(state.memory, reference, fed_back_speed, ahead_current, period)
        limited = self._limited(commanded, *self._ahead(current, speed, state.voltage + missing), missing)
        rates = self.controller.rates(state.memory, reference, speed, limited - commanded, period)
        memory = Memory(*(m + period * r for m, r in zip(state.memory, rates, strict=True)))
        # The current is estimated from the winding's equation alone, with the measured speed at every sample. The load
        # does not enter: the error decays with L / R, and an unknown torque causes no bias, as it would in a full-order
        # observer.
        acting = state.voltage if hardware.delay else limited
        next_current, _ = model.next(current, speed, acting + missing)
        return LawState(memory, next_current, limited, missing), limited

    def _ahead(self, current: Number, speed: Number, voltage: Number) -> tuple[Number, Number]:
        """Current and speed when the voltage of this sample takes effect; until then, `voltage` acts."""
        return self.model.next(current, speed, voltage) if self.hardware.delay else (current, speed)

    def _limited(self, voltage: Number, current: Number, speed: Number, missing: Number) -> Number:
        """The voltage limited so that the current keeps its limit throughout the sample, then to the voltage limit."""
        hardware, model = self.hardware, self.model
        if hardware.current_limit is not None:
            unforced_current = model.pi * current + model.pw * speed + model.pv * missing
            lowest = (-hardware.current_limit - unforced_current) / model.pv
            highest = (hardware.current_limit - unforced_current) / model.pv
            voltage = jnp.clip(voltage, lowest, highest)
        return jnp.clip(voltage, -hardware.voltage_limit, hardware.voltage_limit)
