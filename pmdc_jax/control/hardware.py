"""Hardware between a controller and its motor: sampling, delay, limits, sensors."""

from __future__ import annotations

import equinox as eqx

from .controllers import Number


class Hardware(eqx.Module):
    """Power stage, sensors and sampling of the loop.

    **Fields**: `sample_time`, s; `voltage_limit`, V, in either direction; `current_limit`, A, in either
    direction, None for none; `speed_step`, rad/s, quantum of the measured speed, None for none; `delay`, 0 or 1
    samples from measurement to voltage; `measures_current`, if False the law estimates the current.
    """

    sample_time: Number
    voltage_limit: Number
    current_limit: Number | None = None
    speed_step: Number | None = None
    delay: int = eqx.field(static=True, default=0)
    measures_current: bool = eqx.field(static=True, default=True)
