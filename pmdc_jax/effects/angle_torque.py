"""Torque that changes with the angle of the rotor."""

# no deferred annotations: Equinox would take a deferred AbstractVar for a field
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .base import AbstractEffect, ParameterRange, Scalars, State
from .sine import cosine, sine

if TYPE_CHECKING:
    from ..motor import Motor


PHASE_RANGE = ParameterRange("rad", -4.0, 4.0, "linear")
PERIODS_RANGE = ParameterRange("", 0.5, 200.0)
# Half of the angle of a step, in rad of the wave, below which its mean is that of Simpson's rule to twelve digits
SMALL_TURN = 0.02


class _AngleWave(AbstractEffect):
    """An effect that is a wave over the rotor's angle, sin(n angle + phase); it adds the angle as a state."""

    variable: ClassVar = "angle"
    states: ClassVar = ("angle",)

    phase_rad: eqx.AbstractVar[Scalars]
    periods: eqx.AbstractVar[Scalars]

    def initial_states(self, speed: Scalars, load: Scalars, angle: Scalars) -> dict[str, Scalars]:
        del speed, load
        return {"angle": angle}

    def derivative(self, motor: "Motor", state: State, load: Scalars) -> dict[str, Scalars]:
        del motor, load
        return {"angle": state.speed}

    def repeats_after(self) -> dict[str, Scalars]:
        return {"angle": 2 * jnp.pi * (1 / self.periods)}

    def _wave(self, state: State) -> Scalars:
        """sin(n angle + phase)."""
        return sine(self.periods * state.extra["angle"] + self.phase_rad)

    def _averaging_factor(self, turn: Scalars) -> Scalars:
        """The factor with which Simpson's rule gives the exact mean of the wave over a `turn` in rad, for any number of
        periods: without it, a wave with whole periods within a step would be aliased to a slow one.

        **Source**: exponential fitting, Ixaru, Vanden Berghe, "Exponential Fitting" (2004), chapter 4.
        """
        half = self.periods * turn / 2
        small = jnp.abs(half) < SMALL_TURN
        size = jnp.where(small, 1.0, half)
        return jnp.where(small, 1 - half**4 / 180, 3 * sine(size) / (size * (2 + cosine(size))))


class CoggingTorque(_AngleWave):
    """Cogging: T = a sin(n angle + phase), the pull of the magnets on the teeth, independent of current.

    The angle is the recorded one if there is one. Otherwise it counts from the start of the first run, and the
    initial angle of every other run is an unknown.

    **Fields**: `amplitude_Nm`, a in N m, > 0, usually 1 to 10 % of the rated torque; `phase_rad` in rad;
    `periods`, n for one revolution, commonly the least common multiple of poles and slots.
    **Excitation needed**: slow motion over several periods, sampled ten times a period or more.
    **Source**: Hanselman, "Brushless Permanent Magnet Motor Design", 2nd edition, chapter 9.
    """

    name: ClassVar = "cogging_torque"
    label: ClassVar = "Cogging torque"
    formula: ClassVar = "T = a sin(n angle + phase)"
    equation: ClassVar = "mechanical"
    ranges: ClassVar = {
        "amplitude_Nm": ParameterRange("N m", 1e-10, 1e4),
        "phase_rad": PHASE_RANGE,
        "periods": PERIODS_RANGE,
    }

    amplitude_Nm: Scalars
    phase_rad: Scalars
    periods: Scalars

    def torque(self, state: State) -> Scalars:
        return self.amplitude_Nm * self._wave(state)

    def averaged_over_step(self, state: State, seconds: Scalars) -> AbstractEffect:
        return replace(self, amplitude_Nm=self.amplitude_Nm * self._averaging_factor(state.speed * seconds))


class TorqueRipple(_AngleWave):
    """Torque ripple: Kt (1 + a sin(n angle + phase)) in place of Kt, due to commutation and winding.

    The back-EMF has the same ripple, Kb (1 + e a sin(n angle + phase)), except for the share 1 - e that the brushes
    short-circuit, since it changes within a segment. The angle is as in `cogging_torque`.

    **Fields**: `amplitude`, a, dimensionless, > 0, usually 0.01 to 0.1; `phase_rad` in rad; `periods`, n for one
    revolution, commonly the number of commutator segments, or twice it; `emf_share`, e, between 0 and 1.
    **Excitation needed**: slow motion over several periods with a current that is not small.
    **Source**: Hanselman, "Brushless Permanent Magnet Motor Design", 2nd edition, chapter 9.
    """

    name: ClassVar = "torque_ripple"
    label: ClassVar = "Torque ripple"
    formula: ClassVar = "T_m = Kt i (1 + a sin(n angle + phase)), e = Kb w (1 + e_s a sin(n angle + phase))"
    equation: ClassVar = "mechanical"
    ranges: ClassVar = {
        "amplitude": ParameterRange("", 1e-5, 1.0),
        "phase_rad": PHASE_RANGE,
        "periods": PERIODS_RANGE,
        # beyond 0 and 1, because estimates scatter around them
        "emf_share": ParameterRange("", -0.5, 1.5, "linear"),
    }

    amplitude: Scalars
    phase_rad: Scalars
    periods: Scalars
    emf_share: Scalars

    def parameters(self, motor: "Motor", state: State) -> "Motor":
        ripple = self.amplitude * self._wave(state)
        constants = motor.Kt * (1 + ripple), motor.Kb * (1 + self.emf_share * ripple)
        return eqx.tree_at(lambda m: (m.Kt, m.Kb), motor, constants)

    def averaged_over_step(self, state: State, seconds: Scalars) -> AbstractEffect:
        return replace(self, amplitude=self.amplitude * self._averaging_factor(state.speed * seconds))
