"""Physical effects beyond the linear motor, one class each; `EFFECTS` is the table of them by name."""

from collections.abc import Iterable

from .angle_torque import CoggingTorque, TorqueRipple
from .base import AbstractEffect, Grip, ParameterRange, State
from .brush_voltage_drop import BrushVoltageDrop, GradualBrushDrop
from .constant_load import ConstantLoad
from .coulomb_friction import AsymmetricFriction, CoulombFriction
from .input_dead_zone import InputDeadZone
from .quadratic_drag import QuadraticDrag
from .resistance_heating import ResistanceHeating
from .saturation import InductanceSaturation, TorqueConstantSaturation
from .sensors import CurrentSensorOffset, SpeedSensorDelay, SpeedSensorLag
from .shaft import GearBacklash, ShaftCompliance
from .stribeck_friction import StribeckFriction

EFFECTS: dict[str, type[AbstractEffect]] = {
    effect.name: effect
    for effect in (
        CoulombFriction,
        StribeckFriction,
        AsymmetricFriction,
        QuadraticDrag,
        CoggingTorque,
        TorqueRipple,
        ConstantLoad,
        ShaftCompliance,
        GearBacklash,
        BrushVoltageDrop,
        ResistanceHeating,
        TorqueConstantSaturation,
        InductanceSaturation,
        InputDeadZone,
        SpeedSensorLag,
        SpeedSensorDelay,
        CurrentSensorOffset,
    )
}

# Other forms of effects, with more parameters, in which they are fitted where the runs call for it
OTHER_FORMS: dict[str, type[AbstractEffect]] = {GradualBrushDrop.name: GradualBrushDrop}


def form_with(effect: str, fields: Iterable[str]) -> type[AbstractEffect]:
    """The form of an effect that has these parameters: the other one if any of them belongs to that alone."""
    usual = EFFECTS[effect]
    other = OTHER_FORMS.get(effect, usual)
    return other if (other.ranges.keys() - usual.ranges.keys()) & set(fields) else usual


def range_of(effect: str, field: str) -> ParameterRange:
    """Unit and bounds of a parameter of an effect, in either of its forms."""
    return form_with(effect, [field]).ranges[field]


__all__ = [
    "EFFECTS",
    "OTHER_FORMS",
    "AbstractEffect",
    "AsymmetricFriction",
    "BrushVoltageDrop",
    "CoggingTorque",
    "ConstantLoad",
    "CoulombFriction",
    "CurrentSensorOffset",
    "GearBacklash",
    "GradualBrushDrop",
    "Grip",
    "InductanceSaturation",
    "InputDeadZone",
    "ParameterRange",
    "QuadraticDrag",
    "ResistanceHeating",
    "ShaftCompliance",
    "SpeedSensorDelay",
    "SpeedSensorLag",
    "State",
    "StribeckFriction",
    "TorqueConstantSaturation",
    "TorqueRipple",
    "form_with",
    "range_of",
]
