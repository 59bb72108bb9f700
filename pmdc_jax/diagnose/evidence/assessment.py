"""Interpret the evidence against a model: is something missing, or may model-form error explain what is left?

*Model-form error* is what effects leave because their formulas are only approximately those of the real motor.
"""

from __future__ import annotations

from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ...effects import EFFECTS
from ...effects.base import AbstractEffect
from ..hypotheses.curves import Curve
from ..hypotheses.effect_relations import CONTAINS, FULLER, unbalanced_equation
from ..model import Model
from .signals import Screen, Signal

# False-alarm probability: that anything is called missing from a motor that lacks nothing, or, once effects were
# added, that anything more is in all later looks together
FALSE_ALARM = 0.01
# Model-form error: the largest share of the squares that effects explain which imperfect formulas of them may leave
MODEL_FORM_SHARE = 0.1
# The same if the rest is a curve over an effect's own variable
OWN_MODEL_FORM_SHARE = 0.5
# Viscous friction, over that of the motor without effects, that has all but vanished
VANISHED_VISCOUS_SHARE = 0.1
# Least share of the gain of the clearest signal with which a candidate is worth a trial
TRIAL_SHARE = 0.3
# Least share of the gain of the clearest signal with which a curve describes what is left
CURVE_SHARE = 0.5
# Least share of the gain of the clearest signal with which what is left is clearly a candidate's effect
EFFECT_SHARE = 0.7
# By simple effect, its fuller form if that has no regression column: only a refit can test it, such as backlash
REFIT_ONLY = {simple: f.effect for simple, f in FULLER.items() if f.effect not in CONTAINS}
# Share of the unfiltered squares up to which a ripple of the speed sensor hardly adds to its noise
SMALL_RIPPLE_SHARE = 0.05
# Largest difference of a number of periods from a multiple of another, over that one, of a harmonic
MAX_DETUNING = 0.05
# The clearest gain left, over what the effects explain, below which nothing more is worth a trial
NEGLIGIBLE = 2e-3
# The same below which no recording is exact enough to tell anything: a hundredth of the effects, as amplitudes
INEXACT = 1e-4
# The first for models whose fit is never exact because when teeth meet, or a rotor slips, is unpredictable
NEGLIGIBLE_INEXACT = 1e-2


