"""Motors as JSON files: parameter values and their uncertainty."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from attrs import frozen

from .effects import EFFECTS, OTHER_FORMS, AbstractEffect, form_with
from .errors import InputError
from .files import write_text
from .json_file import finite_number, read_object
from .motor import PARAMETERS, PARAMETERS_OF_DRIVE, DriveName, Motor

if TYPE_CHECKING:
    from .identify.identification import Identification

FORMAT = "pmdc motor 1"
MEND = "Give the motor file that pmdc identify --save wrote"
UNDETERMINED = ("not_identifiable", "at_bound")
COVARIANCE_OF = "natural logarithms of positive parameters, and other parameters in SI"


def save_motor(path: str | Path, motor: Motor, identification: Identification | None = None) -> None:
    """Write a motor as JSON, atomically.

    **Arguments**: `motor`, with scalar parameters; `identification`, whose standard errors, statuses, covariance
    (`COVARIANCE_OF`) and noise of the sensors are saved with the values. What no recording depends on is null.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "parameters": {name: float(getattr(motor, name)) for name in PARAMETERS},
        "units": dict(PARAMETERS),
        "effects": [{"name": e.name, "parameters": {f: float(getattr(e, f)) for f in e.ranges}} for e in motor.effects],
    }
    if identification is not None:
        estimates = identification.parameters
        content["parameters"] = {name: estimates[name].value for name in PARAMETERS}
        content["stderr"] = {name: estimate.stderr for name, estimate in estimates.items()}
        content["status"] = {name: estimate.status for name, estimate in estimates.items()}
        content["covariance"] = {
            "of": COVARIANCE_OF,
            "names": list(identification.covariance_names),
            "matrix": np.asarray(identification.covariance).tolist(),
        }
        content["noise"] = dict(identification.noise)
    write_text(Path(path), json.dumps(content, indent=2, allow_nan=False) + "\n")


class Uncertainty(NamedTuple):
    """Uncertainty of a motor: the names of its coordinates, their covariance, and the parameters that no recording
    determined."""

    names: tuple[str, ...]
    covariance: np.ndarray
    undetermined: tuple[str, ...] = ()


