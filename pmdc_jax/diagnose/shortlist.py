"""Which effects to try next, by the evidence against a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects import EFFECTS
from .assessment import ALARM, FORMULA, MOST_OF_IT, MUCH_OF_IT, Assessment
from .candidates import TRIALS
from .effect_relations import CONTAINS, spelt_out
from .model import Model
from .signals import Signal

# Number of effects that are refitted in full simulation for one step
SHORTLIST = 3
# ... each with at least this share of the best one's gain to first order
COMPARABLE = 0.6
# ... and with those whose gain is within this share of the last one's: rounding must not decide
TIED = 1e-3


def shortlist(current: Model, found: Assessment, fuller: bool = True) -> list[Signal]:
    """The most significant shape of each of the few effects that gain most.

    If the most significant effect is in the model already and little is left, the rest counts as its model-form error;
    only effects with `Trial.starts`, which do more than their columns show, are tried then. This does not hold for an
    effect of a sensor, whose formula is exact, nor if another effect gains far more, however much like slow noise it
    looks. With `fuller`, a richer form of an effect in the model that explains most of what is left is tried alone.
    """
    obvious = clear(found)
    ranked = [s for s in obvious if effect_of(s) not in current.effects]
    most = max((s.gain for s in obvious), default=0.0)
    own = bool(obvious) and effect_of(obvious[0]) in current.effects
    own = own and obvious[0].gain > MUCH_OF_IT * most
    exact = own and EFFECTS[effect_of(obvious[0])].equation == "sensor"
    if own and not exact and found.unexplained < FORMULA:
        ranked = [s for s in ranked if TRIALS[effect_of(s)].starts]
    elif fuller and (alone := richer(current, found)):
        return alone
    # by gain: what may be slow noise has less significance, but is tried for what it explains
    ranked.sort(key=lambda s: -s.gain)
    # where little is left, an effect is accepted only if it explains nearly all of it, so weak ones do no harm
    share = 0.0 if found.unexplained < FORMULA else COMPARABLE
    ranked = [s for s in ranked if s.gain > share * ranked[0].gain]
    least = ranked[:SHORTLIST][-1].gain if ranked else 0.0
    return [s for s in ranked if s.gain >= (1 - TIED) * least]


def promising(signals: Sequence[Signal], here: set[str], least: float) -> list[Signal]:
    """The shape with the largest gain of each of the few effects that gain most, without those that are `here`.

    Each gains at `least` so much, and at least `MUCH_OF_IT` of the best: a low limit, as the first-order gains of a fit
    far from the truth predict poorly what each effect would do.
    """
    best: dict[str, Signal] = {}
    for s in sorted(signals, key=lambda s: -s.gain):
        if effect_of(s) not in here:
            best.setdefault(effect_of(s), s)
    ranked = list(best.values())[:SHORTLIST]
    return [s for s in ranked if s.gain > max(MUCH_OF_IT * ranked[0].gain, least)]


def clear(found: Assessment) -> list[Signal]:
    """The most significant shape of every significant effect.

    A torque may look like slow noise because another one is missing, too. So an effect also counts if it gains much of
    what the most significant curve gains, and that curve is significant.
    """
    best: dict[str, Signal] = {}
    for s in found.of_candidates:
        best.setdefault(effect_of(s), s)
    enough, curve = np.log(ALARM / len(found.screen.candidates)), found.of_curves[0]
    much = MUCH_OF_IT * curve.gain if curve.log_p < enough else np.inf
    return [s for s in best.values() if s.log_p < enough or s.gain > much]


def richer(current: Model, found: Assessment, share: float = MOST_OF_IT) -> list[Signal]:
    """The first clear effect that contains one of the model's and explains more than a `share` of what is left."""
    here = spelt_out(set(current.effects))
    enough = share * found.clearest.gain
    return [
        s
        for s in clear(found)
        if CONTAINS.get(effect_of(s), set()) & here
        and effect_of(s) not in current.effects
        and s.gain > enough
    ][:1]


def effect_of(signal: Signal) -> str:
    """The name of the effect that a candidate's signal is of."""
    assert signal.candidate is not None
    return signal.candidate.effect
