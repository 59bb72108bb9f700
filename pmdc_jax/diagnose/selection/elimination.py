"""Backward elimination: remove effects that a model does not need, and simplify those that it does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeGuard

from ...identify.noise.noise_model import Whitener
from ..evidence.assessment import FALSE_ALARM, Assessment
from ..hypotheses.effect_relations import CONTAINS, FULLER, with_split_friction
from ..model import MAX_EFFECTS, Model
from .compare import BIC_MARGIN, Comparison
from .refits import Refits
from .shortlist import COMPARABLE_GAIN, clear_signals, of_largest_gain

# A simpler form may leave at most so many times the unfiltered squares of the richer one
MAX_MISFIT_GROWTH = 1.5


class BackwardElimination:
    """Removes from a model what it does not need."""

    def __init__(
        self,
        refits: Refits,
        comparison: Comparison,
        assess: Callable[[Model], Assessment],
        is_new: Callable[[Model | None], TypeGuard[Model]],
    ) -> None:
        """`assess` gathers the evidence against a model; `is_new` tells whether one may be chosen."""
        self.refits, self.comparison = refits, comparison
        self.assess, self.is_new = assess, is_new

    def reduced(self, model: Model) -> Model:
        """The model after backward elimination: without effects that it does not need, and with simpler forms of
        effects, alone or with another effect added, where these are as good."""
        white = self.comparison.filter_of(model)
        for smaller in self.refits.without_each(model, model.effects[:-1], white):
            if self.is_new(smaller) and self.comparison.ranked([model, smaller], white)[0].model is smaller:
                return self.reduced(smaller)
        for effect in model.effects:
            for simple in self._simpler_forms(effect):
                simpler = self.refits.with_simple_form(model, white, effect, simple)
                if simpler is None or not simpler.is_possible:
                    continue
                if self.is_new(simpler) and self._is_as_good(simpler, model):
                    return self.reduced(simpler)
                pair = self._simple_form_with_another(simpler, model, effect)
                if pair and self._is_far_better(pair, model, white):
                    return self.reduced(pair)
        return model

    def _simpler_forms(self, effect: str) -> list[str]:
        """The simpler effects that may replace one: contained ones that were fitted before, and that of which it is
        fuller."""
        of_fuller = {simple for simple, fuller in FULLER.items() if fuller.effect == effect}
        return sorted(CONTAINS.get(effect, set()) & self.refits.starts.first_values.keys() | of_fuller)

    def _simple_form_with_another(self, simpler: Model, model: Model, rich: str) -> Model | None:
        """A model with a simpler form of a rich effect, and one more effect of comparable gain (`COMPARABLE_GAIN`).

        Stribeck friction is curved like drag, for instance, if viscous friction compensates for the rest.
        """
        if len(simpler.effects) == MAX_EFFECTS:
            return None
        assessment = self.assess(simpler)
        by_effect = {s.effect: s for s in clear_signals(assessment)}
        least = COMPARABLE_GAIN * by_effect[rich].gain if rich in by_effect else 0.0
        present = set(simpler.effects)
        others = [
            s
            for effect, s in by_effect.items()
            if effect not in {*model.effects, *CONTAINS}
            and with_split_friction({*present, effect}) != with_split_friction(set(model.effects))
            and s.gain > least
        ]
        pairs = self.refits.with_signals(simpler, of_largest_gain(others), assessment.screen)
        return next((pair for pair in pairs if pair and pair.is_possible), None)

    def _is_far_better(self, pair: Model, model: Model, white: Whitener) -> bool:
        """Whether two effects beat a rich one by `BIC_MARGIN`, and leave no more unfiltered squares."""
        if pair.fit.fitness > model.fit.fitness:
            return False
        criterion = {f.model: f.criterion for f in self.comparison.ranked([pair, model], white)}
        return bool(criterion[pair] + BIC_MARGIN < criterion[model])

    def _is_as_good(self, simpler: Model, model: Model) -> bool:
        """Whether a simpler form is as good as the richer one, chosen when another effect may have been missing.

        Its criterion is worse by less than `BIC_MARGIN`; or the unfiltered squares are hardly larger, and it is worse
        by less than `BIC_MARGIN` and what neither explains, or leaves nothing significant by its own filter.
        """
        rich, simple = (self.comparison.fitted(m, self.comparison.filter_of(model)).criterion for m in (model, simpler))
        if simple < rich + BIC_MARGIN:
            return True
        if simpler.fit.fitness >= MAX_MISFIT_GROWTH * model.fit.fitness:
            return False
        assessment = self.assess(model)
        unexplained = assessment.clearest.gain if assessment.p_value < FALSE_ALARM else 0.0
        return bool(simple < rich + BIC_MARGIN + unexplained or self.assess(simpler).p_value >= FALSE_ALARM)
