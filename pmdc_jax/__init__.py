"""Identify, diagnose and control brushed permanent-magnet DC motors from recorded data."""

from __future__ import annotations

import importlib
import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .control.controller_file import load_controller, save_controller
    from .control.export import export
    from .control.pipeline import tune
    from .control.time_optimal import fastest_settling
    from .control.tuning import Tuning
    from .demo import demo
    from .diagnose.diagnosis import Diagnosis
    from .diagnose.pipeline import diagnose
    from .errors import InputError
    from .identify.identification import Identification
    from .identify.pipeline import identify
    from .motor import Motor
    from .motor_file import load_motor, load_speed_noise, load_uncertainty, save_motor
    from .paper.pipeline import paper
    from .recordings.recording import Recording
    from .recordings.recording_file import read_recording, write_recording
    from .simulate import simulate

# Names are imported on first use, so that importing this package is fast and changes no setting.
_HOME = {
    "Diagnosis": "diagnose.diagnosis",
    "Identification": "identify.identification",
    "InputError": "errors",
    "Motor": "motor",
    "Recording": "recordings.recording",
    "Tuning": "control.tuning",
    "demo": "demo",
    "diagnose": "diagnose.pipeline",
    "export": "control.export",
    "fastest_settling": "control.time_optimal",
    "identify": "identify.pipeline",
    "load_controller": "control.controller_file",
    "load_motor": "motor_file",
    "load_speed_noise": "motor_file",
    "load_uncertainty": "motor_file",
    "paper": "paper.pipeline",
    "read_recording": "recordings.recording_file",
    "save_controller": "control.controller_file",
    "save_motor": "motor_file",
    "simulate": "simulate",
    "tune": "control.pipeline",
    "write_recording": "recordings.recording_file",
}

__all__ = [
    "Diagnosis",
    "Identification",
    "InputError",
    "Motor",
    "Recording",
    "Tuning",
    "demo",
    "diagnose",
    "export",
    "fastest_settling",
    "identify",
    "load_controller",
    "load_motor",
    "load_speed_noise",
    "load_uncertainty",
    "paper",
    "read_recording",
    "save_controller",
    "save_motor",
    "simulate",
    "tune",
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
    """Keeps `pmdc_jax.identify` the function when the subpackage of the same name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
