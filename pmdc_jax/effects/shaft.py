"""A load that hangs on the rotor by an elastic shaft, with or without play."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars, State

if TYPE_CHECKING:
    from ..motor import Motor


def _rotor(motor: Motor, share: Scalars) -> Motor:
    """The motor with the inertia that is left on its own side of the shaft."""
    return eqx.tree_at(lambda m: m.J, motor, motor.J * (1 - share))


def _load_acceleration(rotor: Motor, share: Scalars, torque: Scalars) -> Scalars:
    """rad/s^2 of the inertia behind the shaft under a torque."""
    return torque * (1 / rotor.J) * (1 / share - 1)


class ShaftCompliance(AbstractEffect):
    """Compliant shaft: the load torque acts on an inertia s J behind a spring and damper.

    (1 - s) J dw/dt = Kt i - f w - T_s,  s J dw_L/dt = T_s - T_load,
    d twist/dt = w - w_L,  T_s = stiffness twist + damping (w - w_L).

    A run begins with both ends at one speed and the shaft twisted by the load.

    **Fields**: `stiffness_Nm_rad` in N m/rad, > 0; `damping_Nms_rad` in N m s/rad, > 0; `load_share`, s, the share
    of the inertia behind the shaft, between 0 and 1.
    **Excitation needed**: steps fast enough to ring the shaft, sampled ten times a period.
    **Source**: Zhang, Furusho, "Speed control of two-inertia system by PI/PID control", IEEE Transactions on
    Industrial Electronics 47 (2000), doi:10.1109/41.847907.
    """

    name: ClassVar = "shaft_compliance"
    label: ClassVar = "Compliant shaft"
    formula: ClassVar = "T_s = k twist + d (w - w_L), s J dw_L/dt = T_s - T_load"
    equation: ClassVar = "mechanical"
    states: ClassVar = ("load_speed", "twist")
    affine: ClassVar = True
    ranges: ClassVar = {
        "stiffness_Nm_rad": ParameterRange("N m/rad", 1e-6, 1e9),
        "damping_Nms_rad": ParameterRange("N m s/rad", 1e-11, 1e6),
        "load_share": ParameterRange("", 1e-2, 0.99),
    }

    stiffness_Nm_rad: Scalars
    damping_Nms_rad: Scalars
    load_share: Scalars

    def shaft_torque(self, state: State) -> Scalars:
        slip = state.speed - state.extra["load_speed"]
        return self.stiffness_Nm_rad * state.extra["twist"] + self.damping_Nms_rad * slip

    def parameters(self, motor: Motor, state: State) -> Motor:
        del state
        return _rotor(motor, self.load_share)

    def torque(self, state: State) -> Scalars:
        return self.shaft_torque(state)

    def load_at_rotor(self, load: Scalars) -> Scalars:
        return 0.0 * load

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        net = self.shaft_torque(state) - load
        return {
            "load_speed": _load_acceleration(motor, self.load_share, net),
            "twist": state.speed - state.extra["load_speed"],
        }

    def rest(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del angle
        return {"load_speed": speed, "twist": load * (1 / self.stiffness_Nm_rad)}

    def linear(self) -> AbstractEffect:
        return self


class GearBacklash(AbstractEffect):
    """Backlash: a compliant shaft, or gear, that carries torque only once its play is taken up.

    As `shaft_compliance`, with T_s = stiffness bite + damping (w - w_L) while the teeth touch, where bite = twist
    -+ gap/2 is how far they are pressed together, and nothing inside the gap; teeth push and never pull. Without gap
    it is nearly a compliant shaft. A run begins with the teeth in contact on the side that the load presses them to,
    or in the middle without load.

    **Fields**: `gap_rad`, the whole play in rad, > 0, usually 0.001 to 0.1; `stiffness_Nm_rad` of the teeth in
    contact in N m/rad, > 0; `damping_Nms_rad` in N m s/rad, > 0; `load_share`, s, the share of the inertia behind the
    gear, between 0 and 1.
    **Excitation needed**: torque through zero again and again, at two amplitudes.
    **Source**: Nordin, Gutman, "Controlling mechanical systems with backlash: a survey", Automatica 38
    (2002), doi:10.1016/S0005-1098(02)00047-X, section 2.
    """

    name: ClassVar = "gear_backlash"
    label: ClassVar = "Gear backlash"
    formula: ClassVar = (
        "T_s = k bite + d (w - w_L) while the teeth touch, bite = |twist| - gap/2, else 0"
    )
    equation: ClassVar = "mechanical"
    states: ClassVar = ("gear_speed", "gear_twist")
    longest_step: ClassVar = 2.5e-4
    ranges: ClassVar = {
        "gap_rad": ParameterRange("rad", 1e-6, 1.0),
        "stiffness_Nm_rad": ParameterRange("N m/rad", 1e-6, 1e9),
        "damping_Nms_rad": ParameterRange("N m s/rad", 1e-11, 1e6),
        "load_share": ParameterRange("", 1e-2, 0.99),
    }

    gap_rad: Scalars
    stiffness_Nm_rad: Scalars
    damping_Nms_rad: Scalars
    load_share: Scalars

    def shaft_torque(self, state: State) -> Scalars:
        twist, slip = state.extra["gear_twist"], state.speed - state.extra["gear_speed"]
        play = self.gap_rad / 2
        spring, damper = self.stiffness_Nm_rad, self.damping_Nms_rad * slip
        forward = jnp.maximum(spring * (twist - play) + damper, 0.0)
        backward = jnp.minimum(spring * (twist + play) + damper, 0.0)
        return jnp.where(twist > play, forward, jnp.where(twist < -play, backward, 0.0))

    def parameters(self, motor: Motor, state: State) -> Motor:
        del state
        return _rotor(motor, self.load_share)

    def torque(self, state: State) -> Scalars:
        return self.shaft_torque(state)

    def load_at_rotor(self, load: Scalars) -> Scalars:
        return 0.0 * load

    def derivative(self, motor: Motor, state: State, load: Scalars) -> dict[str, Scalars]:
        net = self.shaft_torque(state) - load
        return {
            "gear_speed": _load_acceleration(motor, self.load_share, net),
            "gear_twist": state.speed - state.extra["gear_speed"],
        }

    def rest(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del angle
        twist = load * (1 / self.stiffness_Nm_rad) + jnp.sign(load) * self.gap_rad / 2
        return {"gear_speed": speed, "gear_twist": twist}

    def linear(self) -> AbstractEffect:
        """Without gap."""
        return eqx.tree_at(lambda e: e.gap_rad, self, 0.0 * self.gap_rad)
