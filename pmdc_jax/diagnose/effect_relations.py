"""Which sets of effects are one while the motor turns, or contain one another."""

from __future__ import annotations

from .candidates import TRIALS

# An effect that contains others replaces them
CONTAINS = {effect: trial.contains for effect, trial in TRIALS.items() if trial.contains}
# The simple forms of which there are fuller ones
FULLER = {effect: trial.fuller for effect, trial in TRIALS.items() if trial.fuller}


def unbalances(equation: str) -> str:
    """The equation that is out of balance for want of an effect in another one: a voltage lost on the way to the
    terminals is missing in the electrical one."""
    return "electrical" if equation == "input" else equation


def are_rivals(a: set[str], b: set[str]) -> bool:
    """Not the same, none a part of the other, and none with an effect in place of one that it contains."""
    return bool(a) and not (a <= b or b <= a or _same_class(a, b) or _contains(a, b))


def is_within(a: set[str], b: set[str]) -> bool:
    """Whether `a` is `b` with one effect in a simpler form."""
    return any(a - b and a - b <= CONTAINS.get(e, set()) and b - a == {e} for e in b)


def spelt_out(effects: set[str]) -> set[str]:
    """The same torque in motion, by effects that one which is richer in another way can be part of."""
    if "asymmetric_friction" in effects:
        return (effects - {"asymmetric_friction"}) | CONTAINS["asymmetric_friction"]
    return effects


def _same_class(a: set[str], b: set[str]) -> bool:
    """While the motor turns, asymmetric friction and Coulomb friction with a constant load are one torque."""
    return spelt_out(a) == spelt_out(b)


def _contains(a: set[str], b: set[str]) -> bool:
    """Whether one set is the other but for an effect that another one contains."""
    return _simplified(a) <= b or _simplified(b) <= a or _simplified(a) == _simplified(b)


def _simplified(effects: set[str]) -> set[str]:
    return {
        simple
        for e in effects
        for simple in (CONTAINS[e] - {"constant_load"} if e in CONTAINS else {e})
    }
