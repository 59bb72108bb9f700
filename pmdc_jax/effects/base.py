"""What a physical effect may touch.

An effect is an Equinox module whose fields are its parameters. It plugs into the motor at named places,
each of which does nothing unless the effect overrides it:

- `is_possible`: what its parameters together may be
- `terminal_voltage`: the voltage that reaches the winding, V
- `parameters`: the motor's own parameters at a state, R(temperature), Kt(current), ...
- `voltage_drop` and `torque`: smooth terms of the electrical and the mechanical equation
- `load_torque` and `load_at_rotor`: the whole load, and what of it acts on the rotor itself
- `grip`: a dry, set-valued term that can hold a state at exactly zero (stiction, brush contact)
- `teeth` and `without_contact`: flanks that touch and part (a gear)
- `averaged_over_step`: how it acts on average over a step, or until something switches
- `states`, `initial_states` and `derivative`: states of its own, how they begin and how they move
- `repeats_after`: after how much of a state everything is as before
- `linear`: the linear effect that it is, or nearly is, whose states then join the exact step
- `fastest_rate`: how much faster it makes the motor
- `sensors`, `speed_delay` and `speed_before_sensor`: how current and speed are seen, and how the rotor turned

New effects are one class here and one row in the table `EFFECTS` of this package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

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


class Teeth(NamedTuple):
    """Two flanks that touch, or do not: on which side (+-1), how far in rad they overlap, and the compression in rad by
    which they would pass their torque, damping included, if they stuck together. They push and never pull."""

    side: Scalars
    overlap: Scalars
    compression: Scalars

    @property
    def touch(self) -> Bool[Array | np.ndarray, "*#batch"]:
        return (self.overlap > 0) & (self.compression > 0)


class ParameterRange(NamedTuple):
    """Unit of an effect's parameter, and between which values a search may look for it.

    `scale` is "log" for a strictly positive parameter, "linear" for one of either sign. A plain number has
    the unit "".
    """

    unit: str
    lower: float
    upper: float
    scale: Literal["log", "linear"] = "log"


class AbstractEffect(eqx.Module):
    """A physical effect that the plain linear motor lacks. See the module for what may be overridden."""

    name: ClassVar[str]
    # in plain English, and as one line of mathematics in the symbols of the motor, for reports
    label: ClassVar[str]
    formula: ClassVar[str]
    equation: ClassVar[Literal["electrical", "mechanical", "input", "sensor"]]
    ranges: ClassVar[dict[str, ParameterRange]]
    states: ClassVar[tuple[str, ...]] = ()
    # the variable that its term is a curve over, where it is one
    variable: ClassVar[Literal["speed", "current", "voltage", "angle"] | None] = None
    # its size is in amperes, and says something only where the current was measured
    needs_current: ClassVar[bool] = False
    # which state a dry element holds at zero
    holds: ClassVar[Literal["speed", "current"] | None] = None
    # the state by which its teeth come to touch and part
    contact_state: ClassVar[str | None] = None
    # the state of a spring, which a run may begin with wound up in any way
    spring_state: ClassVar[str | None] = None
    # with it the motor is still a linear system with inputs, as long as no dry element changes direction and no teeth
    # come to touch or part
    affine: ClassVar[bool] = False
    # the longest step in s that follows the effect well, or finds the changes of direction
    longest_step: ClassVar[float] = 1e-3

    def is_possible(self) -> bool:
        """Whether nature allows its parameters together; each for itself is within its range."""
        return True

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

    def load_torque(self, load: Scalars) -> Scalars:
        """The whole load torque, N m, where `load` was recorded."""
        return load

    def load_at_rotor(self, load: Scalars) -> Scalars:
        """The load torque as it acts on the rotor, N m."""
        return load

    def grip(self, state: State) -> Grip:
        """Limits of the dry element; needs `holds`."""
        raise NotImplementedError(f"{self.name} has no dry element")

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        """The effect's own states where a run begins with this speed (rad/s), load (N m) and angle (rad)."""
        del load, angle
        return dict.fromkeys(self.states, 0.0 * speed)

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        """Rates of the effect's own states, per second; `motor` with its parameters at this state."""
        del motor, state, load
        return {}

    def repeats_after(self) -> dict[str, Scalars]:
        """By how much a state of its own can differ and all else goes on alike."""
        return {}

    def linear(self) -> AbstractEffect | None:
        """An effect with the same states and only linear terms, near enough to step stiff ones by."""
        return None

    def teeth(self, state: State, side: Scalars | None = None) -> Teeth:
        """How its teeth stand, on the side where they are nearer or the one given; needs `contact_state`."""
        raise NotImplementedError(f"{self.name} has no teeth")

    def play(self) -> Scalars | float:
        """By how much its teeth can be apart, rad."""
        return 0.0

    def averaged_over_step(self, state: State, seconds: Scalars) -> AbstractEffect:
        """The effect as it acts throughout a step of so many seconds that begins with this state."""
        del state, seconds
        return self

    def without_contact(self) -> AbstractEffect:
        """The effect while its teeth do not touch."""
        return self

    def fastest_rate(self, motor: Motor, current: Scalars) -> Scalars | None:
        """How much faster, in 1/s, the motor becomes at a current in A; None where `longest_step` is always enough."""
        del motor, current
        return None

    def sensors(self, state: State, current: Scalars, speed: Scalars) -> tuple[Scalars, Scalars]:
        """Current in A and speed in rad/s as the sensors report them."""
        del state
        return current, speed

    def speed_delay(self) -> Scalars | None:
        """By how many seconds the reported speed is late; None for not at all."""
        return None

    def speed_before_sensor(
        self, reported: Float[np.ndarray, " samples"], time: Float[np.ndarray, " samples"]
    ) -> Float[np.ndarray, " samples"]:
        """The speed of the rotor, rad/s, from what the sensor reported of it, free of noise, at each time in s."""
        del time
        return reported
