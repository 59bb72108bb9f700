"""Scores of answers: which sets of effects are equivalent, and the outcome of a case.

An answer is a dictionary as `pmdc diagnose --json` writes it. Sets are equivalent if no record of
motion distinguishes them (`canonical`):

- asymmetric friction = Coulomb friction + constant load: the same torque while moving;
- Stribeck friction contains Coulomb friction;
- if no run has a load column, every run has an unknown constant load, and a further one has no meaning.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

Answer = Mapping[str, Any]
Outcome = Literal[
    "exact",  # the true set, asserted; for a null, none detected
    "incomplete",  # part of the true set, asserted
    "wrong",  # a false name, asserted; for a null, any finding
    "rivals",  # ambiguous, the true set among the rivals
    "elsewhere",  # ambiguous, the true set not among them
    "unlisted",  # not in library
    "missed",  # none detected
    "error",  # no answer
]
PUBLISHED_RECOVERY = {0.1: 75, 0.5: 72, 1.0: 58, 2.5: 29, 5.0: 18}  # % at noise %, known parameters

# truth parameter: other names by which it may be reported
SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "stiffness": ("stiffness_Nm_per_rad", "stiffness_Nm_rad"),
    "damping": ("damping_Nms_per_rad", "damping_Nms_rad"),
    "drag": ("coefficient", "drag_Nms2"),
    "saturation": ("c", "saturation_per_A2", "per_A2"),
}
NUISANCE = {"phase", "periods"}  # runs begin at random angles; an integer has no interval


def canonical(names: Iterable[str], load_known: bool = True) -> frozenset[str]:
    """The canonical form of all sets of effects that are equivalent while the motor turns."""
    found = set(names)
    if "asymmetric_friction" in found:
        found = found - {"asymmetric_friction"} | {"coulomb_friction", "constant_load"}
    if "stribeck_friction" in found:
        found -= {"coulomb_friction"}
    if not load_known:
        found -= {"constant_load"}
    return frozenset(found)


def named(answer: Answer) -> list[str]:
    """The effects of the best set."""
    return [effect["name"] for effect in answer.get("effects", [])]


def _split(rival: str) -> list[str]:
    return [name.strip() for name in rival.replace(",", "+").split("+") if name.strip()]


def rivals(answer: Answer) -> list[list[str]]:
    """All sets that the answer considers possible: the best, and each rival of it."""
    best, sets = named(answer), [named(answer)]
    for place, effect in enumerate(answer.get("effects", [])):
        for rival in effect.get("also_possible") or ():
            sets += [_split(rival), best[:place] + _split(rival) + best[place + 1 :]]
    return sets


def outcome(expected: str, truth: Iterable[str], answer: Answer, load_known: bool = True) -> Outcome:
    """The outcome of an answer; `truth` has no names for a null or a stranger."""
    verdict = answer["verdict"]
    if verdict == "error":
        return "error"
    true = canonical(truth, load_known)
    if verdict == "named":
        return _asserted(expected, true, canonical(named(answer), load_known))
    if expected == "none_detected":
        return "exact" if verdict == "none_detected" else "wrong"
    if verdict == "ambiguous":
        possible = (canonical(names, load_known) for names in rivals(answer))
        return "rivals" if true and true in possible else "elsewhere"
    return "unlisted" if verdict == "not_in_library" else "missed"


def _asserted(expected: str, true: frozenset[str], found: frozenset[str]) -> Outcome:
    if found == true:
        return "exact"
    # if the excitation cannot distinguish effects, asserting part of the truth is unfounded, too
    return "incomplete" if found < true and expected != "blind" else "wrong"


def right(expected: str, result: Outcome) -> bool:
    """Whether this outcome is right for the expected answer."""
    if expected == "outside":
        return result in ("unlisted", "rivals", "elsewhere")
    if expected == "blind":
        return result not in ("wrong", "error")
    return result == "exact"


class Interval(NamedTuple):
    """Whether a 95 % interval of an effect's parameter covers the truth."""

    effect: str
    parameter: str
    covers: bool


def intervals(truth: Mapping[str, Mapping[str, float]], answer: Answer) -> list[Interval]:
    """The intervals of all parameters that the answer shares with the truth."""
    found = []
    for effect in answer.get("effects", []):
        true = truth.get(effect["name"], {})
        for name in true.keys() - NUISANCE:
            reported = _reported(effect["parameters"], name)
            if reported and reported.get("ci95"):
                low, high = (-math.inf if x is None else x for x in reported["ci95"])
                high = math.inf if reported["ci95"][1] is None else high
                found.append(Interval(effect["name"], name, low <= true[name] <= high))
    return sorted(found)


def _reported(parameters: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    names = (name, *SYNONYMS.get(name, ()))
    return next((parameters[n] for n in names if n in parameters), None)


def gap_closed(answer: Answer) -> float | None:
    """Share of the hold-out gap closed: (before^2 - after^2) / (before^2 - floor^2)."""
    gap = (answer.get("gap") or {}).get("holdout") or {}
    if not all(gap.get(n) is not None for n in ("before", "after", "floor")):
        return None
    room = gap["before"] ** 2 - gap["floor"] ** 2
    return (gap["before"] ** 2 - gap["after"] ** 2) / room if room > 0 else None
