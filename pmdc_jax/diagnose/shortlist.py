"""Which effects the evidence against a model puts first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects import EFFECTS
from .assessment import ALARM, FORMULA, MOST_OF_IT, MUCH_OF_IT, Assessment
from .candidates import TRIALS
from .effect_relations import CONTAINS, spelt_out
from .model import Model
from .screen import Signal

# So many candidates for one effect are refitted in full simulation
SHORTLIST = 3
# ... those whose gain to first order is at least this share of the best one's
COMPARABLE = 0.6
# ... and those that gain as much as the last of them but for this share: rounding must not choose
TIED = 1e-3


def shortlist(current: Model, found: Assessment, fuller: bool = True) -> list[Signal]:
    """The most significant shape of each of the few effects that explain most.

    If that is an effect which is there already and little is left, its own formula is what is left to be desired,
    or else an effect that does more than its columns show; but a sensor's formula is exact, and one that explains far
    more is missing, however much like slow noise it looks. One that contains an effect which is there, and explains
    most of what is left, needs no other beside it, if `fuller` forms are to be tried alone.
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
    # what may be slow noise is trusted less, but is tried for what it explains
    ranked.sort(key=lambda s: -s.gain)
    # where little is left one has to settle nearly all of it, so those that promise less do no harm
    share = 0.0 if found.unexplained < FORMULA else COMPARABLE
    ranked = [s for s in ranked if s.gain > share * ranked[0].gain]
    least = ranked[:SHORTLIST][-1].gain if ranked else 0.0
    return [s for s in ranked if s.gain >= (1 - TIED) * least]


def promising(signals: Sequence[Signal], here: set[str], least: float) -> list[Signal]:
    """Of each of the few effects that gain most, but for those that are `here`, the shape that does, if it gains at
    `least` so much: by far less than the best, too, for a fit far from the truth foretells badly what each would do."""
    best: dict[str, Signal] = {}
    for s in sorted(signals, key=lambda s: -s.gain):
        if effect_of(s) not in here:
            best.setdefault(effect_of(s), s)
    ranked = list(best.values())[:SHORTLIST]
    return [s for s in ranked if s.gain > max(MUCH_OF_IT * ranked[0].gain, least)]


def clear(found: Assessment) -> list[Signal]:
    """The most significant shape of every effect that chance would not bring about.

    A torque may look like slow noise because another one is missing beside it: what takes away much of the clearest
    curve counts, if that one is clear.
    """
    best: dict[str, Signal] = {}
    for s in found.of_candidates:
        best.setdefault(effect_of(s), s)
    enough, curve = np.log(ALARM / len(found.screen.candidates)), found.of_curves[0]
    much = MUCH_OF_IT * curve.gain if curve.log_p < enough else np.inf
    return [s for s in best.values() if s.log_p < enough or s.gain > much]


def richer(current: Model, found: Assessment, share: float = MOST_OF_IT) -> list[Signal]:
    """An effect that contains one which is there, and explains such a share of what is left; if there is one."""
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
