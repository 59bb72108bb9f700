"""Motors as JSON files: values, and how sure they are."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import numpy as np

from .effects import EFFECTS, AbstractEffect
from .errors import InputError
from .files import write_text
from .motor import PARAMETERS, Motor

if TYPE_CHECKING:
    from .identify.identification import Identification

FORMAT = "pmdc motor 1"
UNDETERMINED = ("not_identifiable", "at_bound")


def save_motor(
    path: str | Path, motor: Motor, identification: Identification | None = None
) -> None:
    """Write a motor as JSON, atomically.

    **Arguments**: `motor`, of scalars; `identification`, whose standard errors, statuses and covariance (of the
    coordinates: natural logarithms of positive parameters) are kept beside the values.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "parameters": {name: float(getattr(motor, name)) for name in PARAMETERS},
        "units": dict(PARAMETERS),
        "effects": [
            {"name": e.name, "parameters": {f: float(getattr(e, f)) for f in e.ranges}}
            for e in motor.effects
        ],
    }
    if identification is not None:
        found = identification.parameters
        content["stderr"] = {name: estimate.stderr for name, estimate in found.items()}
        content["status"] = {name: estimate.status for name, estimate in found.items()}
        content["covariance"] = {
            "of": "coordinates: natural logarithms of positive parameters",
            "names": list(identification.covariance_names),
            "matrix": np.asarray(identification.covariance).tolist(),
        }
    write_text(Path(path), json.dumps(content, indent=2, allow_nan=False) + "\n")


class Uncertainty(NamedTuple):
    """How sure a motor is: names of its coordinates, and their covariance; and the parameters that no recording
    determined."""

    names: tuple[str, ...]
    covariance: np.ndarray
    undetermined: tuple[str, ...] = ()


def load_uncertainty(path: str | Path) -> Uncertainty | None:
    """The covariance that an identification left in a motor file, or None where there is none.

    **Raises**: `InputError` where it is there but cannot be one.
    """
    where, content = str(path), _content(path)
    given = content.get("covariance")
    if given is None:
        return None
    try:
        names = tuple(given["names"])
        matrix = np.array(given["matrix"], float).reshape(len(names), len(names))
    except (KeyError, TypeError, ValueError):
        matrix, names = np.full((1, 1), np.nan), ()
    known = {*PARAMETERS, *(f"{e}.{f}" for e, kind in EFFECTS.items() for f in kind.ranges)}
    if not np.isfinite(matrix).all() or not known.issuperset(names):
        raise InputError(
            where,
            '"covariance" is not a matrix with its names',
            "Write it with pmdc identify --save",
        )
    statuses = content.get("status", {})
    undetermined = (name for name, status in statuses.items() if status in UNDETERMINED)
    return Uncertainty(names, matrix, tuple(undetermined))


def load_motor(path: str | Path) -> Motor:
    """Read a motor written by `save_motor`, or by hand: only "parameters" is needed.

    **Raises**: `InputError` where the file is missing, is not JSON, or lacks or misspells something.
    """
    where, content = str(path), _content(path)
    constants = _numbers(where, content["parameters"], PARAMETERS, "parameters")
    return Motor(**constants, effects=_effects(where, content.get("effects", [])))


def _content(path: str | Path) -> dict[str, Any]:
    where = str(path)
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            where, "there is no such file", "Write one with pmdc identify --save"
        ) from None
    except OSError as error:
        raise InputError(
            where, f"cannot be read ({error.strerror})", "Check path and permissions"
        ) from None
    except ValueError as error:
        raise InputError(
            where, f"is not JSON ({error})", "Write one with pmdc identify --save"
        ) from None
    if not isinstance(content, dict) or not isinstance(content.get("parameters"), dict):
        raise InputError(where, 'has no "parameters"', "Write one with pmdc identify --save")
    if content.get("format", FORMAT) != FORMAT:
        what = f'"format" is {content["format"]!r}, not {FORMAT!r}'
        raise InputError(where, what, "Update pmdc_jax, or write the file with this version")
    if not isinstance(content.get("status", {}), dict):
        raise InputError(where, '"status" is not an object', "Write one with pmdc identify --save")
    return content


def _effects(where: str, entries: object) -> tuple[AbstractEffect, ...]:
    """The effects of a file, each `{"name": ..., "parameters": {...}}` and none of them twice."""
    if not isinstance(entries, list):
        raise InputError(where, f'"effects" is {entries!r}, not a list', "Write [] for none")
    effects: dict[str, AbstractEffect] = {}
    for entry in entries:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            raise InputError(
                where,
                f"effect {entry!r} is not an object with a name",
                'Write {"name": ..., "parameters": {...}}',
            )
        if name not in EFFECTS:
            raise InputError(
                where, f"effect {name!r} is not known", f"Choose of {', '.join(EFFECTS)}"
            )
        if name in effects:
            raise InputError(where, f"effect {name} is there twice", "Keep one of the two")
        fields = _numbers(where, entry.get("parameters", {}), EFFECTS[name].ranges, name)
        effects[name] = EFFECTS[name](**fields)
    return tuple(effects.values())


def _numbers(where: str, given: object, wanted, of: str) -> dict[str, np.ndarray]:
    if not isinstance(given, dict):
        raise InputError(where, f"{of}: parameters are {given!r}", "Give an object of numbers")
    numbers = {}
    for name in wanted:
        if name not in given:
            raise InputError(where, f"{of}: {name} is missing", "Give a number in SI")
        value = given[name]
        if not _is_finite_number(value):
            shown = repr(value) if len(repr(value)) < 40 else "beyond what a double holds"
            raise InputError(where, f"{of}: {name} is {shown}, not a number", "Give a number in SI")
        if name in PARAMETERS and not (value > 0 or (name == "f" and value == 0)):
            raise InputError(where, f"{of}: {name} is {value}, not positive", "Give a value in SI")
        if name not in PARAMETERS and wanted[name].scale == "log" and value < 0:
            raise InputError(where, f"{of}: {name} is {value}, below 0", "Give a value in SI")
        numbers[name] = np.asarray(float(value))
    return numbers


def _is_finite_number(value: object) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # JSON holds whole numbers of any length
        return False
