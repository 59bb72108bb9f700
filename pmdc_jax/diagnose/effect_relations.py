"""Which effects contain others, and which sets of effects are the same torque while the motor turns."""

from __future__ import annotations

from .candidates import TRIALS

# By rich effect, the effects that it contains and replaces
CONTAINS = {effect: trial.contains for effect, trial in TRIALS.items() if trial.contains}
# By simple effect, its fuller form
FULLER = {effect: trial.fuller for effect, trial in TRIALS.items() if trial.fuller}


def unbalances(equation: str) -> str:
    """The equation in which a missing effect shows: the electrical one for a voltage lost before the terminals
    ("input"), or else its own."""
    return "electrical" if equation == "input" else equation


def are_rivals(a: set[str], b: set[str]) -> bool:
    """Whether two sets, `a` not empty, are alternatives: not the same torque, neither a part of the other, and neither
    the other with an effect in a simpler form."""
    return bool(a) and not (a <= b or b <= a or _same_class(a, b) or _contains(a, b))


def is_within(a: set[str], b: set[str]) -> bool:
    """Whether `a` is `b` with one effect in a simpler form."""
    return any(a - b and a - b <= CONTAINS.get(e, set()) and b - a == {e} for e in b)


def spelt_out(effects: set[str]) -> set[str]:
    """The set with asymmetric friction as Coulomb friction and a constant load, the same torque while the motor turns,
    so that an effect which is richer in another way, as Stribeck friction, can replace a part."""
    if "asymmetric_friction" in effects:
        return (effects - {"asymmetric_friction"}) | CONTAINS["asymmetric_friction"]
    return effects


def _same_class(a: set[str], b: set[str]) -> bool:
    """Whether two sets are the same torque while the motor turns (see `spelt_out`)."""
    return spelt_out(a) == spelt_out(b)


def _contains(a: set[str], b: set[str]) -> bool:
    """Whether one set, with its effects in their simplest forms, is part of the other, or both are then the same."""
    return _simplified(a) <= b or _simplified(b) <= a or _simplified(a) == _simplified(b)


def _simplified(effects: set[str]) -> set[str]:
    return {
        simple
        for e in effects
        for simple in (CONTAINS[e] - {"constant_load"} if e in CONTAINS else {e})
    }
