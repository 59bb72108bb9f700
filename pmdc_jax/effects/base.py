"""What a physical effect may touch.

An effect is an Equinox module whose fields are its parameters. It plugs into the motor at named places,
each of which does nothing unless the effect overrides it:

- `terminal_voltage`: the voltage that reaches the winding, V
- `parameters`: the motor's own parameters at a state, R(temperature), Kt(current), ...
- `voltage_drop` and `torque`: smooth terms of the electrical and the mechanical equation
- `grip`: a dry, set-valued term that can hold a state at exactly zero (stiction, brush contact)
- `states` and `derivative`: states of its own
- `sensors`: how current and speed are seen

New effects are one class here and one row in the table `EFFECTS` of this package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

if TYPE_CHECKING:
    from ..motor import Motor

Scalars = Float[Array | np.ndarray, "*#batch"]


class State(NamedTuple):
    """Armature current in A, shaft speed in rad/s, and the states that effects add, by name."""

    current: Scalars
    speed: Scalars
    extra: dict[str, Scalars]


class Grip(NamedTuple):
    """How much a dry element can hold: the torque in N m or voltage in V that opposes motion forward
    (positive speed or current) and backward, both >= 0. In between it takes whatever keeps the state at zero."""

    backward: Scalars
    forward: Scalars


class ParameterRange(NamedTuple):
    """Unit of an effect's parameter, and between which values a search may look for it.

    `scale` is "log" for a strictly positive parameter, "linear" for one of either sign.
    """

    unit: str
    lower: float
    upper: float
    scale: Literal["log", "linear"] = "log"


class AbstractEffect(eqx.Module):
    """A physical effect that the plain linear motor lacks. See the module for what may be overridden."""

    name: ClassVar[str]
    equation: ClassVar[Literal["electrical", "mechanical", "input", "sensor"]]
    ranges: ClassVar[dict[str, ParameterRange]]
    states: ClassVar[tuple[str, ...]] = ()
    # which state a dry element holds at zero
    holds: ClassVar[Literal["speed", "current"] | None] = None

    def terminal_voltage(self, voltage: Scalars) -> Scalars:
        """Voltage at the winding, V."""
        return voltage

    def parameters(self, motor: Motor, state: State) -> Motor:
        """The motor with R, L, Kb, Kt, J, f as they are at this state."""
        del state
        return motor

    def voltage_drop(self, state: State) -> Scalars | float:
        """Voltage lost in the armature circuit, V."""
        del state
        return 0.0

    def torque(self, state: State) -> Scalars | float:
        """Torque opposing positive motion, N m."""
        del state
        return 0.0

    def grip(self, state: State) -> Grip:
        """Limits of the dry element; needs `holds`."""
        raise NotImplementedError(f"{self.name} has no dry element")

    def derivative(self, motor: Motor, state: State) -> dict[str, Scalars]:
        """Rates of the effect's own states, per second."""
        del motor, state
        return {}

    def sensors(self, current: Scalars, speed: Scalars) -> tuple[Scalars, Scalars]:
        """Current in A and speed in rad/s as the sensors report them."""
        return current, speed
