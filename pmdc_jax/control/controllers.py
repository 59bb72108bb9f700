"""Speed controllers: the voltage command of each and the rates of its states, continuous and sampled."""

# no deferred annotations: Equinox would take a deferred AbstractVar for a field
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ..effects.base import Scalars

Number = Scalars | float


class Memory(NamedTuple):
    """States of a controller: its integral, V, and the output of its derivative filter, a speed in rad/s."""

    integral: Number
    filtered: Number


class AbstractController(eqx.Module):
    """A speed controller.

    One definition serves both continuous time, d(memory)/dt = rates(..., step=0), and sampling,
    memory += step * rates(..., step), which discretises the derivative filter by backward Euler. The class also holds
    what reports, the search for gains and the export to C need to know about a controller.
    """

    name: ClassVar[str]
    # name in reports
    label: ClassVar[str]
    # unit of every gain
    units: ClassVar[dict[str, str]]
    # coordinates of the search for its gains, keys of `gains.RANGES`
    coordinates: ClassVar[tuple[str, ...]]
    # `command` in C, for `export`: `slope` is the filtered derivative, `ahead` the predicted speed, for state feedback
    c_command: ClassVar[str]
    # if true, `command` gets current and speed predicted for the moment when the voltage takes effect
    feeds_back_current: ClassVar[bool] = False
    integrates: ClassVar[bool] = False
    filters_derivative: ClassVar[bool] = False

    def command(self, memory: Memory, reference: Number, speed: Number, current: Number, step: Number) -> Number:
        """Commanded voltage, V, before any limit.

        **Arguments**: `reference` and `speed`, rad/s; `current`, A; `step`, the sample time in s, 0 in
        continuous time.
        """
        raise NotImplementedError

    def rates(self, memory: Memory, reference: Number, speed: Number, excess: Number, step: Number) -> Memory:
        """Rates of the memory, per second, zero for a state that is not used; `excess`, V, is the applied minus the
        commanded voltage."""
        del reference, speed, excess, step
        return jax.tree.map(jnp.zeros_like, memory)

    def equilibrium(self, reference: Number, speed: Number, current: Number, voltage: Number, step: Number) -> Memory:
        """Memory in steady state: the filter holds `speed`, the integral, if any, makes the command `voltage`."""
        memory = Memory(jnp.zeros_like(jnp.asarray(speed, float)), speed)
        if not self.integrates:
            return memory
        integral = voltage - self.command(memory, reference, speed, current, step)
        return memory._replace(integral=integral)


class _Integrating(AbstractController):
    """A controller with integral action, and with back-calculation over `tracking_time` while the voltage is limited.

    **Source**: Astrom, Hagglund, "Advanced PID Control" (2006), section 3.5, back-calculation.
    """

    integrates: ClassVar = True

    integral: eqx.AbstractVar[Number]
    tracking_time: eqx.AbstractVar[Number]

    def rates(self, memory: Memory, reference: Number, speed: Number, excess: Number, step: Number) -> Memory:
        tracking = excess / jnp.maximum(self.tracking_time, step)
        rates = super().rates(memory, reference, speed, excess, step)
        return rates._replace(integral=self.integral * (reference - speed) + tracking)


class PI(_Integrating):
    """PI controller with set-point weight and back-calculation.

    u = Kp (b r - w) + I,  dI/dt = Ki (r - w) + (v - u) / Tt

    **Fields**: `proportional` Kp, V s/rad; `integral` Ki, V/rad; `setpoint_weight` b; `tracking_time` Tt, s,
    time constant with which the integral tracks the limited voltage v; at least one sample is used.
    """

    name: ClassVar = "pi"
    label: ClassVar = "PI controller"
    units: ClassVar = {"proportional": "V s/rad", "integral": "V/rad", "setpoint_weight": "", "tracking_time": "s"}
    coordinates: ClassVar = ("proportional_gain", "integral_time", "setpoint_weight", "tracking_time")
    c_command: ClassVar = "PMDC_PROPORTIONAL * (PMDC_SETPOINT_WEIGHT * reference - speed) + state->integral"

    proportional: Number
    integral: Number
    setpoint_weight: Number
    tracking_time: Number

    def command(self, memory: Memory, reference: Number, speed: Number, current: Number, step: Number) -> Number:
        del current, step
        return self.proportional * (self.setpoint_weight * reference - speed) + memory.integral


