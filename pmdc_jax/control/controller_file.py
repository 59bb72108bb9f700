"""Sampled control laws as JSON files: gains, limits, and the motor model that they use."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import write_text
from ..json_file import finite_number, read_object
from .controllers import CONTROLLERS, AbstractController, Number
from .hardware import Hardware
from .law import Law, SampledMotor

FORMAT = "pmdc controller 1"
MEND = "Give the controller file that pmdc tune --save wrote"


def gains_of(controller: AbstractController) -> dict[str, float]:
    """Gains by name, in SI units."""
    return {one.name: float(getattr(controller, one.name)) for one in fields(controller)}


def law_content(law: Law) -> dict[str, Any]:
    """A law as plain dictionaries and numbers."""
    hardware = law.hardware
    return {
        "format": FORMAT,
        "type": law.controller.name,
        "gains": gains_of(law.controller),
        "sample_time_s": float(hardware.sample_time),
        "delay_samples": hardware.delay,
        "limits": {"voltage_V": float(hardware.voltage_limit), "current_A": _number_or_none(hardware.current_limit)},
        "speed_step_rad_s": _number_or_none(hardware.speed_step),
        "measures_current": hardware.measures_current,
        "model": {name: float(value) for name, value in law.model._asdict().items()},
    }


def save_controller(path: str | Path, law: Law) -> None:
    """Write a law as JSON, atomically, for `load_controller` and `pmdc export`."""
    write_text(path, json.dumps(law_content(law), indent=2, allow_nan=False) + "\n")


def load_controller(path: str | Path) -> Law:
    """Read a law written by `save_controller`.

    **Raises**: `InputError` where the file is missing or not JSON, or a value is missing or invalid.
    """
    where, content = str(path), read_object(path, FORMAT, MEND)
    if str(content.get("type")) not in CONTROLLERS:
        raise InputError(where, "is not a controller: its type is unknown", MEND)
    limits = content.get("limits")
    limits = limits if isinstance(limits, dict) else {}
    kind = CONTROLLERS[content["type"]]
    delay = content.get("delay_samples", 0)
    if delay not in (0, 1):
        raise InputError(where, f"delay_samples is {delay!r}, neither 0 nor 1", MEND)
    return Law(
        kind(**_numbers(where, content.get("gains"), [one.name for one in fields(kind)])),
        Hardware(
            sample_time=_positive(where, "sample_time_s", content.get("sample_time_s")),
            voltage_limit=_positive(where, "voltage_V", limits.get("voltage_V")),
            current_limit=_positive_or_none(where, "current_A", limits.get("current_A")),
            speed_step=_positive_or_none(where, "speed_step_rad_s", content.get("speed_step_rad_s")),
            delay=int(delay),
            measures_current=bool(content.get("measures_current", True)),
        ),
        SampledMotor(**_numbers(where, content.get("model"), SampledMotor._fields)),
    )


def _numbers(where: str, values: Any, names: Iterable[str]) -> dict[str, float]:
    values = values if isinstance(values, dict) else {}
    return {name: finite_number(where, name, values.get(name), MEND) for name in names}


def _positive(where: str, name: str, value: Any) -> float:
    number = finite_number(where, name, value, MEND)
    if number <= 0:
        raise InputError(where, f"{name} is {value!r}, not positive", MEND)
    return number


def _positive_or_none(where: str, name: str, value: Any) -> float | None:
    return None if value is None else _positive(where, name, value)


def _number_or_none(value: Number | None) -> float | None:
    return None if value is None else float(value)
