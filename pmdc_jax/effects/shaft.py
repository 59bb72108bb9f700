"""A load that is coupled to the rotor by an elastic shaft, with or without play."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars, State, Teeth

if TYPE_CHECKING:
    from ..motor import Motor


class _TwoInertias(AbstractEffect):
    """A rotor and a load at the ends of a shaft; its `states` are the load's speed and the twist of the shaft."""

    equation: ClassVar = "mechanical"

    stiffness_Nm_rad: Scalars
    damping_Nms_rad: Scalars
    load_share: Scalars

    def slip(self, state: State) -> Scalars:
        """Speed of the rotor relative to the load, rad/s."""
        return state.speed - state.extra[self.states[0]]

    def parameters(self, motor: Motor, state: State) -> Motor:
        """The motor with only the inertia on its own side of the shaft."""
        del state
        return eqx.tree_at(lambda m: m.J, motor, motor.J * (1 - self.load_share))

    def load_at_rotor(self, load: Scalars) -> Scalars:
        return 0.0 * load

    def natural_frequency(self, motor: Motor) -> Scalars:
        """The frequency at which the ends would oscillate without damping, sqrt(k / (J s (1 - s))), rad/s."""
        return jnp.sqrt(self.stiffness_Nm_rad / (motor.J * self.load_share * (1 - self.load_share)))

    def damping_ratio(self, motor: Motor) -> Scalars:
        """Damping over critical damping, d / (2 sqrt(k J s (1 - s))): below 1 the ends oscillate against each other."""
        return self.damping_Nms_rad * self.natural_frequency(motor) / (2 * self.stiffness_Nm_rad)

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        speed, twist = self.states
        net = self.torque(state) - load
        return {speed: net * (1 / motor.J) * (1 / self.load_share - 1), twist: self.slip(state)}


class ShaftCompliance(_TwoInertias):
    """Compliant shaft: the load torque acts on an inertia s J behind a spring and damper.

    (1 - s) J dw/dt = Kt i - f w - T_s,  s J dw_L/dt = T_s - T_load,
    d twist/dt = w - w_L,  T_s = stiffness twist + damping (w - w_L).

    A run starts with both ends at one speed and a shaft twisted by the load; a fit estimates the initial twist.

    **Fields**: `stiffness_Nm_rad` in N m/rad, > 0; `damping_Nms_rad` in N m s/rad, > 0; `load_share`, s, the share
    of the inertia behind the shaft, between 0 and 1.
    **Excitation needed**: steps fast enough to excite the shaft's resonance, sampled ten times a period.
    **Source**: Zhang, Furusho, "Speed control of two-inertia system by PI/PID control", IEEE Transactions on
    Industrial Electronics 47 (2000), doi:10.1109/41.847907.
    """

    name: ClassVar = "shaft_compliance"
    label: ClassVar = "Compliant shaft"
    formula: ClassVar = "T_s = k twist + d (w - w_L), s J dw_L/dt = T_s - T_load"
    states: ClassVar = ("load_speed", "twist")
    spring_state: ClassVar = "twist"
    affine: ClassVar = True
    ranges: ClassVar = {
        "stiffness_Nm_rad": ParameterRange("N m/rad", 1e-6, 1e9),
        "damping_Nms_rad": ParameterRange("N m s/rad", 1e-11, 1e6),
        "load_share": ParameterRange("", 1e-2, 0.99, limit=1.0),
    }

    def torque(self, state: State) -> Scalars:
        return self.stiffness_Nm_rad * state.extra["twist"] + self.damping_Nms_rad * self.slip(state)

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del angle
        return {"load_speed": speed, "twist": load * (1 / self.stiffness_Nm_rad)}

    def linear(self) -> AbstractEffect:
        return self