class PID(_Integrating):
    """PID controller; the derivative acts on the measured speed only, through a first-order filter.

    u = Kp (b r - w) + I - Kd (w - z) / Tf,  dz/dt = (w - z) / Tf,  dI/dt = Ki (r - w) + (v - u) / Tt

    **Fields**: as `PI`; `derivative` Kd, V s^2/rad; `filter_time` Tf, s.
    """

    name: ClassVar = "pid"
    label: ClassVar = "PID controller"
    units: ClassVar = PI.units | {"derivative": "V s^2/rad", "filter_time": "s"}
    coordinates: ClassVar = (
        "proportional_gain",
        "integral_time",
        "derivative_time",
        "filter_time",
        "setpoint_weight",
        "tracking_time",
    )
    c_command: ClassVar = f"{PI.c_command} - PMDC_DERIVATIVE * slope"
    filters_derivative: ClassVar = True

    proportional: Number
    integral: Number
    derivative: Number
    filter_time: Number
    setpoint_weight: Number
    tracking_time: Number

    def command(self, memory: Memory, reference: Number, speed: Number, current: Number, step: Number) -> Number:
        del current
        slope = self._slope(memory, speed, step)
        proportional = self.proportional * (self.setpoint_weight * reference - speed)
        return proportional + memory.integral - self.derivative * slope

    def rates(self, memory: Memory, reference: Number, speed: Number, excess: Number, step: Number) -> Memory:
        rates = super().rates(memory, reference, speed, excess, step)
        return rates._replace(filtered=self._slope(memory, speed, step))

    def _slope(self, memory: Memory, speed: Number, step: Number) -> Number:
        """The filtered derivative of the speed, rad/s^2: also the rate of the filter."""
        return (speed - memory.filtered) / (self.filter_time + step)


class StateFeedback(AbstractController):
    """State feedback, without integral action: a load leaves a steady error.

    u = Kr r - K1 i - K2 w

    **Fields**: `reference_gain` Kr, V s/rad; `current_gain` K1, V/A; `speed_gain` K2, V s/rad.
    """

    name: ClassVar = "state-feedback"
    label: ClassVar = "State feedback"
    units: ClassVar = {"reference_gain": "V s/rad", "current_gain": "V/A", "speed_gain": "V s/rad"}
    coordinates: ClassVar = ("proportional_gain", "derivative_time")
    c_command: ClassVar = "PMDC_REFERENCE_GAIN * reference - (PMDC_CURRENT_GAIN * current + PMDC_SPEED_GAIN * ahead)"
    feeds_back_current: ClassVar = True

    reference_gain: Number
    current_gain: Number
    speed_gain: Number

    def command(self, memory: Memory, reference: Number, speed: Number, current: Number, step: Number) -> Number:
        del memory, step
        feedback = self.current_gain * current + self.speed_gain * speed
        return self.reference_gain * reference - feedback


class StateFeedbackIntegral(_Integrating):
    """State feedback with integral action and back-calculation.

    u = Kr r - K1 i - K2 w + I,  dI/dt = Ki (r - w) + (v - u) / Tt

    **Fields**: as `StateFeedback`; `integral` Ki, V/rad; `tracking_time` Tt, s.
    """

    name: ClassVar = "state-feedback-integral"
    label: ClassVar = "State feedback with integral action"
    units: ClassVar = StateFeedback.units | {"integral": "V/rad", "tracking_time": "s"}
    coordinates: ClassVar = ("proportional_gain", "derivative_time", "integral_time", "tracking_time")
    c_command: ClassVar = f"{StateFeedback.c_command} + state->integral"
    feeds_back_current: ClassVar = True

    reference_gain: Number
    current_gain: Number
    speed_gain: Number
    integral: Number
    tracking_time: Number

    def command(self, memory: Memory, reference: Number, speed: Number, current: Number, step: Number) -> Number:
        del step
        feedback = self.current_gain * current + self.speed_gain * speed
        return self.reference_gain * reference - feedback + memory.integral


CONTROLLERS: dict[str, type[AbstractController]] = {
    kind.name: kind for kind in (PI, PID, StateFeedback, StateFeedbackIntegral)
}
