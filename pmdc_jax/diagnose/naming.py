"""Which effects are missing: forward from the motor without effects, each step refitted in full simulation."""

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
from .effect_relations import CONTAINS, FULLER, are_rivals, spelt_out
from .library import Library
from .model import Model, final_fit
from .periodic import Line, line_of
from .refits import Refits
from .rivals import chances_without, rivals_of
from .screen import Screen, Signal, beyond_curves, screen, signals
from .shortlist import (
    COMPARABLE,
    SHORTLIST,
    clear,
    effect_of,
    promising,
    richer,
    shortlist,
)

# At most so many effects are named
MOST = 3
# What the clearest signal would take away after one more effect, over what that effect takes away, at most; the larger
# one after a richer form of what was there, or where that cannot have left it
NEXT_TO_NOTHING, LITTLE = 0.1, 0.5
# A filter that swallows an effect shows no larger share of it, over what the model explains
SWALLOWED = 1e-2
# What is to take away most of a misfit foretells this share of it, at least
FORETOLD = 0.05
# A simpler form leaves at most so many times the squares, as they are
HARDLY_MORE = 1.5
# So many noise variances left are no small misfit beside which a refit to first order finds its way
LOST = 10.0
# The simplest effect by which a rotor sticks, what looks like it and a load together, and that load
DRY, ONE_SIDED, LOAD = "coulomb_friction", "asymmetric_friction", "constant_load"


class Naming(NamedTuple):
    """The set chosen, its rivals, and what is left that no candidate explains."""

    chosen: Model
    rivals: list[Model]
    first: Screen  # evidence against the motor without effects
    last: Screen  # and against the chosen one
    nothing: float  # chance of the evidence if nothing were missing
    left: float  # chance of what is left if nothing more were missing
    explained: bool  # whether that is no more than other formulas of the chosen effects might leave
    # share of what the chosen one leaves that no curve takes away, as root mean square
    noise: float
    without: dict[str, float]  # by effect of the chosen: chance of the data without it
    ended: tuple[Prepared, Fit]  # the last fit of the chosen one
    line: Line | None  # a steady oscillation that the chosen one does not have


