"""What stands against the chosen set of effects: other sets that do as well, and the set without each of its own."""

from __future__ import annotations

from scipy import stats

from ..effects import EFFECTS
from ..identify.noise_model import Whitener
from .assessment import ALARM, Assessment
from .compare import MARGIN, Comparison
from .effect_relations import FULLER, are_rivals
from .model import Model
from .refits import Refits

# A fuller form of an effect is ruled out if it leaves so many squares more: two standard errors
RULED_OUT = 4.0
# Rivals whose criterion is nearer than the margin, and this share of what neither explains, are not told apart
OF_UNEXPLAINED = 0.1


def rivals_of(
    chosen: Model, found: Assessment, refits: Refits, comparison: Comparison
) -> list[Model]:
    """Other sets that explain the runs as well, the best first, and those with a fuller form that is not ruled out."""
    white = found.screen.white
    models = [chosen, *(m for m in refits.models.values() if m.is_possible)]
    ranked = comparison.ranked(models, white)
    least = next(f.criterion for f in ranked if f.model is chosen)
    margin = MARGIN + (OF_UNEXPLAINED * found.clearest.gain if found.left < ALARM else 0.0)
    near = [f.model for f in ranked if f.criterion < least + margin]
    rivals = [m for m in near if are_rivals(set(m.effects), set(chosen.effects))]
    # clearly in the fuller form, where the runs show too little of an effect to tell
    simple = [effect for effect in chosen.effects if effect in FULLER]
    fuller = [refits.clearly_in_full(chosen, white, effect) for effect in simple]
    enough = comparison.left(chosen, white).squares + RULED_OUT
    return rivals + [m for m in fuller if comparison.left(m, white).squares < enough]


def chances_without(
    chosen: Model, white: Whitener, refits: Refits, comparison: Comparison
) -> dict[str, float]:
    """By effect of the chosen set, the chance of the runs without it: a ratio of likelihoods, one degree of freedom for
    each of its parameters."""
    chances = {}
    for effect in chosen.effects:
        smaller = refits.without(chosen, effect, white)
        squares = {f.model.effects: f.squares for f in comparison.ranked([chosen, smaller], white)}
        gain = squares[smaller.effects] - squares[chosen.effects]
        chances[effect] = float(stats.chi2.sf(max(gain, 0.0), len(EFFECTS[effect].ranges)))
    return chances