class GearBacklash(_TwoInertias):
    """Backlash: a compliant shaft, or gear, that carries torque only once its play is taken up.

    As `shaft_compliance`, with T_s = stiffness overlap + damping (w - w_L) while the teeth touch, where overlap = twist
    -+ gap/2 is how far they are pressed together, and T_s = 0 inside the gap; teeth push and never pull. Without a gap
    it is nearly a compliant shaft. A run starts with the teeth in contact on the side to which the load presses them,
    or in the middle without load; a fit estimates each run's initial twist.

    **Fields**: `stiffness_Nm_rad` of the teeth in contact in N m/rad, > 0; `damping_Nms_rad` in N m s/rad, > 0;
    `load_share`, s, the share of the inertia behind the gear, between 0 and 1; `gap_rad`, the whole play in rad, > 0,
    usually 0.001 to 0.1 at the load, and the reduction ratio times that at the motor.
    **Excitation needed**: torque that passes through zero repeatedly, at two amplitudes.
    **Source**: Nordin, Gutman, "Controlling mechanical systems with backlash: a survey", Automatica 38
    (2002), doi:10.1016/S0005-1098(02)00047-X, section 2.
    """

    name: ClassVar = "gear_backlash"
    label: ClassVar = "Gear backlash"
    formula: ClassVar = "T_s = k overlap + d (w - w_L) while the teeth touch, overlap = |twist| - gap/2, else 0"
    states: ClassVar = ("gear_speed", "gear_twist")
    affine: ClassVar = True
    contact_state: ClassVar = "gear_twist"
    spring_state: ClassVar = "gear_twist"
    ranges: ClassVar = ShaftCompliance.ranges | {"gap_rad": ParameterRange("rad", 1e-6, 10.0)}

    gap_rad: Scalars

    def teeth(self, state: State, side: Scalars | None = None) -> Teeth:
        twist = state.extra["gear_twist"]
        side = jnp.where(twist < 0, -1.0, 1.0) if side is None else side
        overlap = side * twist - self.gap_rad / 2
        slip = self.damping_Nms_rad * (1 / self.stiffness_Nm_rad) * self.slip(state)
        return Teeth(side, overlap, overlap + side * slip)

    def torque(self, state: State) -> Scalars:
        teeth = self.teeth(state)
        return jnp.where(teeth.touch, teeth.side * self.stiffness_Nm_rad * teeth.compression, 0.0)

    def play(self) -> Scalars:
        return self.gap_rad

    def averaged_over_step(self, state: State, seconds: Scalars) -> AbstractEffect:
        """The effect as it stays until its teeth touch or part."""
        del seconds
        return self._fixed(self.gap_rad, self.teeth(state))

    def fastest_rate(self, motor: Motor, current: Scalars) -> Scalars:
        """The natural frequency of teeth in contact, rad/s: a step is then a third of the half period of a bounce."""
        del current
        return self.natural_frequency(motor)

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del angle
        twist = load * (1 / self.stiffness_Nm_rad) + jnp.sign(load) * self.gap_rad / 2
        return {"gear_speed": speed, "gear_twist": twist}

    def linear(self) -> AbstractEffect:
        """Without a gap, always in contact."""
        one = jnp.ones_like(self.gap_rad)
        return self._fixed(0.0 * one, Teeth(one, one, one))

    def without_contact(self) -> AbstractEffect:
        one = jnp.ones_like(self.gap_rad)
        return self._fixed(self.gap_rad, Teeth(one, -one, -one))

    def _fixed(self, gap_rad: Scalars, contact: Teeth) -> FixedTeeth:
        shaft = (self.stiffness_Nm_rad, self.damping_Nms_rad, self.load_share)
        return FixedTeeth(*shaft, gap_rad, contact)


class FixedTeeth(GearBacklash):
    """Backlash whose teeth stay in contact on one side, or stay apart, as in `contact`."""

    contact: Teeth

    def linear(self) -> AbstractEffect:
        return self

    def torque(self, state: State) -> Scalars:
        teeth = self.teeth(state, self.contact.side)
        push = teeth.side * self.stiffness_Nm_rad * teeth.compression
        return jnp.where(self.contact.touch, push, 0.0)
