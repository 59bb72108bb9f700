"""A load torque that never changes."""

from __future__ import annotations

from typing import ClassVar

from .base import AbstractEffect, ParameterRange, Scalars


class ConstantLoad(AbstractEffect):
    """Constant load: a torque T_0 that opposes positive motion, whichever way the motor turns: a weight, a
    spring, the zero error of a torque sensor. It acts where a recorded load does: behind a shaft or gear.

    A run with unknown load already has such a torque as an unknown, from which this one cannot be distinguished.

    **Fields**: `torque_Nm`, T_0 in N m, of either sign.
    **Excitation needed**: motion in both directions, or several speeds.
    **Source**: Hughes, Drury, "Electric Motors and Drives", 5th edition, section 11.4 (hoists).
    """

    name: ClassVar = "constant_load"
    label: ClassVar = "Constant load"
    formula: ClassVar = "T = T_0"
    equation: ClassVar = "mechanical"
    affine: ClassVar = True
    ranges: ClassVar = {"torque_Nm": ParameterRange("N m", -1e5, 1e5, "linear")}

    torque_Nm: Scalars

    def load_torque(self, load: Scalars) -> Scalars:
        return load + self.torque_Nm
