"""The base class of physical effects, and what they may override.

An effect is an Equinox module whose fields are its parameters. It acts on the motor through these methods and
attributes, each of which does nothing unless the effect overrides it:

- `is_possible`: constraints between its parameters
- `terminal_voltage`: the voltage that reaches the winding, V
- `parameters`: the motor's own parameters at a state, R(temperature), Kt(current), ...
- `voltage_drop` and `torque`: smooth terms of the electrical and the mechanical equation
- `load_torque` and `load_at_rotor`: the whole load, and the part of it that acts on the rotor itself
- `grip`: a dry, set-valued term that can hold a state at exactly zero (stiction, brush contact)
- `teeth`, `play` and `without_contact`: flanks that touch and part (a gear)
- `averaged_over_step`: the effect as it acts on average over a step, or until something switches
- `states`, `initial_states` and `derivative`: states of its own, their initial values and derivatives
- `repeats_after`: periods of its own states
- `linear`: the linear effect that it is, or is close to, whose states then join the exact step
- `longer_step` and `fastest_rate`: how long a step may be for one motor, and the fastest rate that it adds to it
- `sensors`, `speed_delay` and `speed_before_sensor`: reported current and speed, and the speed behind a report

A new effect is one class in this package, one row in its table `EFFECTS` and one in that of
`diagnose/hypotheses/trials.py`. Its class attributes say what kind of effect it is: whether it is `affine` and its
`longest_step` decide how fast it is simulated; `holds`, `contact_state`, `spring_state` and `thermal_state` belong to
dry elements, teeth, springs and temperatures; the `variable` of which it is a function, and whether it `needs_current`,
decide which runs can show it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

if TYPE_CHECKING:
    from ..motor import Motor

Scalars = Float[Array | np.ndarray, "*#batch"]

# The step in s that resolves most effects in any motor
LONGEST_STEP = 1e-3


class State(NamedTuple):
    """Armature current in A, shaft speed in rad/s, and the states that effects add, by name."""

    current: Scalars
    speed: Scalars
    extra: dict[str, Scalars]


class Grip(NamedTuple):
    """Limits of a dry element: the torque in N m or voltage in V that opposes forward motion (positive speed or
    current) and backward motion, both >= 0. At rest it takes the value in between that keeps the state at zero."""

    backward: Scalars
    forward: Scalars


class Teeth(NamedTuple):
    """Two flanks that may touch: the side (+-1), their overlap in rad, and the compression in rad that gives the torque
    on contact, damping included. They push and never pull, so they touch only while both are positive."""

    side: Scalars
    overlap: Scalars
    compression: Scalars

    @property
    def touch(self) -> Bool[Array | np.ndarray, "*#batch"]:
        return (self.overlap > 0) & (self.compression > 0)


class ParameterRange(NamedTuple):
    """Unit of an effect's parameter, and bounds for a search.

    `scale` is "log" for a strictly positive parameter, "linear" for one of either sign. A dimensionless parameter has
    the unit "". From `limit` on, which the bounds keep away from, values are impossible.
    """

    unit: str
    lower: float
    upper: float
    scale: Literal["log", "linear"] = "log"
    limit: float = np.inf


class AbstractEffect(eqx.Module):
    """A physical effect that the plain linear motor lacks. See the module for what may be overridden."""

    name: ClassVar[str]
    # for reports: the name in plain English, and the equation in the symbols of the motor
    label: ClassVar[str]
    formula: ClassVar[str]
    equation: ClassVar[Literal["electrical", "mechanical", "input", "sensor"]]
    ranges: ClassVar[dict[str, ParameterRange]]
    states: ClassVar[tuple[str, ...]] = ()
    # the variable of which its term is a function, if it is one variable
    variable: ClassVar[Literal["speed", "current", "voltage", "angle"] | None] = None
    # its parameters depend on the scale of the current, so they mean something only if the current was measured
    needs_current: ClassVar[bool] = False
    # which state a dry element holds at zero
    holds: ClassVar[Literal["speed", "current"] | None] = None
    # the state that decides whether its teeth touch
    contact_state: ClassVar[str | None] = None
    # the state of a spring, which may have any twist at the start of a run
    spring_state: ClassVar[str | None] = None
    # the state of a temperature, which a run may begin with where another one left it
    thermal_state: ClassVar[str | None] = None
    # with it the motor is still a linear system with inputs, as long as no dry element changes direction and no teeth
    # touch or part
    affine: ClassVar[bool] = False
    # the longest step in s that resolves the effect, or its changes of direction, in any motor
    longest_step: ClassVar[float] = LONGEST_STEP

    def is_possible(self) -> bool:
        """Whether the combination of its parameters is plausible; each by itself is within its range."""
        return True

    def terminal_voltage(self, voltage: Scalars) -> Scalars:
        """Voltage at the winding, V."""
        return voltage

    def parameters(self, motor: Motor, state: State) -> Motor:
        """The motor with the values of R, L, Kb, Kt, J, f at this state."""
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
        """The whole load torque, N m, if `load` was recorded."""
        return load

    def load_at_rotor(self, load: Scalars) -> Scalars:
        """The load torque that acts on the rotor itself, N m."""
        return load

    def grip(self, state: State) -> Grip:
        """Limits of the dry element; needs `holds`."""
        raise NotImplementedError(f"{self.name} has no dry element")

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        """The effect's own states at the start of a run with this speed (rad/s), load (N m) and angle (rad)."""
        del load, angle
        return dict.fromkeys(self.states, 0.0 * speed)

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        """Time derivatives of the effect's own states; `motor` has its parameters at this state."""
        del motor, state, load
        return {}

    def repeats_after(self) -> dict[str, Scalars]:
        """Periods of its own states: a shift of a state by its period changes nothing else."""
        return {}

    def linear(self) -> AbstractEffect | None:
        """An effect with the same states and only linear terms, close enough for the exact step to handle stiffness."""
        return None

    def teeth(self, state: State, side: Scalars | None = None) -> Teeth:
        """Contact of its teeth, on the given side or else on the nearer one; needs `contact_state`."""
        raise NotImplementedError(f"{self.name} has no teeth")

    def play(self) -> Scalars | float:
        """The whole play between its teeth, rad."""
        return 0.0

    def averaged_over_step(self, state: State, seconds: Scalars) -> AbstractEffect:
        """The effect as it acts throughout a step of this length, s, that starts from this state."""
        del state, seconds
        return self

    def without_contact(self) -> AbstractEffect:
        """The effect while its teeth do not touch."""
        return self

    def longer_step(self, motor: Motor) -> Scalars | None:
        """The longest step in s that resolves it in this motor, if that may be longer than `longest_step`."""
        del motor
        return None

    def fastest_rate(self, motor: Motor, current: Scalars) -> Scalars | None:
        """The fastest rate, 1/s, that it adds to the motor at a current in A; None if `longest_step` suffices."""
        del motor, current
        return None

    def sensors(self, state: State, current: Scalars, speed: Scalars) -> tuple[Scalars, Scalars]:
        """Current in A and speed in rad/s as the sensors report them."""
        del state
        return current, speed

    def speed_delay(self) -> Scalars | None:
        """Delay of the reported speed in s; None without one."""
        return None

    def speed_before_sensor(
        self, reported: Float[np.ndarray, " samples"], time: Float[np.ndarray, " samples"]
    ) -> Float[np.ndarray, " samples"]:
        """The speed of the rotor, rad/s, from the sensor's reports without noise, at each time in s."""
        del time
        return reported
