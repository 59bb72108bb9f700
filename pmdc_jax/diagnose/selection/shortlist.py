"""Which effects to try next, by the evidence against a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...effects import EFFECTS
from ..evidence.assessment import EFFECT_SHARE, FALSE_ALARM, MODEL_FORM_SHARE, TRIAL_SHARE, Assessment
from ..evidence.signals import Signal
from ..hypotheses.effect_relations import CONTAINS, covered_by, with_split_friction
from ..hypotheses.trials import TRIALS
from ..model import Model

# Number of effects that are refitted in full simulation for one step
SHORTLIST = 3
# ... each with at least this share of the best one's gain to first order
COMPARABLE_GAIN = 0.6
# ... and with those whose gain is within this share of the last one's: rounding errors must not decide
TIED_GAIN = 1e-3


def shortlist(current: Model, assessment: Assessment) -> list[Signal]:
    """A richer form of an effect in the model alone, if it explains most of what is left; else `additional_effects`."""
    own_form = _may_be_form_of_clearest(current, assessment)
    richer = [] if own_form else richer_form(current, assessment)
    return richer or additional_effects(current, assessment)


def additional_effects(current: Model, assessment: Assessment) -> list[Signal]:
    """The most significant shape of each of the few effects that gain most and are not in the model.

    If what is left may be the model-form error of the clearest effect, only effects with `Trial.starts` are tried,
    which do more than their columns show; and none if it is a harmonic, which the teeth of a gear would imitate.
    """
    ranked = clear_new_signals(current, assessment)
    if _may_be_form_of_clearest(current, assessment):
        if assessment.is_harmonic_of(current):
            return []
        ranked = [s for s in ranked if TRIALS[s.effect].starts]
    # by gain: what may be slow noise has less significance, but is tried for what it explains
    ranked.sort(key=lambda s: -s.gain)
    # where little is left, an effect is accepted only if it explains nearly all of it, so weak ones do no harm
    share = 0.0 if assessment.unexplained < MODEL_FORM_SHARE else COMPARABLE_GAIN
    ranked = [s for s in ranked if s.gain > share * ranked[0].gain]
    least = ranked[:SHORTLIST][-1].gain if ranked else 0.0
    return [s for s in ranked if s.gain >= (1 - TIED_GAIN) * least]


def _may_be_form_of_clearest(current: Model, assessment: Assessment) -> bool:
    """Whether the most significant effect is in the model already, and what is left may be its model-form error.

    Not for an effect of a sensor, whose formula is exact, nor if another effect gains far more, however much that looks
    like slow noise.
    """
    significant = clear_signals(assessment)
    if not significant or assessment.unexplained >= MODEL_FORM_SHARE:
        return False
    first = significant[0]
    return (
        first.effect in current.effects
        and first.gain > TRIAL_SHARE * max(s.gain for s in significant)
        and EFFECTS[first.effect].equation != "sensor"
    )


def most_promising(signals: Sequence[Signal], present: set[str], least: float) -> list[Signal]:
    """The shape with the largest gain of each of the few effects that gain most, without those that are `present`.

    Each gains at least `least`, and at least `TRIAL_SHARE` of the best: a low limit, as the first-order gains of a fit
    far from the truth predict poorly what each effect would do.
    """
    best: dict[str, Signal] = {}
    for s in sorted(signals, key=lambda s: -s.gain):
        if s.effect not in present:
            best.setdefault(s.effect, s)
    ranked = list(best.values())[:SHORTLIST]
    return [s for s in ranked if s.gain > max(TRIAL_SHARE * ranked[0].gain, least)]


def clear_signals(assessment: Assessment) -> list[Signal]:
    """The most significant shape of every significant effect.

    A torque may look like slow noise because another one is missing, too. So an effect also counts if it gains much of
    what the most significant curve gains, and that curve is significant.
    """
    best: dict[str, Signal] = {}
    for s in assessment.candidate_signals:
        best.setdefault(s.effect, s)
    log_level, curve = (np.log(FALSE_ALARM / len(assessment.screen.candidates)), assessment.curve_signals[0])
    large_gain = TRIAL_SHARE * curve.gain if curve.log_p < log_level else np.inf
    return [s for s in best.values() if s.log_p < log_level or s.gain > large_gain]


def clear_new_signals(current: Model, assessment: Assessment) -> list[Signal]:
    """The clear signals of effects that neither the model has, nor one of its effects makes needless."""
    present = covered_by(current.effects)
    return [s for s in clear_signals(assessment) if s.effect not in present]


def richer_form(current: Model, assessment: Assessment, share: float = EFFECT_SHARE) -> list[Signal]:
    """The first clear effect that contains one of the model's and explains more than a `share` of what is left; at most
    one."""
    present = with_split_friction(set(current.effects))
    least = share * assessment.clearest.gain
    return [
        s
        for s in clear_signals(assessment)
        if CONTAINS.get(s.effect, set()) & present and s.effect not in current.effects and s.gain > least
    ][:1]


def of_largest_gain(signals: Sequence[Signal]) -> list[Signal]:
    """The signal of the largest gain; empty if there is none."""
    return sorted(signals, key=lambda s: -s.gain)[:1]
