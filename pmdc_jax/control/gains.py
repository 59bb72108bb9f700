"""Between which values the gains of each controller are sought, scaled to motor, limits and sampling."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..motor import Motor
from .controllers import CONTROLLERS, AbstractController, Number
from .steady import steady_state

# Each as (lower, upper), the first two of the voltage limit over the set point, times of the fastest settling time.
# Wide: in an unhurried search over PI and PID on seven voltages the best lay inside by a factor of three and more.
RANGES: Mapping[str, tuple[float, float]] = {
    "stiffness": (0.1, 300.0),  # Kp, K2
    "integral_time": (0.05, 100.0),  # Kp / Ki
    "derivative_time": (0.003, 0.5),  # Kd / Kp, and K1 / K2 in the time it stands for
    "filter_time": (0.001, 0.1),
    "tracking_time": (0.001, 30.0),
    "setpoint_weight": (0.2, 2.0),  # as it is
}


class GainSpace(NamedTuple):
    """The space in which a controller is tuned; coordinates are natural logarithms."""

    kind: str
    stiffness: Number  # V s/rad, the unit of proportional gains
    duration: Number  # s, the unit of times
    sample_time: Number  # s
    motor: Motor
    setpoint: Number  # rad/s

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates."""
        return CONTROLLERS[self.kind].coordinates

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of the coordinates."""
        limits = np.log([RANGES[name] for name in self.names])
        return limits[:, 0], limits[:, 1]

    def controller(self, coordinates: Float[Array, " gains"]) -> AbstractController:
        """The controller at these coordinates."""
        kind = CONTROLLERS[self.kind]
        at = {name: jnp.exp(x) for name, x in zip(self.names, coordinates, strict=True)}
        times = {name: self.duration * at[name] for name in at if name.endswith("_time")}
        stiffness, gains = self.stiffness * at["stiffness"], {}
        if kind.feeds_back_current:
            # K1 i is K2 times the speed that the current's torque gains in that time
            current_gain = stiffness * times["derivative_time"] * self.motor.Kt / self.motor.J
            gains["reference_gain"] = reference_gain(
                self.motor, self.setpoint, current_gain, stiffness
            )
            gains |= {"current_gain": current_gain, "speed_gain": stiffness}
        else:
            gains |= {"proportional": stiffness, "setpoint_weight": at["setpoint_weight"]}
        if kind.integrates:
            gains["integral"] = stiffness / times["integral_time"]
            gains["tracking_time"] = jnp.maximum(times["tracking_time"], self.sample_time)
        if kind.filters_derivative:
            gains["derivative"] = stiffness * times["derivative_time"]
            gains["filter_time"] = times["filter_time"]
        return kind(**gains)


def reference_gain(
    motor: Motor, setpoint: Number, current_gain: Number, speed_gain: Number
) -> Number:
    """Kr for which state feedback holds the set point exactly, without load."""
    state, voltage = steady_state(motor, setpoint)
    return (voltage + current_gain * state.current) / setpoint + speed_gain
