"""Which effects are missing: forward selection from the motor without effects, each step refitted in full simulation.

A *richer* form of an effect contains and replaces it, as Stribeck does Coulomb friction; a *harder* one has no column
in the regression, as backlash for a compliant shaft. The *fuller* form (`FULLER`), of either kind, is the one that the
runs must rule out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeGuard

import numpy as np

from ..effects import EFFECTS
from ..identify.noise_model import Whitener
from ..identify.polish import Fit
from ..identify.prepare import Prepared
from ..identify.solve import Solved
from ..progress import ReportProgress
from .assessment import ALARM, HARDER, MUCH_OF_IT, Assessment, chance_of_nothing
from .candidates import TRIALS
from .compare import FAR, MARGIN, Comparison, Fitted, plainest
from .effect_relations import CONTAINS, are_rivals
from .elimination import BackwardElimination
from .library import Library
from .model import MOST_EFFECTS, Model, final_fit
from .periodic import Line, line_of
from .refits import Refits
from .rivals import chances_without, rivals_of
from .screen import beyond_curves, screen
from .shortlist import (
    SHORTLIST,
    clear,
    effect_of,
    promising,
    richer,
    shortlist,
)
from .signals import Screen, Signal, signals

# Limits of `_leaves_little`, as shares of the squares that the better model takes away. LITTLE applies where an effect
# was replaced by another form, or where the effects before cannot have left the misfit.
NEXT_TO_NOTHING, LITTLE = 0.1, 0.5
# Where the clearest signal gains a smaller share of what the model explains, the whitening filter may have absorbed an
# effect: the unfiltered misfit is looked at first
SWALLOWED = 1e-2
# Least share of the unfiltered squares that a candidate must promise to be tried on the unfiltered misfit
FORETOLD = 0.05
# Scale of the misfit (noise variances per output) from which a first-order start may lead a refit astray
LOST = 10.0
# The simplest effect that makes a rotor stick, the effect that imitates friction and load together, and that load
DRY, ONE_SIDED, LOAD = "coulomb_friction", "asymmetric_friction", "constant_load"


class Naming(NamedTuple):
    """The set chosen, its rivals, and what is left that no candidate explains."""

    chosen: Model
    rivals: list[Model]
    first: Screen  # evidence against the motor without effects
    last: Screen  # and against the chosen one
    p_nothing: float  # p-value of the evidence if nothing were missing
    p_nothing_more: float  # p-value of what is left if nothing more were missing
    explained: bool  # whether what is left may be model-form error of the chosen effects
    # root mean square of the chosen one's residuals beyond all curves, over that of all; 1 if nothing more is missing
    noise_share: float
    without: dict[str, float]  # by effect of the chosen: p-value of the data without it
    ended: tuple[Prepared, Fit]  # the last fit of the chosen one
    line: Line | None  # a steady oscillation that the chosen one does not have


class StepwiseSelection:
    """Forward selection with backward elimination: gathers evidence, refits sets of effects, compares them."""

    def __init__(self, base: Model, solved: Solved, report: ReportProgress) -> None:
        """`base` is the motor without effects, and `solved` how it was found."""
        self.base, self.library = base, Library(base)
        self.comparison = Comparison()
        self.refits = Refits(base, solved, self.library, self.comparison, report)
        self.assessments: dict[Model, Assessment] = {}
        # by effect: alternatives that did as well when it was added
        self.instead: dict[str, set[str]] = {}
        # models that a better one has replaced or is to: by different filters, each of two may look like the better one
        self.superseded: set[Model] = set()
        self.elimination = BackwardElimination(
            self.refits, self.comparison, self.assess, self._is_new
        )

    def name(self) -> Naming:
        """Add effects while the evidence asks for them; then try other effects in the place of those found."""
        current, found = self.base, self.assess(self.base)
        self.superseded.add(current)
        while better := self._step(current, found):
            current, found = better, self.assess(better)
            self.superseded.add(current)
        others = self._equivalent_swaps(current, found)
        # however little: what backlash leaves is small beside what a large effect explains
        if found.p_value < ALARM:
            others += self._in_harder_form(current, found, set(current.effects))
        return self._naming(self._better(current, found, others) or current)

    def _step(self, current: Model, found: Assessment) -> Model | None:
        """The next model: the first accepted result of the ways to add or replace an effect; None if there is none."""
        ways = [self._by_evidence, self._by_likeliest_effect, self._by_unfiltered_misfit]
        if found.unexplained < SWALLOWED:
            ways = [self._by_unfiltered_misfit, self._by_evidence, self._by_likeliest_effect]
        ways.append(self._in_exchange)
        models = (self._accepted(current, found, way(current, found)) for way in ways)
        return next(filter(None, models), None)

    def _accepted(self, current: Model, found: Assessment, better: Model | None) -> Model | None:
        """A better model if it does more than compensate for model-form error; or else another form of it that does."""
        return self._in_a_form_that(
            lambda model: self._explains_more_than_a_formula(current, found, model), current, better
        )

    def _in_a_form_that(
        self, settles: Callable[[Model], bool], current: Model, better: Model | None
    ) -> Model | None:
        """A better model if it passes the test `settles`; or else one with another form of what was added that does."""
        if better is None or settles(better):
            return better
        # the simple form may be only a step towards the fuller one that the motor has
        added = set(better.effects) - set(current.effects)
        again = self.assess(better)
        best = self._better(better, again, self._in_other_form(better, again, added))
        return best if best and settles(best) else None

    def _by_evidence(self, current: Model, found: Assessment) -> Model | None:
        """The best of the models that the evidence asks to be tried."""
        return self._better(current, found, self._trials(current, found))

    def _better(
        self, current: Model, found: Assessment, tried: Sequence[Model | None]
    ) -> Model | None:
        """The best of some models after backward elimination; None if the current one is as good."""
        possible = [model for model in tried if self._is_new(model)]
        if not possible:
            return None
        best = self._best(possible, found.screen.white)
        # by the filter fitted without the clearest signal: one of the current residuals absorbs what is missing
        if plainest(self.comparison.ranked([current, best], found.screen.white)) is current:
            return None
        return self.elimination.reduced(best)

    def _is_new(self, model: Model | None) -> TypeGuard[Model]:
        """Whether a model exists, is physically possible, and was not superseded by a better one."""
        return model is not None and model.is_possible and model not in self.superseded

    def _explains_more_than_a_formula(
        self, current: Model, found: Assessment, better: Model
    ) -> bool:
        """Whether a better model does more than compensate for model-form error of the current one's effects.

        It does if what was left is clearly something else, if the better one leaves little, or if it has a harder form.
        """
        if (set(better.effects) - set(current.effects)) & set(HARDER.values()):
            return True
        return found.is_clear(current) or self._leaves_little(current, better)

    def _leaves_little(self, current: Model, better: Model) -> bool:
        """Whether a better model leaves nothing significant, or little compared with what it takes away."""
        again = self.assess(better)
        if again.p_value >= ALARM:
            return True
        white, grown = self.comparison.white(better), len(better.effects) > len(current.effects)
        gained = (
            self.comparison.fitted(current, white).squares
            - self.comparison.fitted(better, white).squares
        )
        share = (
            NEXT_TO_NOTHING if grown and not self.assess(current).is_foreign(current) else LITTLE
        )
        return bool(again.clearest.gain < share * gained)

    def _by_likeliest_effect(self, current: Model, found: Assessment) -> Model | None:
        """The current model with the effect that promises most, however little that is, if it then leaves little.

        An effect gains more than it promises if parameters of others are biased for lack of it, or if the motor's have
        moved far to compensate for two effects. Not tried where model-form error may explain what is left, or a sensor
        of the speed that misreads it.
        """
        full = len(current.effects) == MOST_EFFECTS
        if full or found.p_value >= ALARM or found.is_formula(current) or found.is_misread():
            return None
        if current.effects:
            others = [s for s in clear(found) if effect_of(s) not in current.effects]
            most = sorted(others, key=lambda s: -s.gain)[:1]
        else:
            most = shortlist(current, found)
        better = self._better(current, found, self._with(current, found, most))
        return self._in_a_form_that(
            lambda model: self._leaves_little(current, model), current, better
        )

    def _by_unfiltered_misfit(self, current: Model, found: Assessment) -> Model | None:
        """The current model with one of the effects that promise most on the unfiltered misfit, if that falls by a
        factor of `FAR`: a whitening filter takes for noise what lasts as long as a short run."""
        far = current.fit.fitness / FAR
        full = len(current.effects) == MOST_EFFECTS
        if full or found.p_value >= ALARM or far < current.given.problem.outputs:
            return None
        pointed = found.screen._replace(evidence=found.screen.unfiltered)
        least = FORETOLD * found.screen.unfiltered.regress().squares
        most = promising(found.plainly(), set(current.effects), least)
        tried = [self.refits.with_signal(current, s, pointed) for s in most]
        better = [m for m in tried if m is not None and m.fit.fitness < far]
        return self._better(current, found, better)

    def _in_exchange(self, current: Model, found: Assessment) -> Model | None:
        """A model with `MOST_EFFECTS` effects, with the most promising new one in place of one in the same equation."""
        if len(current.effects) < MOST_EFFECTS or found.p_value >= ALARM or found.is_trace(current):
            return None
        others = [s for s in clear(found) if effect_of(s) not in current.effects]
        if not others:
            return None
        new = effect_of(max(others, key=lambda s: s.gain))
        tried: list[Model | None] = []
        for old in current.effects:
            if EFFECTS[old].equation == EFFECTS[new].equation:
                smaller = self.refits.without(current, old, found.screen.white)
                seen = self.assess(smaller)
                most = [s for s in seen.of_candidates if effect_of(s) == new][:1]
                tried += self._with(smaller, seen, most)
        return self._better(current, found, tried)

    def without(self, named: Naming, effect: str) -> Naming:
        """The naming for the chosen set without one of its effects."""
        white = self.comparison.white(named.chosen)
        return self._naming(self.refits.without(named.chosen, effect, white))

    def _naming(self, current: Model) -> Naming:
        first, found = self.assess(self.base), self.assess(current)
        return Naming(
            chosen=current,
            rivals=rivals_of(current, found, self.refits, self.comparison),
            first=first.screen,
            last=found.screen,
            p_nothing=first.p_value,
            p_nothing_more=found.p_value,
            explained=found.is_formula(current),
            noise_share=np.sqrt(beyond_curves(found.screen)) if found.p_value < ALARM else 1.0,
            without=chances_without(current, found.screen.white, self.refits, self.comparison),
            ended=final_fit(current, self.comparison.white(current)),
            line=line_of(current),
        )

    def _trials(self, current: Model, found: Assessment) -> list[Model | None]:
        """The current model with one effect more, or with a richer or harder form of one that it has."""
        here = set(current.effects)
        if len(here) == MOST_EFFECTS:
            return []
        if found.is_trace(current):
            foreign = found.is_foreign(current)
            one_more = shortlist if foreign else richer
            return self._with(current, found, one_more(current, found))
        harder = [] if found.is_another() else self._in_harder_form(current, found, here)
        if any(self._is_enough(model) for model in harder):
            return harder
        tried = []
        if found.asks_for_more():
            tried += self._with(current, found, shortlist(current, found))
            if any(model and model.effects_at_end for model in tried):
                # not a richer form alone: asymmetric friction, at its bound, is no load larger than friction
                tried += self._with(current, found, shortlist(current, found, fuller=False))
        if found.p_value < ALARM and not here:
            tried += self._searched_with_friction(current, found, tried)
        return tried + harder

    def _is_enough(self, model: Model | None) -> bool:
        """Whether a model leaves nothing that is worth another trial.

        If a harder form is enough no other effect is tried: what a simple form leaves of gear teeth may look like many.
        """
        if model is None or not model.is_possible:
            return False
        found = self.assess(model)
        return found.p_value >= ALARM or found.is_trace(model)

    def _searched_with_friction(
        self, current: Model, found: Assessment, tried: Sequence[Model | None]
    ) -> list[Model | None]:
        """The motor with dry friction from a new global search, if stiction may explain a large misfit.

        A rotor that sticks for long is too far from one that creeps for first-order evidence. So this is tried if no
        possible model was `tried`, or the best of them is far from the noise, and a leading effect makes a rotor stick.
        The result must cut the misfit by a factor of `FAR`. With a load, too, where asymmetric friction ended at a
        bound: a load larger than friction drives the rotor in one direction.
        """
        possible = [model for model in tried if model is not None and model.is_possible]
        if possible:
            nearest = min(possible, key=lambda m: m.fit.fitness)
            suspects, noise = nearest.effects, LOST * current.given.problem.outputs
        else:
            by_gain = sorted(found.of_candidates, key=lambda s: -s.gain)
            suspects = tuple(dict.fromkeys(effect_of(s) for s in by_gain))[:SHORTLIST]
            nearest, noise = current, current.given.problem.outputs
        sticks = any(EFFECTS[effect].holds == "speed" for effect in suspects)
        far = nearest.fit.fitness / FAR
        if not sticks or far < noise:  # not even a perfect fit would cut the misfit so far
            return []
        searched = [self.refits.sought(current, DRY)]
        if ONE_SIDED in nearest.effects_at_end:
            searched.append(self.refits.sought(searched[0], LOAD))
        return [model for model in searched if model.fit.fitness < far]

    def _in_other_form(
        self, model: Model, found: Assessment, added: set[str]
    ) -> list[Model | None]:
        """The model with the effects added last replaced by a richer or a harder form."""
        fuller = [s for s in richer(model, found, MUCH_OF_IT) if CONTAINS[effect_of(s)] & added]
        return self._with(model, found, fuller) + self._in_harder_form(model, found, added)

    def _equivalent_swaps(self, current: Model, found: Assessment) -> list[Model | None]:
        """The model with one effect replaced by another that did as well when it was added, or that resembles it
        (`Trial.alike`)."""
        if len(current.effects) < 2:
            return []
        return [
            self.refits.in_place(current, found.screen.white, effect, other)
            for effect in current.effects
            for other in sorted(
                (self.instead.get(effect, set()) | TRIALS[effect].alike.keys())
                - set(current.effects)
            )
        ]

    def _with(
        self, current: Model, found: Assessment, signals: Sequence[Signal]
    ) -> list[Model | None]:
        return [self.refits.with_signal(current, s, found.screen) for s in signals]

    def _in_harder_form(
        self, current: Model, found: Assessment, effects: set[str]
    ) -> list[Model | None]:
        return [
            self.refits.in_place(current, found.screen.white, simpler, HARDER[simpler])
            for simpler in sorted(effects & HARDER.keys())
        ]

    def assess(self, model: Model) -> Assessment:
        if model not in self.assessments:
            self.assessments[model] = self._assessed(model)
        return self.assessments[model]

    def _assessed(self, model: Model) -> Assessment:
        found = screen(model, self.library)
        of_candidates, of_curves = signals(found)
        count = len(found.candidates) + len(found.curves)
        count *= MOST_EFFECTS if model.effects else 1
        p_value = 1.0 if model.is_exact else chance_of_nothing(of_candidates, of_curves, count)
        explained = 0.0
        if model.effects:
            base, mine = (self.comparison.fitted(m, found.white) for m in (self.base, model))
            explained = base.squares - mine.squares
        removed = self.base.fit.fitness - model.fit.fitness
        return Assessment(found, of_candidates, of_curves, p_value, explained, removed)

    def _best(self, tried: Sequence[Model], white: Whitener) -> Model:
        """The best of some refits, compared by the whitening filter of the one with the least squares."""
        if len(tried) == 1:
            return tried[0]
        least = self.comparison.ranked(tried, white)[0].model
        ranked = self.comparison.ranked(tried, self.comparison.white(least))
        best = plainest(ranked)
        self._note_ties(best, ranked)
        return best

    def _note_ties(self, best: Model, ranked: Sequence[Fitted]) -> None:
        """Record the effects that do as well as one of the best model's (within `MARGIN`)."""
        mine = set(best.effects)
        least = next(f.criterion for f in ranked if f.model is best)
        for other in (f for f in ranked if f.criterion < least + MARGIN):
            its = set(other.model.effects)
            if len(mine - its) == len(its - mine) == 1 and are_rivals(mine, its):
                self.instead.setdefault(*(mine - its), set()).update(its - mine)
