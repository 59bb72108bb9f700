"""The brushed permanent-magnet DC motor: equations (1) to (9) of the wheelchair-motor paper."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects.base import AbstractEffect, Grip, Scalars, State

PARAMETERS = {"R": "ohm", "L": "H", "Kb": "V s/rad", "Kt": "N m/A", "J": "kg m^2", "f": "N m s/rad"}


class Drive(NamedTuple):
    """What drives the motor over one sample: one of `voltage`, `current` and `torque` is 1, the others are 0.

    A voltage drives the whole motor; a current or torque drives the mechanical half only, and the electrical
    equation is switched off. `free` is 1, or 0 for a held rotor, which switches off the mechanical equation.
    """

    voltage: Scalars | float = 1.0
    current: Scalars | float = 0.0
    torque: Scalars | float = 0.0
    free: Scalars | float = 1.0


DriveName = Literal["voltage", "current", "torque", "held"]
# By the input that drives a motor, or for a locked rotor, the parameters that its simulation depends on
PARAMETERS_OF_DRIVE: dict[DriveName, tuple[str, ...]] = {
    "voltage": tuple(PARAMETERS),
    "current": ("Kt", "J", "f"),
    "torque": ("J", "f"),
    "held": ("R", "L"),
}


class Motor(eqx.Module):
    """Brushed permanent-magnet DC motor.

    L di/dt = v - R i - Kb w                     (1), (3), (5)
    J dw/dt = Kt i - f w - T_load                (2), (4), (6)

    and what the effects add to either. All fields are scalars, or arrays of one shape for a population.

    **Fields**: `R` armature resistance, ohm; `L` armature inductance, H; `Kb` back-EMF constant, V s/rad;
    `Kt` torque constant, N m/A; `J` inertia of rotor and what turns with it, kg m^2; `f` viscous friction,
    N m s/rad; all > 0 (f >= 0). `effects`, a tuple of `pmdc_jax.effects.AbstractEffect`.

    **Source**: "Parameter estimation and speed control of a PMDC motor used in wheelchair", PECCON 2017. Its
    equation (8) prints +R/L and multiplies the load column by u; here it follows from (5) and (6).
    """

    R: Scalars
    L: Scalars
    Kb: Scalars
    Kt: Scalars
    J: Scalars
    f: Scalars
    effects: tuple[AbstractEffect, ...] = ()

    def state_space(self, drive: Drive | None = None) -> tuple[Float[Array, "2 2 *batch"], Float[Array, "2 2 *batch"]]:
        """Matrices A, B of dx/dt = A x + B u for the linear motor, equations (7) and (8).

        x = (current, speed), u = (driving value, load torque). `drive` says whether voltage (the default), current or
        torque is given; for the latter two the current is not a state and its row is zero. The row of the speed is
        zero if the rotor is held.
        """
        v, c, t, free = drive or Drive()
        zero, inverse_inertia = jnp.zeros_like(self.R), free / self.J
        A = [[-v * self.R / self.L, -v * self.Kb / self.L], [v * self.Kt * inverse_inertia, -self.f * inverse_inertia]]
        B = [[v / self.L, zero], [(c * self.Kt + t) * inverse_inertia, -inverse_inertia]]
        return _matrix(A), _matrix(B)

    def transfer_function(self) -> tuple[dict[str, Float[Array, "order *batch"]], Float[Array, "3 *batch"]]:
        """Numerators by "input -> output" and the common denominator, highest power of s first; equation (9).

        voltage -> speed is Kt / (L J s^2 + (R J + L f) s + R f + Kt Kb).
        """
        R, L, Kb, Kt, J, f = self.R, self.L, self.Kb, self.Kt, self.J, self.f
        numerators = {
            "voltage -> speed": jnp.stack([Kt]),
            "voltage -> current": jnp.stack([J, f]),
            "load -> speed": jnp.stack([-L, -R]),
            "load -> current": jnp.stack([Kb]),
        }
        return numerators, jnp.stack([L * J, R * J + L * f, R * f + Kt * Kb])

    def steady_speed(self, voltage: Scalars | float, load: Scalars | float = 0.0) -> Scalars:
        """Speed, rad/s, at a constant voltage (V) and load (N m): w = (Kt v - R T) / (R f + Kt Kb), without effects."""
        return (self.Kt * voltage - self.R * load) / (self.R * self.f + self.Kt * self.Kb)

    def steady_current(self, speed: Scalars, load: Scalars | float = 0.0) -> Scalars:
        """Current, A, at a constant speed (rad/s) against a load (N m): i = (f w + T) / Kt, without effects."""
        return (self.f * speed + load) / self.Kt

    @property
    def transient_time(self) -> Scalars:
        """The electrical and the electromechanical time constant together, s: L / R + J R / (Kt Kb)."""
        return self.L / self.R + self.J * self.R / (self.Kt * self.Kb)

    @property
    def oscillation_time(self) -> Scalars:
        """Inverse of the undamped natural frequency, s: the root of L J / (Kt Kb)."""
        return jnp.sqrt(self.L * self.J / (self.Kt * self.Kb))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states that the effects add."""
        return tuple(sorted({name for effect in self.effects for name in effect.states}))

    @property
    def affine(self) -> bool:
        """Whether this is a linear system with inputs, as long as no dry element changes direction and no teeth touch
        or part."""
        return all(effect.affine for effect in self.effects)

    @property
    def switches(self) -> bool:
        """Whether there are dry elements, or teeth that touch and part."""
        return any(effect.holds or effect.contact_state for effect in self.effects)

    @property
    def gear(self) -> AbstractEffect | None:
        """The effect with teeth, if there is one."""
        return next((effect for effect in self.effects if effect.contact_state), None)

    def effect_named(self, name: str) -> AbstractEffect:
        """The effect of this name, which the motor must have."""
        return next(effect for effect in self.effects if effect.name == name)

    def with_effects(self, effects: Iterable[AbstractEffect]) -> Motor:
        """The same motor with these effects in place of its own."""
        return eqx.tree_at(lambda motor: motor.effects, self, tuple(effects))

    def initial_state(
        self, current: Scalars, speed: Scalars, load: Scalars | float = 0.0, angle: Scalars | float = 0.0
    ) -> State:
        """State at the start of a run with this current (A), speed (rad/s), load (N m) and rotor angle (rad).

        The effects' states follow from speed, load and angle.
        """
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in (current, speed, load, angle, self.R)))
        current, speed, load, angle = (jnp.zeros(shape) + x for x in (current, speed, load, angle))
        load, extra = self._whole_load(load), {}
        for effect in self.effects:
            extra |= effect.initial_states(speed, load, angle)
        return State(current, speed, extra)

    def at(self, state: State) -> Motor:
        """The motor with its parameters as modified by the effects at this state."""
        return reduce(lambda motor, effect: effect.parameters(motor, state), self.effects, self)

    def derivative(
        self,
        state: State,
        value: Scalars,
        load: Scalars,
        drive: Drive | None = None,
        moving: tuple[Scalars, Scalars] | None = None,
    ) -> State:
        """Time derivative of the state.

        **Arguments**: `value`, the voltage in V, current in A or torque in N m that drives the motor, according to
        `drive`; `load`, N m, opposes positive motion; `moving`, the directions (-1, 0, 1) of current and speed that
        the dry elements oppose, by default those of the state.
        """
        v, c, t, free = drive or Drive()
        state = state._replace(current=v * state.current + c * value)
        direction_i, direction_w = moving or (jnp.sign(state.current), jnp.sign(state.speed))
        load = self._whole_load(load)
        motor, voltage, torque = self.at(state), value, load
        drop = _opposing(self.grip("current", state), direction_i)
        extra = {}
        for effect in self.effects:
            voltage = effect.terminal_voltage(voltage)
            drop = drop + effect.voltage_drop(state)
            torque = effect.load_at_rotor(torque)
            extra |= effect.derivative(motor, state, load)
        torque = torque + _opposing(self.grip("speed", state), direction_w)
        for effect in self.effects:
            torque = torque + effect.torque(state)
        # times reciprocals, which XLA moves out of the loop over samples; a division would break the loop's fusion
        armature = voltage - motor.R * state.current - motor.Kb * state.speed - drop
        current_rate = v * armature * (1 / motor.L)
        driving = motor.Kt * state.current + t * value
        speed_rate = free * (driving - motor.f * state.speed - torque) * (1 / motor.J)
        return State(current_rate, speed_rate, extra)

    def _whole_load(self, load: Scalars) -> Scalars:
        return reduce(lambda load, effect: effect.load_torque(load), self.effects, load)

    def grip(self, holds: str, state: State) -> Grip | None:
        """Combined limits of all dry elements on "current" (V) or "speed" (N m); None without any."""
        grips = [effect.grip(state) for effect in self.effects if effect.holds == holds]
        if not grips:
            return None
        return reduce(lambda a, b: Grip(a.backward + b.backward, a.forward + b.forward), grips)

    def sensors(self, state: State) -> tuple[Scalars, Scalars]:
        """Current in A and speed in rad/s as the sensors report them, apart from a delay."""
        current, speed = state.current, state.speed
        for effect in self.effects:
            current, speed = effect.sensors(state, current, speed)
        return current, speed

    def speed_delay(self) -> Scalars | None:
        """Delay of the reported speed in s; None without one."""
        delays = [delay for effect in self.effects if (delay := effect.speed_delay()) is not None]
        return reduce(jnp.add, delays) if delays else None


def _opposing(grip: Grip | None, direction: Scalars) -> Scalars | float:
    if grip is None:
        return 0.0
    return jnp.where(direction > 0, grip.forward, jnp.where(direction < 0, -grip.backward, 0.0))


def _matrix(rows: list[list[Scalars]]) -> Float[Array, "2 2 *batch"]:
    entries = jnp.broadcast_arrays(*(entry for row in rows for entry in row))
    return jnp.stack(entries).reshape(2, 2, *entries[0].shape)
