"""The sampled control law: exactly what the processor computes, limits and anti-windup included."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..effects.base import State
from ..motor import Drive, Motor
from ..simulate.propagator import propagator
from .controllers import AbstractController, Memory, Number
from .hardware import Hardware


class SampledMotor(NamedTuple):
    """The linear motor over one sample, as the law knows it: i[k+1] = ii i[k] + iw w[k] + iv v[k], and w likewise."""

    ii: Number
    iw: Number
    iv: Number
    wi: Number
    ww: Number
    wv: Number

    @classmethod
    def of(cls, motor: Motor, sample_time: Number) -> SampledMotor:
        """The exact discretisation of the motor, whose effects the law does not know."""
        whole, inputs, *_ = propagator(
            motor.with_effects(()), jnp.asarray(sample_time, float), Drive()
        )
        return cls(whole[0, 0], whole[0, 1], inputs[0, 0], whole[1, 0], whole[1, 1], inputs[1, 0])

    def next(self, current: Number, speed: Number, voltage: Number) -> tuple[Number, Number]:
        """Current and speed one sample later."""
        return (
            self.ii * current + self.iw * speed + self.iv * voltage,
            self.wi * current + self.ww * speed + self.wv * voltage,
        )


class LawState(NamedTuple):
    """Kept from sample to sample: the controller's memory, the estimated current in A, and the voltage in V that
    was decided last."""

    memory: Memory
    current: Number
    voltage: Number


class Law(eqx.Module):
    """A controller on its hardware.

    **Fields**: `controller`; `hardware`; `model`, the motor it is designed for, used for the current limit, for the
    delay of state feedback, and for the current where it is not measured.
    """

    controller: AbstractController
    hardware: Hardware
    model: SampledMotor

    @classmethod
    def of(cls, controller: AbstractController, hardware: Hardware, motor: Motor) -> Law:
        """The law for a motor."""
        return cls(controller, hardware, SampledMotor.of(motor, hardware.sample_time))

    def start(self, reference: Number, at: State, voltage: Number) -> LawState:
        """The state of a law that has long held the motor where it is."""
        step = self.hardware.sample_time
        memory = self.controller.equilibrium(reference, at.speed, at.current, voltage, step)
        return LawState(memory, at.current, voltage)

    def step(
        self, state: LawState, reference: Number, speed: Number, current: Number
    ) -> tuple[LawState, Number]:
        """One sample: measured speed (rad/s) and current (A; ignored where it is not measured) to voltage (V).

        The voltage is the one decided now; it takes effect after the hardware's delay.
        """
        hardware, model = self.hardware, self.model
        here = current if hardware.measures_current else state.current
        ahead = (here, speed)
        if hardware.delay:  # until then the voltage decided last acts
            ahead = model.next(here, speed, state.voltage)
        seen = ahead[1] if self.controller.feeds_back_current else speed
        period = hardware.sample_time
        asked = self.controller.command(state.memory, reference, seen, ahead[0], period)
        applied = self._limited(asked, *ahead)
        rates = self.controller.rates(state.memory, reference, speed, applied - asked, period)
        memory = Memory(*(m + period * r for m, r in zip(state.memory, rates, strict=True)))
        # the winding's own equation, corrected by the measured speed at every sample and blind to the load: its
        # error dies out with L / R, and no unknown torque biases it, as it would in a full-order observer
        acting = state.voltage if hardware.delay else applied
        return LawState(memory, model.next(here, speed, acting)[0], applied), applied

    def _limited(self, voltage: Number, current: Number, speed: Number) -> Number:
        """Within the voltage that keeps the current at the end of the sample within its limit, then within the
        voltage there is."""
        hardware, model = self.hardware, self.model
        if hardware.current_limit is not None:
            free = model.ii * current + model.iw * speed
            lowest = (-hardware.current_limit - free) / model.iv
            highest = (hardware.current_limit - free) / model.iv
            voltage = jnp.clip(voltage, lowest, highest)
        return jnp.clip(voltage, -hardware.voltage_limit, hardware.voltage_limit)
