"""Search ranges for the gains of each controller, scaled to the motor, its limits and the sample time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..motor import Motor
from .controllers import CONTROLLERS, AbstractController, Number
from .steady import steady_state

# (lower, upper): the gain in units of voltage limit over set point, times in units of the fastest settling time,
# or of what the dead time of the loop allows.
# The ranges are wide: in a long search for PI and PID at seven voltages, the best gains lay inside them by a factor of
# at least three.
RANGES: Mapping[str, tuple[float, float]] = {
    "proportional_gain": (0.1, 300.0),  # Kp, K2
    "integral_time": (0.05, 100.0),  # Kp / Ki
    "derivative_time": (0.003, 0.5),  # Kd / Kp; for state feedback K1 J / (K2 Kt)
    "filter_time": (0.001, 0.1),
    "tracking_time": (0.001, 30.0),
    "setpoint_weight": (0.2, 2.0),  # dimensionless
}


class GainSpace(NamedTuple):
    """Search space for the gains of a controller; coordinates are natural logarithms."""

    kind: str
    gain_unit: Number  # V s/rad, of proportional gains
    time_unit: Number  # s
    sample_time: Number  # s
    motor: Motor
    setpoint: Number  # rad/s

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return CONTROLLERS[self.kind].coordinates

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of the coordinates."""
        limits = np.log([RANGES[name] for name in self.names])
        return limits[:, 0], limits[:, 1]

    def controller(self, coordinates: Float[Array, " gains"]) -> AbstractController:
        """The controller at these coordinates."""
        kind = CONTROLLERS[self.kind]
        relative = {name: jnp.exp(x) for name, x in zip(self.names, coordinates, strict=True)}
        times = {name: self.time_unit * value for name, value in relative.items() if name.endswith("_time")}
        gain, gains = self.gain_unit * relative["proportional_gain"], {}
        if kind.feeds_back_current:
            # K1 i equals K2 times the change of speed that the torque Kt i produces in derivative_time
            current_gain = gain * times["derivative_time"] * self.motor.Kt / self.motor.J
            gains["reference_gain"] = reference_gain(self.motor, self.setpoint, current_gain, gain)
            gains |= {"current_gain": current_gain, "speed_gain": gain}
        else:
            gains |= {"proportional": gain, "setpoint_weight": relative["setpoint_weight"]}
        if kind.integrates:
            gains["integral"] = gain / times["integral_time"]
            gains["tracking_time"] = jnp.maximum(times["tracking_time"], self.sample_time)
        if kind.filters_derivative:
            gains["derivative"] = gain * times["derivative_time"]
            gains["filter_time"] = times["filter_time"]
        return kind(**gains)


def reference_gain(motor: Motor, setpoint: Number, current_gain: Number, speed_gain: Number) -> Number:
    """Kr, V s/rad, with which state feedback holds the set point exactly, without load."""
    state, voltage = steady_state(motor, setpoint)
    return (voltage + current_gain * state.current) / setpoint + speed_gain
