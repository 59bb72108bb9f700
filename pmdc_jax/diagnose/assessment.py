"""What the evidence against a model says of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..effects import EFFECTS
from ..effects.base import AbstractEffect
from .effect_relations import CONTAINS, FULLER, unbalances
from .library import Curve
from .model import Model
from .screen import Screen, Signal

# Chance that anything at all is called missing from a motor that lacks nothing, or that anything more is in all looks
# after the first
ALARM = 0.01
# What effects may leave of the squares that they explain, by formulas that are not quite nature's: so much, and more
# if it is a curve over an effect's own variable
FORMULA, OWN_FORMULA = 0.1, 0.5
# An effect is tried if the best one would take away this share of what the clearest signal would; with the larger one
# what is left is clearly another effect, or a richer form of one
MUCH_OF_IT, MOST_OF_IT = 0.3, 0.7
# Fuller forms that no column shows, by the simpler ones in whose place they are tried if those leave something
HARDER = {simple: f.effect for simple, f in FULLER.items() if f.effect not in CONTAINS}
# ... and what effects leave of what they explain if nothing more is worth a trial, the larger one for harder ones:
# chance decides when teeth meet, and no fit of them is exact
TRACE, TRACE_OF_HARDER = 2e-3, 1e-2


def chance_of_nothing(
    of_candidates: Sequence[Signal], of_curves: Sequence[Signal], count: int
) -> float:
    """Chance of evidence as strong as the strongest if nothing were missing: Bonferroni over `count` blocks."""
    smallest = min(s.log_p for s in (*of_candidates, *of_curves))
    return float(min(1.0, np.exp(smallest + np.log(count))))


class Assessment(NamedTuple):
    """The evidence against a model, read once."""

    screen: Screen
    of_candidates: list[Signal]
    of_curves: list[Signal]
    left: float  # chance of it if nothing more were missing
    explained: float  # how much of what the motor without effects leaves the model takes away
    removed: float  # the same of the misfit as it is, no filter between

    @property
    def clearest(self) -> Signal:
        """The signal with the largest gain."""
        return max((*self.of_candidates, *self.of_curves), key=_gain)

    @property
    def unexplained(self) -> float:
        """What the clearest signal would still take away, over what the model takes away already."""
        return float(self.clearest.gain / self.explained) if self.explained > 0 else np.inf

    @property
    def by_one_more(self) -> float:
        """The share of that which one of the library's effects would take away."""
        best = max((s.gain for s in self.of_candidates), default=0.0)
        return float(best / self.clearest.gain)

    def asks_for_more(self) -> bool:
        """Whether more is missing, and one of the library's effects would take away much of it."""
        return bool(self.left < ALARM and self.by_one_more > MUCH_OF_IT)

    def is_another(self) -> bool:
        """Whether what is left is clearly one more effect, and no formula; a wave may be teeth that meet by chance."""
        if not self.of_candidates or self.unexplained < FORMULA or self.by_one_more < MOST_OF_IT:
            return False
        best = max(self.of_candidates, key=_gain).candidate
        return best is not None and not best.own_phase

    def is_clear(self, model: Model) -> bool:
        """Whether what a model leaves is too much for a formula, and not of the very kind of an effect that it has."""
        return bool(self.unexplained > FORMULA and not self._is_more_of(model))

    def is_formula(self, model: Model) -> bool:
        """Whether what is left may well be that of the model's effects by formulas of nature's own.

        Not where that is more than they explain of what is measured: then a filter took for noise what is missing.
        """
        if not model.effects or self._unexplained_plainly(model) > 1:
            return False
        if self.unexplained < FORMULA:
            return True
        clearest = self.clearest.of
        own = isinstance(clearest, Curve) and _is_own(clearest, model)
        return self._is_more_of(model) or bool(own and self.unexplained < OWN_FORMULA)

    def plainly(self) -> list[Signal]:
        """The candidates' signals with what each takes away of the misfit as it is, no filter between."""
        plain = self.screen.unfiltered
        whole = plain.regress().squares
        return [
            s._replace(gain=whole - plain.regress([s.block]).squares) for s in self.of_candidates
        ]

    def _unexplained_plainly(self, model: Model) -> float:
        """What the clearest signal would still take away of the misfit as it is, over what the model does."""
        if not self.removed > 0:
            return np.inf
        unfiltered = self.screen.unfiltered
        rest = unfiltered.regress([self.clearest.block]).squares
        share = 1 - rest / unfiltered.regress().squares
        return float(share * model.fit.fitness / self.removed)

    def _is_more_of(self, model: Model) -> bool:
        """Whether the clearest signal is that of an effect which the model has."""
        clearest = self.clearest.candidate
        return clearest is not None and clearest.effect in model.effects

    def is_trace(self, model: Model) -> bool:
        """Whether so little is left that the effects themselves may have left it."""
        return self.unexplained < (TRACE_OF_HARDER if _is_hard(model) else TRACE)

    def is_foreign(self, model: Model) -> bool:
        """Whether what is left is clearly one more effect that the model's own cannot have left: in another equation,
        or over another variable. Of when teeth meet there is no telling what it leaves."""
        if _is_hard(model) or self.left >= ALARM or self.by_one_more < MOST_OF_IT:
            return False
        best, effect = max(self.of_curves, key=_gain), max(self.of_candidates, key=_gain).candidate
        assert isinstance(best.of, Curve) and effect is not None
        # a curve that takes away little of what is left is not what is left
        curve_is_own = _is_own(best.of, model) and best.gain > MUCH_OF_IT * self.clearest.gain
        return not (curve_is_own or _is_own(EFFECTS[effect.effect], model))


def _gain(signal: Signal) -> float:
    return signal.gain


def _is_hard(model: Model) -> bool:
    """Whether one of the model's effects is a harder form, of which no fit is exact."""
    return bool(set(model.effects) & set(HARDER.values()))


def _is_own(one: Curve | type[AbstractEffect], model: Model) -> bool:
    """Whether a curve or an effect is one over a variable that one of the model's effects is a curve over, in its
    equation."""
    return one.variable is not None and _axes(one) in {_axes(EFFECTS[e]) for e in model.effects}


def _axes(one: Curve | type[AbstractEffect]) -> tuple[str, str | None]:
    return unbalances(one.equation), one.variable
