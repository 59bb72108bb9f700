"""The wheelchair-motor paper as printed: its motor, its settings and its results."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from attrs import frozen

from ..motor import PARAMETERS, Motor

TABLE_1 = {"R": 0.157378, "L": 0.0003137, "Kb": 0.0492, "Kt": 0.0501, "J": 0.000466, "f": 0.0002546}
PRINTED = Motor(**{name: np.asarray(TABLE_1[name]) for name in PARAMETERS}, effects=())
VOLTAGE = 24.0  # V
SETPOINT = 481.0  # rad/s
LOWER_SETPOINT = 240.5  # rad/s
LOADS = np.linspace(0.0, 1.0, 9)  # N m


@frozen
class PrintedRow:
    """A row of Table 2: overshoot, %, settling time, s, and gains Kp, V s/rad, Ki, V/rad, Kd, V s^2/rad, if printed."""

    overshoot: float
    settling: float
    gains: tuple[float, float, float] | None


TABLE_2: Mapping[str, PrintedRow] = {
    "pi": PrintedRow(37.83, 0.16, (0.042346, 3.69, 0.0)),
    "pid": PrintedRow(11.02, 0.18, (0.084618, 5.4121, 0.00022659)),
    "state-feedback": PrintedRow(0.06, 0.08, None),
}
