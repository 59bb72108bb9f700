"""Physical effects beyond the linear motor, one class each; `EFFECTS` is the table of them by name."""

from .base import AbstractEffect, Grip, ParameterRange, State
from .brush_voltage_drop import BrushVoltageDrop
from .coulomb_friction import CoulombFriction
from .resistance_heating import ResistanceHeating

EFFECTS: dict[str, type[AbstractEffect]] = {
    effect.name: effect for effect in (CoulombFriction, BrushVoltageDrop, ResistanceHeating)
}

__all__ = [
    "EFFECTS",
    "AbstractEffect",
    "BrushVoltageDrop",
    "CoulombFriction",
    "Grip",
    "ParameterRange",
    "ResistanceHeating",
    "State",
]
