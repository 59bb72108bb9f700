"""How the evidence against a model is read: is something missing, or may model-form error explain what is left?

*Model-form error* is what effects leave because their formulas are only approximately those of the real motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..effects import EFFECTS
from ..effects.base import AbstractEffect
from .effect_relations import CONTAINS, FULLER, unbalances
from .library import Curve
from .model import Model
from .signals import Screen, Signal

# False-alarm probability: that anything is called missing from a motor that lacks nothing, or, once effects were
# added, that anything more is in all later looks together
ALARM = 0.01
# Model-form error: the share of the squares explained by effects that imperfect formulas of them may leave; the larger
# one if the rest is a curve over an effect's own variable
FORMULA, OWN_FORMULA = 0.1, 0.5
# Gain of a candidate or curve over that of the clearest signal: from the first share on a candidate is worth a trial,
# from the second on a curve describes what is left, from the third on what is left is clearly a candidate's effect
MUCH_OF_IT, HALF_OF_IT, MOST_OF_IT = 0.3, 0.5, 0.7
# Harder forms (fuller ones without a regression column) by the simple form, in whose place they are tried
HARDER = {simple: f.effect for simple, f in FULLER.items() if f.effect not in CONTAINS}
# The clearest gain left, over what the effects explain, below which nothing more is worth a trial; the larger one with
# harder forms, whose fit is never exact because when teeth meet is down to chance
TRACE, TRACE_OF_HARDER = 2e-3, 1e-2


def chance_of_nothing(
    of_candidates: Sequence[Signal], of_curves: Sequence[Signal], count: int
) -> float:
    """P-value of the strongest evidence if nothing were missing: Bonferroni-corrected for `count` blocks."""
    smallest = min(s.log_p for s in (*of_candidates, *of_curves))
    return float(min(1.0, np.exp(smallest + np.log(count))))


class Assessment(NamedTuple):
    """The evidence against a model, with the questions that are asked of it."""

    screen: Screen
    of_candidates: list[Signal]  # the most significant first
    of_curves: list[Signal]  # the most significant first
    p_value: float  # of it if nothing more were missing
    # squared white residuals of the motor without effects, less those of the model
    explained: float
    removed: float  # the same of the unfiltered misfit, `Fit.fitness`

    @property
    def clearest(self) -> Signal:
        """The signal with the largest gain."""
        return max((*self.of_candidates, *self.of_curves), key=_gain)

    @property
    def unexplained(self) -> float:
        """The gain of the clearest signal over what the model explains; infinite if it explains nothing."""
        return float(self.clearest.gain / self.explained) if self.explained > 0 else np.inf

    @property
    def by_one_more(self) -> float:
        """The largest gain of a single candidate over that of the clearest signal."""
        best = max((s.gain for s in self.of_candidates), default=0.0)
        return float(best / self.clearest.gain)

    def asks_for_more(self) -> bool:
        """Whether more is missing, and a single candidate would explain much of it."""
        return bool(self.p_value < ALARM and self.by_one_more > MUCH_OF_IT)

    def is_another(self) -> bool:
        """Whether what is left is clearly one more effect, and no model-form error.

        Never a periodic effect: gear teeth that meet at unpredictable times may look like one.
        """
        if not self.of_candidates or self.unexplained < FORMULA or self.by_one_more < MOST_OF_IT:
            return False
        best = max(self.of_candidates, key=_gain).candidate
        return best is not None and not best.own_phase

    def is_clear(self, model: Model) -> bool:
        """Whether what a model leaves is too much for model-form error, and not of an effect that it has already."""
        return bool(self.unexplained > FORMULA and not self._is_more_of(model))

    def is_formula(self, model: Model) -> bool:
        """Whether what is left may be model-form error of the model's effects.

        Not where it is more of the unfiltered misfit than they explain: then the whitening filter took what is missing
        for noise.
        """
        if not model.effects or self._unexplained_plainly(model) > 1:
            return False
        if self.unexplained < FORMULA:
            return True
        clearest = self.clearest.of
        own = isinstance(clearest, Curve) and _is_own(clearest, model)
        return self._is_more_of(model) or bool(own and self.unexplained < OWN_FORMULA)

    def is_misread(self) -> bool:
        """Whether what is left is clearest as a reading of the speed that swings with the angle."""
        clearest = self.clearest.of
        return isinstance(clearest, Curve) and clearest.is_misread

    def plainly(self) -> list[Signal]:
        """The candidates' signals with their gains on the unfiltered residuals."""
        plain = self.screen.unfiltered
        whole = plain.regress().squares
        return [
            s._replace(gain=whole - plain.regress([s.block]).squares) for s in self.of_candidates
        ]

    def _unexplained_plainly(self, model: Model) -> float:
        """`unexplained` on the unfiltered misfit: what the clearest signal would explain, over what the model does."""
        if not self.removed > 0:
            return np.inf
        unfiltered = self.screen.unfiltered
        rest = unfiltered.regress([self.clearest.block]).squares
        share = 1 - rest / unfiltered.regress().squares
        return float(share * model.fit.fitness / self.removed)

    def _is_more_of(self, model: Model) -> bool:
        """Whether the clearest signal belongs to an effect that the model has."""
        clearest = self.clearest.candidate
        return clearest is not None and clearest.effect in model.effects

    def is_trace(self, model: Model) -> bool:
        """Whether so little is left that nothing more is worth a trial (`TRACE`)."""
        return self.unexplained < (TRACE_OF_HARDER if _is_hard(model) else TRACE)

    def is_foreign(self, model: Model) -> bool:
        """Whether what is left is clearly one more effect, in another equation or over another variable than any of the
        model's, so that these cannot have left it.

        Never beside a harder form: what gear teeth leave, which meet at unpredictable times, can look like anything.
        """
        if _is_hard(model) or self.p_value >= ALARM or self.by_one_more < MOST_OF_IT:
            return False
        best, effect = max(self.of_curves, key=_gain), max(self.of_candidates, key=_gain).candidate
        assert isinstance(best.of, Curve) and effect is not None
        # of model-form error a curve over the effect's own variable explains nearly all
        curve_is_own = _is_own(best.of, model) and best.gain > HALF_OF_IT * self.clearest.gain
        return not (curve_is_own or _is_own(EFFECTS[effect.effect], model))


def _gain(signal: Signal) -> float:
    return signal.gain


def _is_hard(model: Model) -> bool:
    """Whether one of the model's effects is a harder form (`HARDER`)."""
    return bool(set(model.effects) & set(HARDER.values()))


def _is_own(one: Curve | type[AbstractEffect], model: Model) -> bool:
    """Whether a curve or an effect has the same equation and variable as one of the model's effects."""
    return one.variable is not None and _axes(one) in {_axes(EFFECTS[e]) for e in model.effects}


def _axes(one: Curve | type[AbstractEffect]) -> tuple[str, str | None]:
    return unbalances(one.equation), one.variable
