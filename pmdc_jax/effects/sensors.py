"""Effects of sensors on current and speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from .base import AbstractEffect, ParameterRange, Scalars, State

if TYPE_CHECKING:
    from ..motor import Motor


class SpeedSensorLag(AbstractEffect):
    """Lag: the reported speed y follows the speed w with dy/dt = (w - y) / time_constant_s; a run starts with y = w.

    **Fields**: `time_constant_s`, in s, > 0; tachometer filters have 1 to 50 ms.
    **Excitation needed**: speed that changes within a few time constants, and a measured current, which shows it.
    **Source**: Astrom, Wittenmark, "Computer-Controlled Systems", 3rd edition, section 7.4 (filters).
    """

    name: ClassVar = "speed_sensor_lag"
    label: ClassVar = "Lag of the speed sensor"
    formula: ClassVar = "dy/dt = (w - y) / tau"
    equation: ClassVar = "sensor"
    states: ClassVar = ("reported_speed",)
    affine: ClassVar = True
    ranges: ClassVar = {"time_constant_s": ParameterRange("s", 1e-6, 10.0)}

    time_constant_s: Scalars

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del load, angle
        return {"reported_speed": speed}

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        del motor, load
        behind = state.speed - state.extra["reported_speed"]
        return {"reported_speed": behind * (1 / self.time_constant_s)}

    def linear(self) -> AbstractEffect:
        return self

    def sensors(self, state: State, current: Scalars, speed: Scalars) -> tuple[Scalars, Scalars]:
        del speed
        return current, state.extra["reported_speed"]

    def speed_before_sensor(
        self, reported: Float[np.ndarray, " samples"], time: Float[np.ndarray, " samples"]
    ) -> Float[np.ndarray, " samples"]:
        return reported + float(self.time_constant_s) * np.gradient(reported, time)


class SpeedSensorDelay(AbstractEffect):
    """Delay: the reported speed is y(t) = w(t - delay_s); before the start of a run, w is taken as at the start.

    **Fields**: `delay_s`, in s, > 0; bus and filter delays are 0.1 to 50 ms.
    **Excitation needed**: fast changes of speed; a lag attenuates them, a delay only shifts them.
    **Source**: Astrom, Wittenmark, "Computer-Controlled Systems", 3rd edition, section 2.3 (time delays).
    """

    name: ClassVar = "speed_sensor_delay"
    label: ClassVar = "Delay of the speed sensor"
    formula: ClassVar = "y(t) = w(t - delay)"
    equation: ClassVar = "sensor"
    affine: ClassVar = True
    ranges: ClassVar = {"delay_s": ParameterRange("s", 1e-6, 1.0)}

    delay_s: Scalars

    def speed_delay(self) -> Scalars:
        return self.delay_s

    def speed_before_sensor(
        self, reported: Float[np.ndarray, " samples"], time: Float[np.ndarray, " samples"]
    ) -> Float[np.ndarray, " samples"]:
        return np.interp(time + float(self.delay_s), time, reported)


class CurrentSensorOffset(AbstractEffect):
    """Offset: the reported current is i + offset_A. For runs whose voltage was recorded.

    **Fields**: `offset_A`, in A, of either sign; Hall sensors have up to 1 % of their range.
    **Excitation needed**: a stretch at rest without voltage, or currents of both signs.
    **Source**: Ziegler, Woodward, Iu, Borle, "Current sensing techniques: a review", IEEE Sensors Journal 9
    (2009), doi:10.1109/JSEN.2009.2013914.
    """

    name: ClassVar = "current_sensor_offset"
    label: ClassVar = "Offset of the current sensor"
    formula: ClassVar = "i_reported = i + i_0"
    equation: ClassVar = "sensor"
    needs_current: ClassVar = True
    affine: ClassVar = True
    ranges: ClassVar = {"offset_A": ParameterRange("A", -1e3, 1e3, "linear")}

    offset_A: Scalars

    def sensors(self, state: State, current: Scalars, speed: Scalars) -> tuple[Scalars, Scalars]:
        del state
        return current + self.offset_A, speed
