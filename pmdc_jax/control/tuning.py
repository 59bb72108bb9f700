"""The result of a tuning."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from attrs import field, frozen

from ..motor import Motor
from .controllers import AbstractController
from .evaluation import EvaluatedController, Robustness
from .hardware import Hardware
from .law import Law
from .loop import Response
from .margins import Margins
from .objective import Task
from .specification import LoopRequirements


@frozen
class Tuning:
    """Result of a tuning: the law, its performance, and the fastest settling possible."""

    law: Law
    motor: Motor
    task: Task
    requirements: LoopRequirements
    tuned: EvaluatedController
    textbook: EvaluatedController  # by a rule
    validation_speeds: np.ndarray | None = field(repr=False)  # (motors, samples) rad/s
    seed: int
    seconds: Mapping[str, float] = field(factory=dict)
    messages: tuple[str, ...] = ()

    @property
    def metrics(self) -> Mapping[str, float | None]:
        """Metrics of the step, on the nominal motor."""
        return self.tuned.metrics

    @property
    def margins(self) -> Margins:
        """Margins of the loop."""
        return self.tuned.margins

    @property
    def response(self) -> Response:
        """The response over the whole course, on the nominal motor."""
        return self.tuned.response

    @property
    def load(self) -> Mapping[str, float | None]:
        """Metrics of the load step, on the nominal motor."""
        return self.tuned.load

    @property
    def robust(self) -> Robustness | None:
        """Metrics over the drawn motors; None without an uncertainty or spread."""
        return self.tuned.robust

    @property
    def setpoint(self) -> float:
        """Set point, rad/s."""
        return float(self.task.setpoint)

    @property
    def load_torque(self) -> float:
        """Load step in the simulation, N m."""
        return float(self.task.load)

    @property
    def load_step_time(self) -> float:
        """Time of the load step, s."""
        return self.task.part_samples * float(self.hardware.sample_time)

    @property
    def fastest_possible_settling(self) -> float:
        """Shortest settling time of any controller within the limits, s."""
        return float(self.task.fastest_settling)

    @property
    def peak_current(self) -> float:
        """Largest simulated current, A."""
        return float(np.abs(self.response.current).max())

    @property
    def voltage_noise(self) -> float | None:
        """RMS of the voltage due to the noise of the speed sensor, V; None where the loop is unstable."""
        gain = self.margins.voltage_per_noise
        return None if gain is None else gain * self.requirements.sensor_noise

    @property
    def controller(self) -> AbstractController:
        """The controller with its gains."""
        return self.law.controller

    @property
    def hardware(self) -> Hardware:
        """The hardware that the loop was tuned for."""
        return self.law.hardware

    @property
    def meets_specification(self) -> bool:
        """Whether the overshoot, and the settling time if limited, meet the specification on the nominal motor, and the
        loop is stable."""
        overshoot, settling = self.metrics["Overshoot"], self.metrics["SettlingTime"]
        if overshoot is None or settling is None or overshoot > self.requirements.allowed_overshoot:
            return False
        if not self.margins.stable:
            return False
        return self.requirements.max_settling is None or settling <= self.requirements.max_settling
