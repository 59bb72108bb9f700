"""Identify, diagnose and control brushed permanent-magnet DC motors from recorded data."""

from __future__ import annotations

import importlib
import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .demo import demo
    from .diagnose.diagnosis import Diagnosis
    from .diagnose.pipeline import diagnose
    from .errors import InputError
    from .identify.identification import Identification
    from .identify.pipeline import identify
    from .motor import Motor
    from .motor_file import load_motor, save_motor
    from .recording import Recording, read_recording, write_recording
    from .simulate import simulate

# Names are loaded when first used: importing this package costs nothing and changes no setting.
_HOME = {
    "Diagnosis": "diagnose.diagnosis",
    "Identification": "identify.identification",
    "InputError": "errors",
    "Motor": "motor",
    "Recording": "recording",
    "demo": "demo",
    "diagnose": "diagnose.pipeline",
    "identify": "identify.pipeline",
    "load_motor": "motor_file",
    "read_recording": "recording",
    "save_motor": "motor_file",
    "simulate": "simulate",
    "write_recording": "recording",
}

__all__ = [
    "Diagnosis",
    "Identification",
    "InputError",
    "Motor",
    "Recording",
    "demo",
    "diagnose",
    "identify",
    "load_motor",
    "read_recording",
    "save_motor",
    "simulate",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


class _Package(types.ModuleType):
    """`pmdc_jax.identify` is the function, also once the subpackage of that name has been imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
