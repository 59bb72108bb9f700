"""Models that a step of the selection tries: with one effect more, or with another form of one that is there.

A *richer* form of an effect contains and replaces it, as Stribeck friction does Coulomb friction; a *refit-only* form
has no column in the regression, such as backlash for a compliant shaft.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from operator import attrgetter

from ...effects import EFFECTS
from ..evidence.assessment import FALSE_ALARM, REFIT_ONLY, TRIAL_SHARE, Assessment
from ..evidence.signals import Signal
from ..hypotheses.effect_relations import CONTAINS, covered_by, may_hold_rotor
from ..hypotheses.trials import TRIALS
from ..model import MAX_EFFECTS, POOR_MISFIT, Model
from .compare import DECISIVE_RATIO, is_decisively_better
from .refits import Refits
from .shortlist import (
    SHORTLIST,
    additional_effects,
    clear_new_signals,
    clear_signals,
    most_promising,
    of_largest_gain,
    richer_form,
    shortlist,
)

# Least share of the unfiltered squares that a candidate must promise to be tried on the unfiltered misfit
MIN_UNFILTERED_SHARE = 0.05

# What a refit-only form may leave of what its simple form left unexplained, to be all that is missing
MAX_REST = 0.5

# None where physics forbids the coefficients found
Proposed = list[Model | None]


class Proposals:
    """Refits what may be better than a model; which of it is, `naming` decides."""

    def __init__(self, refits: Refits, assess: Callable[[Model], Assessment], superseded: Set[Model]) -> None:
        """`assess` gathers the evidence against a model; `superseded` are those that a better one has replaced."""
        self.refits, self.assess, self.superseded = refits, assess, superseded

    def by_evidence(self, current: Model) -> Proposed:
        """The current model with one effect more, or with a richer or refit-only form of one that it has."""
        assessment, present = self.assess(current), set(current.effects)
        if len(present) == MAX_EFFECTS:
            return []
        if assessment.is_negligible(current):
            unrelated = assessment.is_unrelated_to(current)
            one_more = (shortlist if unrelated else richer_form)(current, assessment)
            return self._with_signals(current, one_more)
        refit_only = []
        if not assessment.is_clearly_effect():
            refit_only = self.in_refit_only_forms(current, present)
        if any(self._is_sufficient(model, assessment) for model in refit_only):
            return refit_only
        tried = []
        if assessment.calls_for_effect():
            tried += self._with_signals(current, shortlist(current, assessment))
            if any(model and model.effects_at_end for model in tried):
                # not a richer form alone: asymmetric friction, at its bound, is no load larger than friction
                tried += self._with_signals(current, additional_effects(current, assessment))
        if assessment.p_value < FALSE_ALARM and not present:
            tried += self._searched_with_friction(current, tried)
        return tried + refit_only

    def by_largest_gain(self, current: Model) -> Proposed:
        """The current model with the effect of the largest gain, however small that is.

        An effect gains more in a refit than to first order if its absence biases the parameters of others, or if the
        motor's have moved far to compensate for two effects.
        """
        assessment = self.assess(current)
        if not _may_add_effect(current, assessment):
            return []
        if current.effects:
            likeliest = of_largest_gain(clear_new_signals(current, assessment))
        else:
            likeliest = shortlist(current, assessment)
        return self._with_signals(current, likeliest)

    def by_earlier_evidence(self, current: Model) -> Proposed:
        """The current model with the effect of the largest gain among those that were clear before its own were added:
        the whitening filter of what is left now may absorb it."""
        assessment = self.assess(current)
        if not _may_add_effect(current, assessment):
            return []
        present = set(current.effects)
        earlier = [self.assess(m) for m in self.superseded if set(m.effects) < present]
        absent = {s.effect for before in earlier for s in clear_signals(before)} - covered_by(present)
        others = [s for s in assessment.candidate_signals if s.effect in absent]
        return self._with_signals(current, of_largest_gain(others))

    def by_unfiltered_misfit(self, current: Model) -> Proposed:
        """The current model with one of the effects that gain most on the unfiltered misfit, if that falls by a factor
        of `DECISIVE_RATIO`: a whitening filter absorbs as noise what lasts as long as a short run, or as a rotor sticks
        that does so at other moments than the measured one."""
        assessment, full = self.assess(current), len(current.effects) == MAX_EFFECTS
        may_hide = current.is_poor and any(map(may_hold_rotor, current.effects))
        if full or not _may_improve_decisively(current) or (assessment.p_value >= FALSE_ALARM and not may_hide):
            return []
        unfiltered = assessment.screen._replace(evidence=assessment.screen.unfiltered)
        least = MIN_UNFILTERED_SHARE * assessment.screen.unfiltered.regress().squares
        promising = most_promising(assessment.unfiltered_signals(), covered_by(current.effects), least)
        tried = self.refits.with_signals(current, promising, unfiltered)
        return [m for m in tried if m is not None and is_decisively_better(m, current)]

    def by_search_with_friction(self, current: Model) -> Proposed:
        """The current model with Coulomb friction from a new global search, where its effects leave much of the misfit
        and friction, clear before they were added, is so no more.

        Effects that were fitted to a rotor that sticks, without friction, are too far from the truth to show it.
        """
        assessment, present = self.assess(current), set(current.effects)
        if not 0 < len(present) < MAX_EFFECTS or any(map(may_hold_rotor, present)) or assessment.p_value >= FALSE_ALARM:
            return []
        if not (current.is_poor and assessment.leaves_unfiltered_misfit(current)):
            return []
        earlier = [self.assess(m) for m in self.superseded if set(m.effects) < present]
        if _shows_friction(assessment) or not any(map(_shows_friction, earlier)):
            return []
        searched = self.refits.with_global_search(current, "coulomb_friction")
        return [searched] if is_decisively_better(searched, current) else []

    def by_exchange(self, current: Model) -> Proposed:
        """A model with `MAX_EFFECTS` effects, with the new one of largest gain in place of one in the same equation."""
        assessment = self.assess(current)
        if len(current.effects) < MAX_EFFECTS or assessment.p_value >= FALSE_ALARM or assessment.is_negligible(current):
            return []
        others = clear_new_signals(current, assessment)
        if not others:
            return []
        new = max(others, key=attrgetter("gain")).effect
        tried: Proposed = []
        for old in current.effects:
            if EFFECTS[old].equation == EFFECTS[new].equation:
                smaller = self.refits.without(current, old, assessment.screen.white)
                signals = self.assess(smaller).candidate_signals
                of_new = [s for s in signals if s.effect == new][:1]
                tried += self._with_signals(smaller, of_new)
        return tried

    def in_other_forms(self, model: Model, added: set[str]) -> Proposed:
        """The model with the effects added last replaced by a richer or a refit-only form."""
        richer = richer_form(model, self.assess(model), TRIAL_SHARE)
        of_added = [s for s in richer if CONTAINS[s.effect] & added]
        replaced = self._with_signals(model, of_added)
        return replaced + self.in_refit_only_forms(model, added)

    def in_refit_only_forms(self, model: Model, effects: set[str]) -> Proposed:
        """The model with each of some effects replaced by its refit-only form, if it has one."""
        white = self.assess(model).screen.white
        forms = [(simpler, REFIT_ONLY[simpler]) for simpler in sorted(effects & REFIT_ONLY.keys())]
        return self.refits.with_replacements(model, white, forms)

    def by_swap(self, current: Model, equivalents: Mapping[str, set[str]]) -> Proposed:
        """The model with one effect replaced by one of its `equivalents`, that was as good when it was added, or by one
        that resembles it (`Trial.alike`)."""
        if len(current.effects) < 2:
            return []
        white = self.assess(current).screen.white
        swaps = [
            (effect, other)
            for effect in current.effects
            for other in sorted((equivalents.get(effect, set()) | TRIALS[effect].alike.keys()) - set(current.effects))
        ]
        return self.refits.with_replacements(current, white, swaps)

    def _is_sufficient(self, model: Model | None, before: Assessment) -> bool:
        """Whether a refit-only form leaves nothing that is worth another trial, and most of what was left `before`
        is gone.

        If it is, no other effect is tried: what a simple form leaves of gear teeth may look like many.
        """
        if model is None or not model.is_possible:
            return False
        assessment = self.assess(model)
        if assessment.p_value >= FALSE_ALARM:
            return True
        return assessment.is_negligible(model) and assessment.unexplained < MAX_REST * before.unexplained

    def _searched_with_friction(self, current: Model, tried: Sequence[Model | None]) -> Proposed:
        """The motor with Coulomb friction from a new global search, if stiction may explain a large misfit.

        A rotor that sticks for long is too far from one that creeps for first-order evidence. So this is tried if no
        possible model was `tried`, or the best of them is far from the noise, and a leading effect makes a rotor stick.
        The result must cut the misfit by a factor of `DECISIVE_RATIO`. With a load, too, where asymmetric friction
        ended at a bound: a load larger than friction drives the rotor in one direction.
        """
        possible = [model for model in tried if model is not None and model.is_possible]
        if possible:
            nearest = min(possible, key=lambda m: m.fit.fitness)
            suspects, rest = nearest.effects, POOR_MISFIT
        else:
            by_gain = sorted(self.assess(current).candidate_signals, key=lambda s: -s.gain)
            suspects = tuple(dict.fromkeys(s.effect for s in by_gain))[:SHORTLIST]
            nearest, rest = current, 1.0
        if not any(map(may_hold_rotor, suspects)) or not _may_improve_decisively(nearest, rest):
            return []
        searched = [self.refits.with_global_search(current, "coulomb_friction")]
        if "asymmetric_friction" in nearest.effects_at_end:
            searched.append(self.refits.with_global_search(searched[0], "constant_load"))
        return [model for model in searched if is_decisively_better(model, nearest)]

    def _with_signals(self, current: Model, signals: Sequence[Signal]) -> Proposed:
        """The model with the effect of each signal."""
        return self.refits.with_signals(current, signals, self.assess(current).screen)


def _may_improve_decisively(model: Model, rest: float = 1.0) -> bool:
    """Whether a model leaves so much that another one could be decisively better, although that leaves the noise, or
    the `rest`, in noise variances of each output."""
    return model.fit.fitness / DECISIVE_RATIO >= rest * model.problem.perfect_fitness


def _shows_friction(assessment: Assessment) -> bool:
    """Whether the evidence clearly shows an effect that may hold the rotor at rest."""
    return any(may_hold_rotor(signal.effect) for signal in clear_signals(assessment))


def _may_add_effect(current: Model, assessment: Assessment) -> bool:
    """Whether one more effect may be missing, rather than model-form error or an error of a sensor."""
    return (
        len(current.effects) < MAX_EFFECTS
        and assessment.p_value < FALSE_ALARM
        and not assessment.may_be_model_form_error(current)
        and not assessment.is_sensor_error()
    )