@frozen
class MotorFile:
    """The content of a motor file. Each part of it is checked only when asked for: if it is not valid, an `InputError`
    is raised."""

    where: str
    content: Mapping[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> MotorFile:
        """**Raises**: `InputError` if the file cannot be read, or its entries are not of the right types."""
        where, content = str(path), read_object(path, FORMAT, MEND)
        if not isinstance(content.get("parameters"), dict):
            raise InputError(where, 'has no "parameters"', MEND)
        for name in ("status", "noise", "units"):
            if not isinstance(content.get(name, {}), dict):
                raise InputError(where, f'"{name}" is not an object', MEND)
        return cls(where, content)

    def motor(self, drive: DriveName = "voltage") -> Motor:
        """The motor, for simulations with one kind of input; what affects none of them may be null, and is then 1."""
        for name, unit in self.content.get("units", {}).items():
            if unit != PARAMETERS.get(name, unit):
                what = f"the unit of {name} is {unit!r}, but values are read in {PARAMETERS[name]}"
                raise InputError(self.where, what, f"Convert the value to {PARAMETERS[name]}")
        given = self.content["parameters"]
        needless = {name: 1.0 for name in PARAMETERS if name not in PARAMETERS_OF_DRIVE[drive]}
        constants = {name: value for name, value in given.items() if value is not None}
        for name in PARAMETERS_OF_DRIVE[drive]:
            if name in given and given[name] is None:
                what, mend = f"{name} is null: no recording determined it", "Identify it, or write its value in SI"
                raise InputError(self.where, what, mend)
        constants = _numbers(self.where, needless | constants, PARAMETERS, "parameters")
        return Motor(**constants, effects=_effects(self.where, self.content.get("effects", [])))

    @property
    def uncertainty(self) -> Uncertainty | None:
        """None if the file has no covariance."""
        covariance = self.content.get("covariance")
        if covariance is None:
            return None
        try:
            names = tuple(covariance["names"])
            matrix = np.array(covariance["matrix"], float).reshape(len(names), len(names))
            if not _is_covariance(names, matrix):
                raise ValueError
        except (KeyError, TypeError, ValueError, OverflowError):
            what = '"covariance" is not a matrix with its names'
            raise InputError(self.where, what, MEND) from None
        statuses = self.content.get("status", {})
        undetermined = (name for name, status in statuses.items() if status in UNDETERMINED)
        return Uncertainty(names, matrix, tuple(undetermined))

    @property
    def speed_noise(self) -> float | None:
        """White noise of the recorded speeds, rad/s; None if the file has none."""
        speed = self.content.get("noise", {}).get("speed_rad_s")
        if speed is None:
            return None
        noise = finite_number(self.where, "the noise of the speed", speed, MEND)
        if noise < 0:
            raise InputError(self.where, f"the noise of the speed is {noise}, negative", MEND)
        return noise


def load_motor(path: str | Path, drive: DriveName = "voltage") -> Motor:
    """Read a motor written by `save_motor` or by hand; only "parameters" is required.

    **Arguments**: `path`; `drive`, the input of the simulations that it is for: parameters that they do not depend on
    may be null.

    **Raises**: `InputError` if the file is missing, is not JSON, or has missing or invalid entries.
    """
    return MotorFile.read(path).motor(drive)


def load_uncertainty(path: str | Path) -> Uncertainty | None:
    """The uncertainty that an identification saved in a motor file; None if the file has no covariance.

    **Raises**: `InputError` if the covariance is not valid, or the file cannot be read.
    """
    return MotorFile.read(path).uncertainty


def load_speed_noise(path: str | Path) -> float | None:
    """The white noise of the recorded speeds, rad/s, that an identification saved in a motor file; None if the file has
    none.

    **Raises**: `InputError` if it is not a number of at least 0, or the file cannot be read.
    """
    return MotorFile.read(path).speed_noise


def _is_covariance(names: Sequence[str], matrix: np.ndarray) -> bool:
    """Whether names are unique and known, and the matrix is finite and symmetric with no negative variance."""
    forms = (*EFFECTS.values(), *OTHER_FORMS.values())
    known = {*PARAMETERS, *(f"{kind.name}.{field}" for kind in forms for field in kind.ranges)}
    once = known.issuperset(names) and len(set(names)) == len(names)
    alike = np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=1e-6)
    return bool(once and alike and np.all(np.diag(matrix) >= 0))


def _effects(where: str, entries: object) -> tuple[AbstractEffect, ...]:
    """The effects in a file, each `{"name": ..., "parameters": {...}}`, none of them twice."""
    if not isinstance(entries, list):
        raise InputError(where, f'"effects" is {entries!r}, not a list', "Write [] for none")
    effects: dict[str, AbstractEffect] = {}
    for entry in entries:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            raise InputError(
                where, f"effect {entry!r} is not an object with a name", 'Write {"name": ..., "parameters": {...}}'
            )
        if name not in EFFECTS:
            raise InputError(where, f"unknown effect {name!r}", f"Choose from {', '.join(EFFECTS)}")
        if name in effects:
            raise InputError(where, f"effect {name} is listed twice", "Keep one of the two")
        given = entry.get("parameters", {})
        kind = form_with(name, given if isinstance(given, dict) else ())
        effects[name] = kind(**_numbers(where, given, kind.ranges, name))
    return tuple(effects.values())


def _numbers(where: str, given: object, wanted: Mapping[str, Any], of: str) -> dict[str, np.ndarray]:
    if not isinstance(given, dict):
        raise InputError(where, f"{of}: parameters are {given!r}", "Give an object of numbers")
    numbers = {}
    for name in wanted:
        if name not in given:
            raise InputError(where, f"{of}: {name} is missing", "Give a number in SI")
        value = finite_number(where, f"{of}: {name}", given[name], "Give a number in SI")
        if name in PARAMETERS and not (value > 0 or (name == "f" and value == 0)):
            raise InputError(where, f"{of}: {name} is {value}, not positive", "Give a value in SI")
        if name not in PARAMETERS and wanted[name].scale == "log" and value <= 0:
            mend = "Give a value in SI, or leave the effect out"
            raise InputError(where, f"{of}: {name} is {value}, not positive", mend)
        if name not in PARAMETERS and value >= wanted[name].limit:
            what = f"{of}: {name} is {value}, not below {wanted[name].limit:g}"
            raise InputError(where, what, "Give a smaller value")
        numbers[name] = np.asarray(value)
    return numbers
