"""What stands between a controller and its motor: sampling, delay, limits, sensors."""

from __future__ import annotations

import equinox as eqx

from .controllers import Number


class Hardware(eqx.Module):
    """Power stage, sensors and the processor's clock.

    **Fields**: `sample_time`, s; `voltage_limit`, V, either direction; `current_limit`, A, either direction, None
    for none; `speed_step`, rad/s, the quantum of the measured speed, None for none; `delay`, whole samples from
    measurement to voltage, 0 or 1; `measures_current`, without which the current is estimated.
    """

    sample_time: Number
    voltage_limit: Number
    current_limit: Number | None = None
    speed_step: Number | None = None
    delay: int = eqx.field(static=True, default=0)
    measures_current: bool = eqx.field(static=True, default=True)
