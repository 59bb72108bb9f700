"""Which effects are missing: forward selection from the motor without effects, each step refitted in full simulation.

`proposals` are what a step tries; here it is decided whether one of them is better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple, TypeGuard

import numpy as np

from ...effects import EFFECTS
from ...identify.corrections.gradual_brushes import with_gradual_brushes
from ...identify.corrections.initial_temperature import with_initial_temperatures
from ...identify.corrections.uneven_sampling import with_even_clock
from ...identify.fit.fitted_runs import FittedRuns
from ...identify.noise.noise_model import Whitener
from ...identify.noise.spectral_lines import Line
from ...identify.solve import Solved
from ...progress import ReportProgress
from ..diagnosis import VaryingParameter
from ..evidence.assessment import FALSE_ALARM, REFIT_ONLY, Assessment, has_axes_of
from ..evidence.constancy import varying_parameter
from ..evidence.periodic import line_of
from ..evidence.screen import screen, share_beyond
from ..evidence.signals import Screen
from ..hypotheses.effect_relations import are_rivals
from ..hypotheses.library import Library
from ..model import MAX_EFFECTS, Model, final_fit, model_of
from .compare import BIC_MARGIN, DECISIVE_RATIO, Comparison, Fitted, is_decisively_better, simplest_equivalent
from .elimination import BackwardElimination
from .proposals import Proposals, Proposed
from .refits import Refits
from .rivals import p_values_without, rivals_of

# What a better model may still leave, as a share of the squares that it takes away (`_leaves_little`)
STRICT_REST = 0.1
# The same where an effect was replaced by another form, or where the effects before cannot have left the misfit
LENIENT_REST = 0.5
# Where the clearest signal gains a smaller share of what the model explains, the whitening filter may have absorbed an
# effect: the unfiltered misfit is examined first
ABSORBED_SHARE = 1e-2

# Whether a better model, the second, is accepted in place of the first
Accepts = Callable[[Model, Model], bool]


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
    leaves_small_ripple: bool  # whether it is a ripple of the speed sensor that is far below its noise
    # root mean square of the chosen one's residuals beyond all curves over that of all; 1 if nothing more is missing
    noise_share: float
    p_without: dict[str, float]  # by effect of the chosen model: p-value of the data without it
    final_fit: FittedRuns  # of the chosen model
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
        self.assess = cache(self._assess)
        # by effect: alternatives that were as good when it was added
        self.equivalents: dict[str, set[str]] = {}
        # models that are not returned to: by different filters, each of two may look like the better one
        self.superseded: set[Model] = set()
        self.proposals = Proposals(self.refits, self.assess, self.superseded)
        self.elimination = BackwardElimination(self.refits, self.comparison, self.assess, self._is_new)

    def select(self) -> Naming:
        """Add effects while the evidence calls for them; then try other effects in place of those found."""
        current = self.base
        self.superseded.add(current)
        while better := self._step(current):
            current = self._with_refined_runs(self._at_better_optimum(self._without_needless(better)))
            self.superseded.add(current)
        others = self.proposals.by_swap(current, self.equivalents)
        # even if little is left: what backlash leaves is small beside what a large effect explains
        if self.assess(current).p_value < FALSE_ALARM:
            others += self.proposals.in_refit_only_forms(current, set(current.effects))
        chosen = self._better(current, others) or current
        return self._without_compensation(self._naming(chosen))

    def without(self, named: Naming, effect: str) -> Naming:
        """The naming for the chosen set without one of its effects."""
        white = self.comparison.filter_of(named.chosen)
        return self._naming(self.refits.without(named.chosen, effect, white))

    def _assess(self, model: Model) -> Assessment:
        """The evidence against a model."""
        evidence, candidate_signals, curve_signals, log_p = screen(model, self.library)
        count = len(evidence.candidates) + len(evidence.curves)
        count *= MAX_EFFECTS if model.effects else 1
        p_value = float(min(1.0, count * np.exp(log_p)))  # Bonferroni-corrected
        if model.is_exact or max(s.gain for s in (*candidate_signals, *curve_signals)) < evidence.least_gain:
            p_value = 1.0
        explained = 0.0
        if model.effects:
            base, fitted = (self.comparison.fitted(m, evidence.white) for m in (self.base, model))
            explained = base.squares - fitted.squares
        explained_unfiltered = self.base.fit.fitness - model.fit.fitness
        viscous_share = float(model.motor.f / self.base.motor.f)
        return Assessment(
            evidence, candidate_signals, curve_signals, p_value, explained, explained_unfiltered, viscous_share
        )

    def _with_refined_runs(self, model: Model) -> Model:
        """The model with the samples of an uneven clock shifted along its own motion, and with runs that begin with a
        warm winding, or a brush drop that sets in gradually, if that is clearly likelier: other effects would seem to
        be missing without."""
        for refine in (with_even_clock, with_initial_temperatures, with_gradual_brushes):
            refined = refine(model.fitted)
            if refined.prepared is not model.prepared:
                self.superseded.add(model)
                model = self.refits.replace(model_of(refined))
        return model

    def _without_needless(self, model: Model) -> Model:
        """The model just accepted, without an effect that would not be accepted beside the others as they are fitted
        now: where a rotor sticks and slips, it may only have led them to a better optimum."""
        for smaller in self.refits.without_each(model, model.effects, self.comparison.filter_of(model)):
            if smaller.effects and self._is_new(smaller) and self._is_enough(smaller, model):
                self.superseded.add(model)
                return smaller
        return model

    def _is_enough(self, smaller: Model, model: Model) -> bool:
        """Whether a model without one of the effects of another would not be extended by it: too little is left for a
        trial, or more than the other one explains."""
        leaves_more = self.assess(model).p_value < FALSE_ALARM
        if leaves_more and not self._is_genuine_improvement(smaller, model):
            return True
        if is_decisively_better(model, smaller):
            return False  # without the evidence against the smaller one, which is slow to gather
        assessment = self.assess(smaller)
        return assessment.is_negligible(smaller) and not assessment.is_unrelated_to(smaller)

    def _at_better_optimum(self, model: Model) -> Model:
        """The model just accepted, or one found around it that leaves far less, without an effect that is not needed
        there."""
        better = self.refits.searched_around(model)
        if better is model:
            return model
        self.superseded.add(model)
        return self._without_needless(better)

    def _step(self, current: Model) -> Model | None:
        """The next model: of several kinds of proposals the first that is better and accepted; None if there is none.

        What gains little to first order is accepted only if it then leaves little.
        """
        propose, genuine, little = self.proposals, self._is_genuine_improvement, self._leaves_little
        unfiltered = [(propose.by_unfiltered_misfit, genuine)]
        absorbed = self.assess(current).unexplained < ABSORBED_SHARE
        kinds: list[tuple[Callable[[Model], Proposed], Accepts]] = [
            (propose.by_search_with_friction, genuine),
            *(unfiltered if absorbed else []),
            (propose.by_evidence, genuine),
            (propose.by_largest_gain, little),
            *([] if absorbed else unfiltered),
            (propose.by_earlier_evidence, little),
            (propose.by_exchange, genuine),
        ]
        for proposed, accepts in kinds:
            better = self._better(current, proposed(current))
            if accepted := self._in_accepted_form(accepts, current, better):
                return accepted
        return None

    def _in_accepted_form(self, accepts: Accepts, current: Model, better: Model | None) -> Model | None:
        """A better model if it is accepted; else one with another form of what was added that is."""
        if better is None or accepts(current, better):
            return better
        # the simple form may be only a step towards the fuller one that the motor has
        added = set(better.effects) - set(current.effects)
        best = self._better(better, self.proposals.in_other_forms(better, added))
        return best if best and accepts(current, best) else None

    def _better(self, current: Model, tried: Sequence[Model | None]) -> Model | None:
        """The best of some models after backward elimination; None if the current one is as good."""
        possible = [model for model in tried if self._is_new(model)]
        if not possible:
            return None
        # by the filter fitted without the clearest signal: one fitted to the current residuals absorbs what is missing
        white = self.assess(current).screen.white
        best = self._best(possible, white)
        if simplest_equivalent(self.comparison.ranked([current, best], white)) is current:
            return None
        return self.elimination.reduced(best)

    def _is_new(self, model: Model | None) -> TypeGuard[Model]:
        """Whether a model exists, is physically possible, and was not superseded by a better one."""
        return model is not None and model.is_possible and model not in self.superseded

    def _is_genuine_improvement(self, current: Model, better: Model) -> bool:
        """Whether a better model does more than compensate for model-form error of the current one's effects.

        It does if what was left is clearly something else, if the better one leaves little, if it adds a refit-only
        form, or an effect on other axes that makes the unfiltered misfit decisively smaller.
        """
        added = set(better.effects) - set(current.effects)
        if added & set(REFIT_ONLY.values()):
            return True
        on_other_axes = not any(has_axes_of(current, EFFECTS[effect]) for effect in added)
        if current.effects and on_other_axes and _comes_decisively_nearer(current, better):
            return True
        assessment = self.assess(current)
        return assessment.exceeds_model_form_error(current) or self._leaves_little(current, better)

    def _leaves_little(self, current: Model, better: Model) -> bool:
        """Whether a better model leaves nothing significant, or little compared with what it takes away."""
        assessment = self.assess(better)
        if assessment.p_value >= FALSE_ALARM:
            return True
        white = self.comparison.filter_of(better)
        before, after = (self.comparison.fitted(m, white).squares for m in (current, better))
        added = len(better.effects) > len(current.effects)
        strict = added and not self.assess(current).is_unrelated_to(current)
        share = STRICT_REST if strict else LENIENT_REST
        return bool(assessment.clearest.gain < share * (before - after))

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
        limit = more * np.log(self.base.problem.most_samples) + BIC_MARGIN
        return named if 2 * gain > limit else plain

    def _naming(self, current: Model) -> Naming:
        """The naming with a model as the chosen one."""
        base, assessment = self.assess(self.base), self.assess(current)
        more_missing = assessment.p_value < FALSE_ALARM
        curves = [block for block in assessment.screen.curve_blocks if not block.per_run]
        return Naming(
            chosen=current,
            rivals=rivals_of(current, assessment, self.refits, self.comparison),
            base_screen=base.screen,
            chosen_screen=assessment.screen,
            p_nothing=base.p_value,
            p_nothing_more=assessment.p_value,
            may_be_model_form_error=assessment.may_be_model_form_error(current),
            leaves_sensor_error=more_missing and assessment.is_sensor_error(),
            leaves_small_ripple=more_missing and assessment.is_small_ripple(),
            noise_share=np.sqrt(share_beyond(assessment.screen, curves)) if more_missing else 1.0,
            p_without=p_values_without(current, assessment.screen.white, self.refits, self.comparison),
            final_fit=final_fit(current, self.comparison.filter_of(current)),
            line=line_of(current),
            varies=varying_parameter(current, assessment),
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


def _comes_decisively_nearer(current: Model, better: Model) -> bool:
    """Whether a better model takes away most of what one far from the noise leaves beyond it."""
    noise = current.problem.perfect_fitness
    far, nearer = (model.fit.fitness / noise for model in (current, better))
    return bool(far > DECISIVE_RATIO and nearer - 1 < (far - 1) / DECISIVE_RATIO)
