"""Which effects are missing: forward selection from the motor without effects, each step refitted in full simulation.

A *richer* form of an effect contains and replaces it, as Stribeck friction does Coulomb friction; a *refit-only* form
has no column in the regression, such as backlash for a compliant shaft. The *fuller* form (`FULLER`), of either kind,
is the one that the runs must rule out.
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
from .assessment import (
    FALSE_ALARM,
    REFIT_ONLY,
    TRIAL_SHARE,
    Assessment,
    familywise_p_value,
    has_axes_of,
)
from .compare import BIC_MARGIN, DECISIVE_RATIO, Comparison, Fitted, simplest_equivalent
from .constancy import varying_parameter
from .diagnosis import VaryingParameter
from .effect_relations import CONTAINS, are_rivals
from .elimination import BackwardElimination
from .library import Library
from .model import MAX_EFFECTS, Model, final_fit
from .periodic import Line, line_of
from .refits import Refits
from .rivals import p_values_without, rivals_of
from .screen import screen, share_beyond
from .shortlist import (
    SHORTLIST,
    additional_effects,
    clear_signals,
    effect_of,
    most_promising,
    richer_form,
    shortlist,
)
from .signals import Screen, Signal, signals
from .trials import TRIALS

# What a better model may still leave, as a share of the squares that it takes away (`_leaves_little`). The larger limit
# applies where an effect was replaced by another form, or where the effects before cannot have left the misfit.
STRICT_REST, LENIENT_REST = 0.1, 0.5
# Where the clearest signal gains a smaller share of what the model explains, the whitening filter may have absorbed an
# effect: the unfiltered misfit is examined first
ABSORBED_SHARE = 1e-2
# Least share of the unfiltered squares that a candidate must promise to be tried on the unfiltered misfit
MIN_UNFILTERED_SHARE = 0.05
# Misfit (noise variances per output) from which a first-order start may lead a refit to a wrong optimum
POOR_MISFIT = 10.0


class Naming(NamedTuple):
    """The model chosen, its rivals, and what is left that no candidate explains."""

    chosen: Model
    rivals: list[Model]
    base_screen: Screen  # evidence against the motor without effects
    chosen_screen: Screen  # evidence against the chosen model
    p_nothing: float  # p-value of the evidence if nothing were missing
    p_nothing_more: float  # p-value of what is left if nothing more were missing
    may_be_model_form_error: bool  # what is left, of the chosen effects
    leaves_sensor_error: bool  # whether what is left is most like that
    # root mean square of the chosen one's residuals beyond all curves over that of all; 1 if nothing more is missing
    noise_share: float
    p_without: dict[str, float]  # by effect of the chosen model: p-value of the data without it
    final_fit: tuple[Prepared, Fit]  # of the chosen model
    line: Line | None  # a steady oscillation that the chosen model does not have
    # the parameter that differs from run to run, if that is what is left
    varies: VaryingParameter | None


class StepwiseSelection:
    """Forward selection with backward elimination: gathers evidence, refits sets of effects, compares them."""

    def __init__(self, base: Model, solved: Solved, report: ReportProgress) -> None:
        """`base` is the motor without effects, and `solved` how it was found."""
        self.base, self.library = base, Library(base)
        self.comparison = Comparison()
        self.refits = Refits(base, solved, self.library.scales, self.comparison, report)
        self.assessments: dict[Model, Assessment] = {}
        # by effect: alternatives that were as good when it was added
        self.equivalents: dict[str, set[str]] = {}
        # models that are not returned to: by different filters, each of two may look like the better one
        self.superseded: set[Model] = set()
        self.elimination = BackwardElimination(
            self.refits, self.comparison, self.assess, self._is_new
        )

    def name(self) -> Naming:
        """Add effects while the evidence calls for them; then try other effects in place of those found."""
        current, found = self.base, self.assess(self.base)
        self.superseded.add(current)
        while better := self._step(current, found):
            current, found = better, self.assess(better)
            self.superseded.add(current)
        others = self._equivalent_swaps(current, found)
        # even if little is left: what backlash leaves is small beside what a large effect explains
        if found.p_value < FALSE_ALARM:
            others += self._with_refit_only_forms(current, found, set(current.effects))
        return self._without_compensation(
            self._naming(self._better(current, found, others) or current)
        )

    def _without_compensation(self, named: Naming) -> Naming:
        """The naming without effects if they only compensate for a parameter that differs from run to run: with a value
        for each run, the motor without them explains the runs as well."""
        if named.varies is None or not named.chosen.effects:
            return named
        plain = self._naming(self.base)
        if plain.varies is None:
            return named
        gain = plain.varies.negative_log_likelihood - named.varies.negative_log_likelihood
        more = len(named.chosen.fit.coordinates) - len(self.base.fit.coordinates)
        limit = more * np.log(self.base.given.problem.most_samples) + BIC_MARGIN
        return named if 2 * gain > limit else plain

    def _step(self, current: Model, found: Assessment) -> Model | None:
        """The next model: the first accepted result of the ways to add or replace an effect; None if there is none."""
        ways = [self._by_evidence, self._by_likeliest_effect, self._by_unfiltered_misfit]
        if found.unexplained < ABSORBED_SHARE:
            ways = [self._by_unfiltered_misfit, self._by_evidence, self._by_likeliest_effect]
        ways += [self._by_earlier_evidence, self._by_exchange]
        models = (self._accepted(current, found, way(current, found)) for way in ways)
        return next(filter(None, models), None)

    def _accepted(self, current: Model, found: Assessment, better: Model | None) -> Model | None:
        """A better model if it does more than compensate for model-form error; else another form of it that does."""
        return self._in_form_that_settles(
            lambda model: self._is_genuine_improvement(current, found, model), current, better
        )

    def _in_form_that_settles(
        self, settles: Callable[[Model], bool], current: Model, better: Model | None
    ) -> Model | None:
        """A better model if it passes the test `settles`; else one with another form of what was added that does."""
        if better is None or settles(better):
            return better
        # the simple form may be only a step towards the fuller one that the motor has
        added = set(better.effects) - set(current.effects)
        found = self.assess(better)
        best = self._better(better, found, self._in_other_forms(better, found, added))
        return best if best and settles(best) else None

    def _by_evidence(self, current: Model, found: Assessment) -> Model | None:
        """The best of the models that the evidence suggests."""
        return self._better(current, found, self._trials(current, found))

    def _better(
        self, current: Model, found: Assessment, tried: Sequence[Model | None]
    ) -> Model | None:
        """The best of some models after backward elimination; None if the current one is as good."""
        possible = [model for model in tried if self._is_new(model)]
        if not possible:
            return None
        best = self._best(possible, found.screen.white)
        # by the filter fitted without the clearest signal: one fitted to the current residuals absorbs what is missing
        ranked = self.comparison.ranked([current, best], found.screen.white)
        if simplest_equivalent(ranked) is current:
            return None
        return self.elimination.reduced(best)

    def _is_new(self, model: Model | None) -> TypeGuard[Model]:
        """Whether a model exists, is physically possible, and was not superseded by a better one."""
        return model is not None and model.is_possible and model not in self.superseded

    def _is_genuine_improvement(self, current: Model, found: Assessment, better: Model) -> bool:
        """Whether a better model does more than compensate for model-form error of the current one's effects.

        It does if what was left is clearly something else, if the better one leaves little, if it adds a refit-only
        form, or an effect on other axes that makes the unfiltered misfit decisively smaller.
        """
        added = set(better.effects) - set(current.effects)
        if added & set(REFIT_ONLY.values()):
            return True
        decisive = better.fit.fitness < current.fit.fitness / DECISIVE_RATIO
        on_other_axes = not any(has_axes_of(current, EFFECTS[effect]) for effect in added)
        if current.effects and decisive and on_other_axes:
            return True
        return found.exceeds_model_form_error(current) or self._leaves_little(current, better)

    def _leaves_little(self, current: Model, better: Model) -> bool:
        """Whether a better model leaves nothing significant, or little compared with what it takes away."""
        found = self.assess(better)
        if found.p_value >= FALSE_ALARM:
            return True
        white = self.comparison.filter_of(better)
        before, after = (self.comparison.fitted(m, white).squares for m in (current, better))
        added = len(better.effects) > len(current.effects)
        strict = added and not self.assess(current).is_unrelated_to(current)
        share = STRICT_REST if strict else LENIENT_REST
        return bool(found.clearest.gain < share * (before - after))

    def _by_likeliest_effect(self, current: Model, found: Assessment) -> Model | None:
        """The current model with the effect of the largest gain, however small that is, if it then leaves little.

        An effect gains more in a refit than to first order if its absence biases the parameters of others, or if the
        motor's have moved far to compensate for two effects.
        """
        if not self._is_room_for_another(current, found):
            return None
        if current.effects:
            others = [s for s in clear_signals(found) if effect_of(s) not in current.effects]
            likeliest = _of_largest_gain(others)
        else:
            likeliest = shortlist(current, found)
        return self._if_little_is_left(current, found, likeliest)

    def _by_earlier_evidence(self, current: Model, found: Assessment) -> Model | None:
        """The current model with the effect of the largest gain among those that were clear before its own were added,
        if it then leaves little: the whitening filter of what is left now may absorb it."""
        if not self._is_room_for_another(current, found):
            return None
        present = set(current.effects)
        earlier = [self.assess(m) for m in self.superseded if set(m.effects) < present]
        clear = {effect_of(s) for assessment in earlier for s in clear_signals(assessment)}
        others = [s for s in found.candidate_signals if effect_of(s) in clear - present]
        return self._if_little_is_left(current, found, _of_largest_gain(others))

    def _is_room_for_another(self, current: Model, found: Assessment) -> bool:
        """Whether one more effect may be missing, rather than model-form error or an error of a sensor."""
        return (
            len(current.effects) < MAX_EFFECTS
            and found.p_value < FALSE_ALARM
            and not found.may_be_model_form_error(current)
            and not found.is_sensor_error()
        )

    def _if_little_is_left(
        self, current: Model, found: Assessment, signals: Sequence[Signal]
    ) -> Model | None:
        """The best of the models with the effect of each signal, in a form in which it leaves little."""
        better = self._better(current, found, self._with_signals(current, found, signals))
        return self._in_form_that_settles(
            lambda model: self._leaves_little(current, model), current, better
        )

    def _by_unfiltered_misfit(self, current: Model, found: Assessment) -> Model | None:
        """The current model with one of the effects that gain most on the unfiltered misfit, if that falls by a factor
        of `DECISIVE_RATIO`: a whitening filter absorbs as noise what lasts as long as a short run."""
        decisive = current.fit.fitness / DECISIVE_RATIO
        full = len(current.effects) == MAX_EFFECTS
        if full or found.p_value >= FALSE_ALARM or decisive < current.given.problem.outputs:
            return None
        unfiltered = found.screen._replace(evidence=found.screen.unfiltered)
        least = MIN_UNFILTERED_SHARE * found.screen.unfiltered.regress().squares
        promising = most_promising(found.unfiltered_signals(), set(current.effects), least)
        tried = [self.refits.with_signal(current, s, unfiltered) for s in promising]
        better = [m for m in tried if m is not None and m.fit.fitness < decisive]
        return self._better(current, found, better)

    def _by_exchange(self, current: Model, found: Assessment) -> Model | None:
        """A model with `MAX_EFFECTS` effects, with the new one of largest gain in place of one in the same equation."""
        if (
            len(current.effects) < MAX_EFFECTS
            or found.p_value >= FALSE_ALARM
            or found.is_negligible(current)
        ):
            return None
        others = [s for s in clear_signals(found) if effect_of(s) not in current.effects]
        if not others:
            return None
        new = effect_of(max(others, key=lambda s: s.gain))
        tried: list[Model | None] = []
        for old in current.effects:
            if EFFECTS[old].equation == EFFECTS[new].equation:
                smaller = self.refits.without(current, old, found.screen.white)
                without_old = self.assess(smaller)
                of_new = [s for s in without_old.candidate_signals if effect_of(s) == new][:1]
                tried += self._with_signals(smaller, without_old, of_new)
        return self._better(current, found, tried)

    def without(self, named: Naming, effect: str) -> Naming:
        """The naming for the chosen set without one of its effects."""
        white = self.comparison.filter_of(named.chosen)
        return self._naming(self.refits.without(named.chosen, effect, white))

    def _naming(self, current: Model) -> Naming:
        """The naming with a model as the chosen one."""
        base, found = self.assess(self.base), self.assess(current)
        more_missing = found.p_value < FALSE_ALARM
        curves = [block for block in found.screen.curve_blocks if not block.per_run]
        return Naming(
            chosen=current,
            rivals=rivals_of(current, found, self.refits, self.comparison),
            base_screen=base.screen,
            chosen_screen=found.screen,
            p_nothing=base.p_value,
            p_nothing_more=found.p_value,
            may_be_model_form_error=found.may_be_model_form_error(current),
            leaves_sensor_error=more_missing and found.is_sensor_error(),
            noise_share=np.sqrt(share_beyond(found.screen, curves)) if more_missing else 1.0,
            p_without=p_values_without(current, found.screen.white, self.refits, self.comparison),
            final_fit=final_fit(current, self.comparison.filter_of(current)),
            line=line_of(current),
            varies=varying_parameter(current, found),
        )

    def _trials(self, current: Model, found: Assessment) -> list[Model | None]:
        """The current model with one effect more, or with a richer or refit-only form of one that it has."""
        present = set(current.effects)
        if len(present) == MAX_EFFECTS:
            return []
        if found.is_negligible(current):
            unrelated = found.is_unrelated_to(current)
            one_more = (shortlist if unrelated else richer_form)(current, found)
            return self._with_signals(current, found, one_more)
        refit_only = []
        if not found.is_clearly_effect():
            refit_only = self._with_refit_only_forms(current, found, present)
        if any(self._is_sufficient(model) for model in refit_only):
            return refit_only
        tried = []
        if found.calls_for_effect():
            tried += self._with_signals(current, found, shortlist(current, found))
            if any(model and model.effects_at_end for model in tried):
                # not a richer form alone: asymmetric friction, at its bound, is no load larger than friction
                tried += self._with_signals(current, found, additional_effects(current, found))
        if found.p_value < FALSE_ALARM and not present:
            tried += self._searched_with_friction(current, found, tried)
        return tried + refit_only

    def _is_sufficient(self, model: Model | None) -> bool:
        """Whether a model leaves nothing that is worth another trial.

        If a refit-only form is sufficient, no other effect is tried: what a simple form leaves of gear teeth may look
        like many.
        """
        if model is None or not model.is_possible:
            return False
        found = self.assess(model)
        return found.p_value >= FALSE_ALARM or found.is_negligible(model)

    def _searched_with_friction(
        self, current: Model, found: Assessment, tried: Sequence[Model | None]
    ) -> list[Model | None]:
        """The motor with Coulomb friction from a new global search, if stiction may explain a large misfit.

        A rotor that sticks for long is too far from one that creeps for first-order evidence. So this is tried if no
        possible model was `tried`, or the best of them is far from the noise, and a leading effect makes a rotor stick.
        The result must cut the misfit by a factor of `DECISIVE_RATIO`. With a load, too, where asymmetric friction
        ended at a bound: a load larger than friction drives the rotor in one direction.
        """
        possible = [model for model in tried if model is not None and model.is_possible]
        if possible:
            nearest = min(possible, key=lambda m: m.fit.fitness)
            suspects, noise = nearest.effects, POOR_MISFIT * current.given.problem.outputs
        else:
            by_gain = sorted(found.candidate_signals, key=lambda s: -s.gain)
            suspects = tuple(dict.fromkeys(effect_of(s) for s in by_gain))[:SHORTLIST]
            nearest, noise = current, current.given.problem.outputs
        sticks = any(EFFECTS[effect].holds == "speed" for effect in suspects)
        decisive = nearest.fit.fitness / DECISIVE_RATIO
        if not sticks or decisive < noise:  # not even a perfect fit would cut the misfit so far
            return []
        searched = [self.refits.with_global_search(current, "coulomb_friction")]
        if "asymmetric_friction" in nearest.effects_at_end:
            searched.append(self.refits.with_global_search(searched[0], "constant_load"))
        return [model for model in searched if model.fit.fitness < decisive]

    def _in_other_forms(
        self, model: Model, found: Assessment, added: set[str]
    ) -> list[Model | None]:
        """The model with the effects added last replaced by a richer or a refit-only form."""
        richer = richer_form(model, found, TRIAL_SHARE)
        of_added = [s for s in richer if CONTAINS[effect_of(s)] & added]
        replaced = self._with_signals(model, found, of_added)
        return replaced + self._with_refit_only_forms(model, found, added)

    def _equivalent_swaps(self, current: Model, found: Assessment) -> list[Model | None]:
        """The model with one effect replaced by another that was as good when it was added, or that resembles it
        (`Trial.alike`)."""
        if len(current.effects) < 2:
            return []
        return [
            self.refits.with_replacement(current, found.screen.white, effect, other)
            for effect in current.effects
            for other in sorted(
                (self.equivalents.get(effect, set()) | TRIALS[effect].alike.keys())
                - set(current.effects)
            )
        ]

    def _with_signals(
        self, current: Model, found: Assessment, signals: Sequence[Signal]
    ) -> list[Model | None]:
        """The model with the effect of each signal."""
        return [self.refits.with_signal(current, s, found.screen) for s in signals]

    def _with_refit_only_forms(
        self, current: Model, found: Assessment, effects: set[str]
    ) -> list[Model | None]:
        """The model with each of some effects replaced by its refit-only form, if it has one."""
        return [
            self.refits.with_replacement(current, found.screen.white, simpler, REFIT_ONLY[simpler])
            for simpler in sorted(effects & REFIT_ONLY.keys())
        ]

    def assess(self, model: Model) -> Assessment:
        """The evidence against a model, gathered once."""
        if model not in self.assessments:
            self.assessments[model] = self._assessed(model)
        return self.assessments[model]

    def _assessed(self, model: Model) -> Assessment:
        found = screen(model, self.library)
        candidate_signals, curve_signals = signals(found)
        count = len(found.candidates) + len(found.curves)
        count *= MAX_EFFECTS if model.effects else 1
        p_value = (
            1.0 if model.is_exact else familywise_p_value(candidate_signals, curve_signals, count)
        )
        explained = 0.0
        if model.effects:
            base, fitted = (self.comparison.fitted(m, found.white) for m in (self.base, model))
            explained = base.squares - fitted.squares
        explained_unfiltered = self.base.fit.fitness - model.fit.fitness
        return Assessment(
            found, candidate_signals, curve_signals, p_value, explained, explained_unfiltered
        )

    def _best(self, tried: Sequence[Model], white: Whitener) -> Model:
        """The best of some refits, compared by the whitening filter of the one with the least squares."""
        if len(tried) == 1:
            return tried[0]
        least = self.comparison.ranked(tried, white)[0].model
        ranked = self.comparison.ranked(tried, self.comparison.filter_of(least))
        best = simplest_equivalent(ranked)
        self._note_equivalents(best, ranked)
        return best

    def _note_equivalents(self, best: Model, ranked: Sequence[Fitted]) -> None:
        """Record the effects that are as good as one of the best model's (within `BIC_MARGIN`)."""
        chosen = set(best.effects)
        least = next(f.criterion for f in ranked if f.model is best)
        for other in (f for f in ranked if f.criterion < least + BIC_MARGIN):
            rival = set(other.model.effects)
            if len(chosen - rival) == len(rival - chosen) == 1 and are_rivals(chosen, rival):
                self.equivalents.setdefault(*(chosen - rival), set()).update(rival - chosen)


def _of_largest_gain(signals: Sequence[Signal]) -> list[Signal]:
    """The signal of the largest gain; empty if there is none."""
    return sorted(signals, key=lambda s: -s.gain)[:1]
