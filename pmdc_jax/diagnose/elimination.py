"""Backward elimination: without effects that a model does not need, and with simpler forms of those that it does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeGuard

from ..identify.noise_model import Whitener
from .assessment import ALARM, Assessment
from .compare import MARGIN, Comparison
from .effect_relations import CONTAINS, FULLER, spelt_out
from .model import MOST_EFFECTS, Model
from .refits import Refits
from .shortlist import COMPARABLE, clear, effect_of

# A simpler form may leave at most so many times the unfiltered squares of the richer one
HARDLY_MORE = 1.5


class BackwardElimination:
    """Takes out of a model what it does not need."""

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
        effects, alone or with another effect added, where these do as well."""
        white = self.comparison.white(model)
        for effect in model.effects[:-1]:
            smaller = self.refits.without(model, effect, white)
            if (
                self.is_new(smaller)
                and self.comparison.ranked([model, smaller], white)[0].model is smaller
            ):
                return self.reduced(smaller)
        for effect in model.effects:
            for simple in self._simpler_forms(effect):
                simpler = self.refits.in_place(model, white, effect, simple)
                if self.is_new(simpler) and self._does_as_well(simpler, model):
                    return self.reduced(simpler)
                two = simpler and self._simple_form_with_another(simpler, model, effect)
                if two and self._is_far_better(two, model, white):
                    return self.reduced(two)
        return model

    def _simpler_forms(self, effect: str) -> list[str]:
        """The simpler effects that may replace one: contained ones that were begun, and that of which it is fuller."""
        reduced = {s for s, form in FULLER.items() if form.effect == effect and form.reduced}
        return sorted(CONTAINS.get(effect, set()) & self.refits.begun.keys() | reduced)

    def _simple_form_with_another(self, simpler: Model, model: Model, rich: str) -> Model | None:
        """A model with a simpler form of a rich effect, and one more effect that promises as much (`COMPARABLE`).

        Stribeck friction is curved like drag, for instance, if viscous friction compensates for the rest.
        """
        if len(simpler.effects) == MOST_EFFECTS:
            return None
        found = self.assess(simpler)
        promised = {effect_of(s): s for s in clear(found)}
        enough = COMPARABLE * promised[rich].gain if rich in promised else 0.0
        here = set(simpler.effects)
        others = [
            s
            for effect, s in promised.items()
            if effect not in {*model.effects, *CONTAINS}
            and spelt_out({*here, effect}) != spelt_out(set(model.effects))
            and s.gain > enough
        ]
        best = max(others, key=lambda s: s.gain, default=None)
        two = best and self.refits.with_signal(simpler, best, found.screen)
        return two if two and two.is_possible else None

    def _is_far_better(self, two: Model, model: Model, white: Whitener) -> bool:
        """Whether two effects beat a rich one by `MARGIN` in the criterion, and leave no more unfiltered squares."""
        if two.fit.fitness > model.fit.fitness:
            return False
        criterion = {f.model: f.criterion for f in self.comparison.ranked([two, model], white)}
        return bool(criterion[two] + MARGIN < criterion[model])

    def _does_as_well(self, simpler: Model, model: Model) -> bool:
        """Whether a simpler form does as well as the richer one, chosen when another effect may have been missing.

        Its criterion is worse by less than `MARGIN` and what neither explains; or, by its own filter, nothing
        significant is left, and hardly more unfiltered squares.
        """
        rich, plain = (
            self.comparison.fitted(m, self.comparison.white(model)).criterion
            for m in (model, simpler)
        )
        rest = self.assess(model)
        margin = MARGIN + (rest.clearest.gain if rest.p_value < ALARM else 0.0)
        if plain < rich + margin:
            return True
        hardly_more = simpler.fit.fitness < HARDLY_MORE * model.fit.fitness
        return bool(hardly_more and self.assess(simpler).p_value >= ALARM)