class StepwiseSelection:
    """Gathers evidence, has sets of effects refitted, and compares them."""

    def __init__(self, base: Model, solved: Solved, report: ReportProgress) -> None:
        """`base` is the motor without effects, and `solved` how it was found."""
        self.base, self.library = base, Library(base)
        self.comparison = Comparison()
        self.refits = Refits(base, solved, self.library, self.comparison, report)
        self.assessments: dict[Model, Assessment] = {}
        # by effect: those that did as well when it was added
        self.instead: dict[str, set[str]] = {}
        # that a better one has replaced, or is to: judged by another filter each may look like the better one
        self.superseded: set[Model] = set()

    def name(self) -> Naming:
        """Add effects while the evidence asks for them; then see which could be spared or replaced."""
        current, found = self.base, self.assess(self.base)
        self.superseded.add(current)
        while better := self._step(current, found):
            current, found = better, self.assess(better)
            self.superseded.add(current)
        others = self._equivalent_swaps(current, found)
        if found.left < ALARM:  # however little: beside a large effect play in a gear is a trace
            others += self._in_harder_form(current, found, set(current.effects))
        return self._naming(self._better(current, found, others) or current)

    def _step(self, current: Model, found: Assessment) -> Model | None:
        """A better model than the current one, with one effect more or another one, that settles something, if there is
        one."""
        ways = [self._by_evidence, self._by_likeliest_effect, self._by_unfiltered_misfit]
        if found.unexplained < SWALLOWED:
            ways = [self._by_unfiltered_misfit, self._by_evidence, self._by_likeliest_effect]
        ways.append(self._in_exchange)
        models = (self._accepted(current, found, way(current, found)) for way in ways)
        return next(filter(None, models), None)

    def _accepted(self, current: Model, found: Assessment, better: Model | None) -> Model | None:
        """A better model if it is more than a way to mend a formula, or else in another form that is."""
        return self._in_a_form_that(
            lambda model: self._explains_more_than_a_formula(current, found, model), current, better
        )

    def _in_a_form_that(
        self, settles: Callable[[Model], bool], current: Model, better: Model | None
    ) -> Model | None:
        """A better model if it settles what is left, or else what was added to it in another form, if that does."""
        if better is None or settles(better):
            return better
        # a simple form may be but a step to the one that is there
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
        """The best of some models in place of the current one, if it is better, without what it can do without."""
        possible = [model for model in tried if self._is_new(model)]
        if not possible:
            return None
        best = self._best(possible, found.screen.white)
        # judged by the noise that the clearest signal leaves: a filter of what a poorer model leaves takes
        # for noise what is missing
        if plainest(self.comparison.ranked([current, best], found.screen.white)) is current:
            return None
        return self._eliminated(best)

    def _is_new(self, model: Model | None) -> TypeGuard[Model]:
        """Whether a model is possible, and none that was left for a better one."""
        return model is not None and model.is_possible and model not in self.superseded

    def _explains_more_than_a_formula(
        self, current: Model, found: Assessment, better: Model
    ) -> bool:
        """Whether a better model is more than a way to mend the formula of what the current one has.

        What was left is clearly something else; or little is, beside what the better one takes away.
        """
        if (set(better.effects) - set(current.effects)) & set(HARDER.values()):
            return True
        return found.is_clear(current) or self._leaves_little(current, better)

    def _leaves_little(self, current: Model, better: Model) -> bool:
        """Whether a better model leaves little beside what it takes away."""
        again = self.assess(better)
        if again.left >= ALARM:
            return True
        white, grown = self.comparison.white(better), len(better.effects) > len(current.effects)
        gained = (
            self.comparison.left(current, white).squares
            - self.comparison.left(better, white).squares
        )
        share = (
            NEXT_TO_NOTHING if grown and not self.assess(current).is_foreign(current) else LITTLE
        )
        return bool(again.clearest.gain < share * gained)

    def _by_likeliest_effect(self, current: Model, found: Assessment) -> Model | None:
        """The current model with the effect that promises most, however little, if it settles what no formula explains:
        beside one that was fitted wrongly for want of it, it does more than it promises, and so does one of a few on
        its own where parameters have gone far to make up for two."""
        if len(current.effects) == MOST or found.left >= ALARM or found.is_formula(current):
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
        """The current model with one of the effects that take away most of what is left, no filter between, if that
        leaves far less: a filter takes for noise what lasts as long as a short run."""
        far = current.fit.fitness / FAR
        full = len(current.effects) == MOST
        if full or found.left >= ALARM or far < current.given.problem.outputs:
            return None
        pointed = found.screen._replace(evidence=found.screen.unfiltered)
        least = FORETOLD * found.screen.unfiltered.regress().squares
        most = promising(found.plainly(), set(current.effects), least)
        tried = [self.refits.with_signal(current, s, pointed) for s in most]
        better = [m for m in tried if m is not None and m.fit.fitness < far]
        return self._better(current, found, better)

    def _in_exchange(self, current: Model, found: Assessment) -> Model | None:
        """A model that has no room for one more effect, with the one that promises most in the place of each of those
        in the same equation."""
        if len(current.effects) < MOST or found.left >= ALARM or found.is_trace(current):
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
        """The set without one of its effects."""
        white = self.comparison.white(named.chosen)
        return self._naming(self.refits.without(named.chosen, effect, white))

    def _naming(self, current: Model) -> Naming:
        first, found = self.assess(self.base), self.assess(current)
        return Naming(
            chosen=current,
            rivals=rivals_of(current, found, self.refits, self.comparison),
            first=first.screen,
            last=found.screen,
            nothing=first.left,
            left=found.left,
            explained=found.is_formula(current),
            noise=np.sqrt(beyond_curves(found.screen)) if found.left < ALARM else 1.0,
            without=chances_without(current, found.screen.white, self.refits, self.comparison),
            ended=final_fit(current, self.comparison.white(current)),
            line=line_of(current),
        )

    def _trials(self, current: Model, found: Assessment) -> list[Model | None]:
        """The current model with one effect more, or with a richer or a harder one in place of another."""
        here = set(current.effects)
        if len(here) == MOST:
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
                # no fuller form: a load larger than friction is no asymmetric friction
                tried += self._with(current, found, shortlist(current, found, fuller=False))
        if found.left < ALARM and not here:
            tried += self._searched_with_friction(current, found, tried)
        return tried + harder

    def _is_enough(self, model: Model | None) -> bool:
        """Whether a model leaves nothing that is worth a trial: what teeth that meet by chance leave of a simple form
        may look like many an effect beside it."""
        if model is None or not model.is_possible:
            return False
        found = self.assess(model)
        return found.left >= ALARM or found.is_trace(model)

    def _searched_with_friction(
        self, current: Model, found: Assessment, tried: Sequence[Model | None]
    ) -> list[Model | None]:
        """The motor with dry friction, searched for anew, if that may explain a misfit of which no first-order response
        is clear, or was the best that was `tried` and left it far from the noise, and now leaves far less: a motor
        whose rotor sticks for long is far from one that is thought to creep. With a load, too, where friction was to
        be none in one direction: a load that is larger than friction drives the rotor that way."""
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
        if not sticks or far < noise:  # not even a perfect fit would
            return []
        searched = [self.refits.sought(current, DRY)]
        if ONE_SIDED in nearest.effects_at_end:
            searched.append(self.refits.sought(searched[0], LOAD))
        return [model for model in searched if model.fit.fitness < far]

    def _in_other_form(
        self, model: Model, found: Assessment, added: set[str]
    ) -> list[Model | None]:
        """The model with what was added to it in a richer or a harder form."""
        fuller = [s for s in richer(model, found, MUCH_OF_IT) if CONTAINS[effect_of(s)] & added]
        return self._with(model, found, fuller) + self._in_harder_form(model, found, added)

    def _equivalent_swaps(self, current: Model, found: Assessment) -> list[Model | None]:
        """The model with others in the place of its effects that did as well as these when they were added, or are much
        like them."""
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
        count *= MOST if model.effects else 1
        left = 1.0 if model.is_exact else chance_of_nothing(of_candidates, of_curves, count)
        explained = 0.0
        if model.effects:
            base, mine = (self.comparison.left(m, found.white) for m in (self.base, model))
            explained = base.squares - mine.squares
        removed = self.base.fit.fitness - model.fit.fitness
        return Assessment(found, of_candidates, of_curves, left, explained, removed)

    def _best(self, tried: Sequence[Model], white: Whitener) -> Model:
        """The best of some refits, by the filter of what the one that leaves least leaves."""
        if len(tried) == 1:
            return tried[0]
        least = self.comparison.ranked(tried, white)[0].model
        ranked = self.comparison.ranked(tried, self.comparison.white(least))
        best = plainest(ranked)
        self._note_ties(best, ranked)
        return best

    def _note_ties(self, best: Model, ranked: Sequence[Fitted]) -> None:
        """Keep in mind which effects do as well as one of the best model's."""
        mine = set(best.effects)
        least = next(f.criterion for f in ranked if f.model is best)
        for other in (f for f in ranked if f.criterion < least + MARGIN):
            its = set(other.model.effects)
            if len(mine - its) == len(its - mine) == 1 and are_rivals(mine, its):
                self.instead.setdefault(*(mine - its), set()).update(its - mine)

    def _eliminated(self, model: Model) -> Model:
        """The model without effects that it can do without, or with simpler forms of them, alone or beside another one,
        that leave nothing more."""
        white = self.comparison.white(model)
        for effect in model.effects[:-1]:
            smaller = self.refits.without(model, effect, white)
            if (
                self._is_new(smaller)
                and self.comparison.ranked([model, smaller], white)[0].model is smaller
            ):
                return self._eliminated(smaller)
        for effect in model.effects:
            for simple in self._simpler_forms(effect):
                simpler = self.refits.in_place(model, white, effect, simple)
                if self._is_new(simpler) and self._does_as_well(simpler, model):
                    return self._eliminated(simpler)
                two = simpler and self._simple_form_with_another(simpler, model, effect)
                if two and self._is_far_better(two, model, white):
                    return self._eliminated(two)
        return model

    def _simpler_forms(self, effect: str) -> list[str]:
        """What an effect contains and may be instead: what was tried, and what it is but a fuller form of."""
        reduced = {s for s, form in FULLER.items() if form.effect == effect and form.reduced}
        return sorted(CONTAINS.get(effect, set()) & self.refits.begun.keys() | reduced)

    def _simple_form_with_another(self, simpler: Model, model: Model, rich: str) -> Model | None:
        """A model with a simpler form of a rich effect, and one more beside it that promises as much as the rich form.

        Stribeck friction bends as drag does, if viscous friction makes up for the rest.
        """
        if len(simpler.effects) == MOST:
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
        """Whether two effects leave far less than a rich one by the filter, and no more as it is."""
        if two.fit.fitness > model.fit.fitness:
            return False
        criterion = {f.model: f.criterion for f in self.comparison.ranked([two, model], white)}
        return bool(criterion[two] + MARGIN < criterion[model])

    def _does_as_well(self, simpler: Model, model: Model) -> bool:
        """Whether a simpler form of an effect, chosen while another one was still missing, does as well by now: but for
        less than what neither explains; or leaves nothing to its own filter, and hardly more with no filter between."""
        rich, plain = (
            self.comparison.left(m, self.comparison.white(model)).criterion
            for m in (model, simpler)
        )
        rest = self.assess(model)
        margin = MARGIN + (rest.clearest.gain if rest.left < ALARM else 0.0)
        if plain < rich + margin:
            return True
        hardly_more = simpler.fit.fitness < HARDLY_MORE * model.fit.fitness
        return bool(hardly_more and self.assess(simpler).left >= ALARM)