class Assessment(NamedTuple):
    """The evidence against a model, and the decisions that depend on it."""

    screen: Screen
    candidate_signals: list[Signal]  # the most significant first
    curve_signals: list[Signal]  # the most significant first
    p_value: float  # of the evidence if nothing more were missing
    # squared white residuals of the motor without effects, less those of the model
    explained: float
    explained_unfiltered: float  # the same for the unfiltered misfit, `Fit.fitness`
    viscous_share: float = 1.0  # viscous friction over that of the motor without effects

    @property
    def clearest(self) -> Signal:
        """The signal with the largest gain."""
        return max((*self.candidate_signals, *self.curve_signals), key=attrgetter("gain"))

    @property
    def unexplained(self) -> float:
        """The gain of the clearest signal over what the model explains; infinite if it explains nothing."""
        return float(self.clearest.gain / self.explained) if self.explained > 0 else np.inf

    @property
    def best_candidate_share(self) -> float:
        """The largest gain of a single candidate over that of the clearest signal."""
        best = max((s.gain for s in self.candidate_signals), default=0.0)
        return float(best / self.clearest.gain) if best > 0 else 0.0

    def calls_for_effect(self) -> bool:
        """Whether something more is missing, and a single candidate would explain enough of it for a trial."""
        return bool(self.p_value < FALSE_ALARM and self.best_candidate_share > TRIAL_SHARE)

    def is_clearly_effect(self) -> bool:
        """Whether what is left is clearly one more effect rather than model-form error.

        Never a periodic effect: gear teeth that meet at unpredictable times may look like one.
        """
        if (
            not self.candidate_signals
            or self.unexplained < MODEL_FORM_SHARE
            or self.best_candidate_share < EFFECT_SHARE
        ):
            return False
        best = max(self.candidate_signals, key=attrgetter("gain")).candidate
        return best is not None and not best.own_phase

    def exceeds_model_form_error(self, model: Model) -> bool:
        """Whether a model leaves too much for model-form error, and that is not due to an effect it already has."""
        return bool(self.unexplained > MODEL_FORM_SHARE and not self._belongs_to(model))

    def may_be_model_form_error(self, model: Model) -> bool:
        """Whether what is left may be model-form error of the model's effects.

        Not if it is a larger part of the unfiltered misfit than they explain: the whitening filter has then absorbed
        what is missing as noise. Nor if viscous friction had to be negative for them to explain it.
        """
        if not model.effects or self._unexplained_unfiltered(model) > 1 or self._calls_for_negative_friction(model):
            return False
        if self.unexplained < MODEL_FORM_SHARE:
            return True
        clearest = self.clearest.term
        own_curve = isinstance(clearest, Curve) and has_axes_of(model, clearest)
        within = self.unexplained < OWN_MODEL_FORM_SHARE
        return self._belongs_to(model) or bool(own_curve and within)

    def _calls_for_negative_friction(self, model: Model) -> bool:
        """Whether a torque over speed is left and viscous friction is next to zero, its bound, or all but vanished and
        the torque is too large for model-form error: the model's effects then depend on the speed in another way than
        what is missing."""
        clearest = self.clearest.term
        over_speed = isinstance(clearest, Curve) and (clearest.equation, clearest.variable) == ("mechanical", "speed")
        vanished = self.viscous_share < VANISHED_VISCOUS_SHARE and self.unexplained > MODEL_FORM_SHARE
        return over_speed and (vanished or "f" in model.at_bound | model.undetermined)

    def is_sensor_error(self) -> bool:
        """Whether the clearest signal is an error of a sensor that no effect of the library has."""
        clearest = self.clearest.term
        return isinstance(clearest, Curve) and clearest.is_sensor_error

    def is_small_ripple(self) -> bool:
        """Whether the clearest signal is a ripple of the speed sensor that is far below its noise."""
        clearest = self.clearest.term
        is_ripple = isinstance(clearest, Curve) and clearest.is_sensor_ripple
        return is_ripple and self._unfiltered_share() < SMALL_RIPPLE_SHARE

    def unfiltered_signals(self) -> list[Signal]:
        """The candidates' signals with their gains on the unfiltered residuals."""
        unfiltered = self.screen.unfiltered
        before = unfiltered.regress().squares
        return [s._replace(gain=before - unfiltered.regress([s.block]).squares) for s in self.candidate_signals]

    def _unexplained_unfiltered(self, model: Model) -> float:
        """`unexplained` for the unfiltered misfit: what the clearest signal would explain, over what the model does."""
        if not self.explained_unfiltered > 0:
            return np.inf
        return self._unfiltered_share() * model.fit.fitness / self.explained_unfiltered

    def leaves_unfiltered_misfit(self, model: Model) -> bool:
        """Whether a model leaves more of the unfiltered misfit, noise apart, than formulas of its effects that are only
        approximately right would."""
        left = model.fit.fitness - model.problem.perfect_fitness
        return bool(left > MODEL_FORM_SHARE * self.explained_unfiltered)

    def _unfiltered_share(self) -> float:
        """The share of the unfiltered squares that the clearest signal explains."""
        unfiltered = self.screen.unfiltered
        return float(1 - unfiltered.regress([self.clearest.block]).squares / unfiltered.regress().squares)

    def _belongs_to(self, model: Model) -> bool:
        """Whether the clearest signal belongs to an effect that the model has."""
        clearest = self.clearest.candidate
        return clearest is not None and clearest.effect in model.effects

    def is_harmonic_of(self, model: Model) -> bool:
        """Whether what is left is most like a harmonic of an effect of the rotor's angle that the model has."""
        clearest = self.clearest.candidate
        if clearest is None or not clearest.own_phase:
            return False
        angle = 2 * np.pi / clearest.columns[0]["periods"]
        ratios = [
            float(effect.repeats_after()["angle"]) / angle
            for effect in model.motor.effects
            if effect.name == clearest.effect
        ]
        return any(r > 1.5 and abs(r - round(r)) < MAX_DETUNING for r in ratios)

    def is_negligible(self, model: Model) -> bool:
        """Whether too little is left for another trial (`NEGLIGIBLE`)."""
        is_inexact = _has_refit_only(model) or model.is_stalled
        return self.unexplained < (NEGLIGIBLE_INEXACT if is_inexact else NEGLIGIBLE)

    def is_unrelated_to(self, model: Model) -> bool:
        """Whether what is left is clearly one more effect, in another equation or over another variable than any of the
        model's, so that these cannot have left it.

        Never beside a refit-only form: what gear teeth leave, which meet at unpredictable times, can look like any
        effect; nor a torque where a rotor slips at unpredictable times; nor if so little is left (`INEXACT`).
        """
        if _has_refit_only(model) or self.p_value >= FALSE_ALARM or self.best_candidate_share < EFFECT_SHARE:
            return False
        if self.unexplained < INEXACT:
            return False
        best_curve = max(self.curve_signals, key=attrgetter("gain"))
        best = max(self.candidate_signals, key=attrgetter("gain")).candidate
        assert isinstance(best_curve.term, Curve) and best is not None
        if model.is_stalled and EFFECTS[best.effect].equation == "mechanical":
            return False
        # of model-form error a curve over the effect's own variable explains nearly all
        own_curve = has_axes_of(model, best_curve.term) and best_curve.gain > CURVE_SHARE * self.clearest.gain
        return not (own_curve or has_axes_of(model, EFFECTS[best.effect]))


def _has_refit_only(model: Model) -> bool:
    """Whether one of the model's effects is a refit-only form (`REFIT_ONLY`)."""
    return bool(set(model.effects) & set(REFIT_ONLY.values()))


def has_axes_of(model: Model, term: Curve | type[AbstractEffect]) -> bool:
    """Whether a curve or an effect has the same equation and variable as one of the model's effects."""
    return term.variable is not None and _axes(term) in {_axes(EFFECTS[e]) for e in model.effects}


def _axes(term: Curve | type[AbstractEffect]) -> tuple[str, str | None]:
    """The equation in which a term shows, and the variable that it depends on."""
    return unbalanced_equation(term.equation), term.variable
