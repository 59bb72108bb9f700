"""Confidence in the chosen effects: other sets that are as good, and the likelihood ratio without each effect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from scipy import stats

from ...identify.noise.noise_model import Whitener
from ..evidence.assessment import FALSE_ALARM, Assessment
from ..hypotheses.effect_relations import FULLER, are_rivals
from ..model import Model
from .compare import BIC_MARGIN, Comparison, simplest_equivalent
from .refits import Refits

# A fuller form of an effect is ruled out if it leaves so many more squares, in noise variances: two standard errors
RULED_OUT = 4.0
# Share of what the chosen set does not explain that widens the margin within which other sets are rivals
UNEXPLAINED_SHARE = 0.1


def rivals_of(chosen: Model, assessment: Assessment, refits: Refits, comparison: Comparison) -> list[Model]:
    """Other sets that explain the runs as well, the best first, then the chosen one with each fuller form that is not
    ruled out, or would have been chosen by the filter of its own residuals."""
    white = assessment.screen.white
    models = [chosen, *(m for m in refits.models.values() if m.is_possible)]
    unexplained = assessment.clearest.gain if assessment.p_value < FALSE_ALARM else 0.0
    margin = BIC_MARGIN + UNEXPLAINED_SHARE * unexplained
    ranked = comparison.ranked(models, white, margin)
    least = next(f.criterion for f in ranked if f.model is chosen)
    near = [f.model for f in ranked if f.criterion < least + margin]
    rivals = [m for m in near if are_rivals(set(m.effects), set(chosen.effects))]
    # with the fuller form held clearly present: a free fit would return to the simple form where the runs show little
    simple = [effect for effect in chosen.effects if effect in FULLER]
    limit = comparison.fitted(chosen, white).squares + RULED_OUT
    fuller = [refits.with_fuller_form_held(chosen, white, effect, limit) for effect in simple]
    possible = [m for m in fuller if comparison.fitted(m, white, limit).squares < limit]
    return [*rivals, *possible, *_better_by_own_filter(chosen, simple, refits, comparison)]


def _better_by_own_filter(
    chosen: Model, simple: Sequence[str], refits: Refits, comparison: Comparison
) -> Iterator[Model]:
    """The chosen set with one of its `simple` forms replaced by the fuller one, where that leaves less and is better by
    the filter of what it leaves: where teeth meet at moments that noise decides, each of two filters prefers its own
    model, and no run tells which is right."""
    for effect in simple:
        key = frozenset(chosen.effects) - {effect} | {FULLER[effect].effect}
        model = refits.models.get(key)
        if model is None or not model.is_possible or model.fit.fitness >= chosen.fit.fitness:
            continue
        if simplest_equivalent(comparison.ranked([chosen, model], comparison.filter_of(model))) is model:
            yield model


def p_values_without(chosen: Model, white: Whitener, refits: Refits, comparison: Comparison) -> dict[str, float]:
    """By effect of the chosen set, the p-value of the runs without it: a likelihood-ratio test, chi-squared with one
    degree of freedom for each of the effect's parameters."""
    p_values = {}
    smaller_models = refits.without_each(chosen, chosen.effects, white)
    for effect, smaller in zip(chosen.effects, smaller_models, strict=True):
        squares = {f.model.effects: f.squares for f in comparison.ranked([chosen, smaller], white)}
        gain = squares[smaller.effects] - squares[chosen.effects]
        p_values[effect] = float(stats.chi2.sf(max(gain, 0.0), len(chosen.motor.effect_named(effect).ranges)))
    return p_values
