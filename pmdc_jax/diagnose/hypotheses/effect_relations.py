"""Which effects contain others, which hold the rotor, and which sets are the same torque while the motor turns."""

from __future__ import annotations

from collections.abc import Collection

from ...effects import EFFECTS
from .trials import TRIALS

# By richer effect, the effects that it contains and replaces
CONTAINS = {effect: trial.contains for effect, trial in TRIALS.items() if trial.contains}
# By simple effect, its fuller form, richer or refit-only (see `proposals`), which the runs must rule out
FULLER = {effect: trial.fuller for effect, trial in TRIALS.items() if trial.fuller}


def unbalanced_equation(equation: str) -> str:
    """The equation that a missing effect violates: the electrical one for a voltage lost before the terminals
    ("input"), otherwise its own."""
    return "electrical" if equation == "input" else equation


def may_hold_rotor(effect: str) -> bool:
    """Whether an effect may hold the rotor at rest."""
    return EFFECTS[effect].holds == "speed"


def are_rivals(a: set[str], b: set[str]) -> bool:
    """Whether two sets, `a` not empty, are alternatives: not the same torque, neither a part of the other, and neither
    the other with an effect in a simpler form."""
    return bool(a) and not (a <= b or b <= a or _are_same_torque(a, b) or _is_part_of_other(a, b))


def covered_by(effects: Collection[str]) -> set[str]:
    """Some effects, and the simpler forms of them, which add nothing to them: a gear with play has a shaft."""
    contained = {simple for e in effects for simple in CONTAINS.get(e, ())}
    return {*effects, *contained, *(simple for simple, fuller in FULLER.items() if fuller.effect in effects)}


def is_simpler_form(a: set[str], b: set[str]) -> bool:
    """Whether `a` is `b` with one effect in a simpler form."""
    return any(a - b and a - b <= CONTAINS.get(e, set()) and b - a == {e} for e in b)


def with_split_friction(effects: set[str]) -> set[str]:
    """The set with asymmetric friction split into Coulomb friction and a constant load, the same torque while the motor
    turns, so that an effect that is richer in another way, such as Stribeck friction, can replace one of them."""
    if "asymmetric_friction" in effects:
        return (effects - {"asymmetric_friction"}) | CONTAINS["asymmetric_friction"]
    return effects


def _are_same_torque(a: set[str], b: set[str]) -> bool:
    """Whether two sets are the same torque while the motor turns (see `with_split_friction`)."""
    return with_split_friction(a) == with_split_friction(b)


def _is_part_of_other(a: set[str], b: set[str]) -> bool:
    """Whether one set, with its effects in their simplest forms, is part of the other, or both are then the same."""
    return _simplified(a) <= b or _simplified(b) <= a or _simplified(a) == _simplified(b)


def _simplified(effects: set[str]) -> set[str]:
    """The set with each richer effect replaced by what it contains, without a constant load."""
    return {simple for e in effects for simple in (CONTAINS[e] - {"constant_load"} if e in CONTAINS else {e})}
