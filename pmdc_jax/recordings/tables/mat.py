"""MATLAB files: vectors, including those in structures and matrices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .headers import refuse_duplicates, with_unit


class MatTable:
    """The vectors of a MATLAB file, including those in structures and matrices.

    The header of a vector is the path to it in the file, or the name of the signal in structures saved by Simulink or
    ControlDesk.
    """

    def __init__(self, path: Path) -> None:
        from scipy.io import loadmat

        self._path = path
        self.dates: set[str] = set()
        try:
            content = loadmat(path, squeeze_me=True, simplify_cells=True)
        except NotImplementedError:
            what, mend = "it is a MATLAB v7.3 (HDF5) file", "Save it in MATLAB with the option -v7"
            raise InputError(str(path), what, mend) from None
        except Exception:  # damaged files make scipy raise many kinds, even UnboundLocalError
            what, mend = "not a MATLAB file, or damaged", "Save it in MATLAB with the option -v7"
            raise InputError(str(path), what, mend) from None
        vectors = list[tuple[str, np.ndarray]]()
        for header, vector in _vectors(content, ""):
            if not any(_is_copied_time(header, vector, *other) for other in vectors):
                vectors.append((header, vector))
        self.headers = tuple(header for header, _ in vectors)
        refuse_duplicates(self.headers, path)
        self._vectors = dict(vectors)
        if not self.headers:
            mend = "Save time, voltage, current and speed as vectors, for example named time_s"
            raise InputError(str(path), "it contains no numeric vectors", mend)

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """See `Table`."""
        chosen = {header: self._vectors[header].astype(float) for header in headers}
        shortest = min(chosen, key=lambda header: len(chosen[header]))
        longest = max(chosen, key=lambda header: len(chosen[header]))
        if len(chosen[shortest]) != len(chosen[longest]):
            what = f"{len(chosen[shortest])} and {len(chosen[longest])} samples"
            where = f"{self._path}, variables {shortest} and {longest}"
            raise InputError(where, what, "Save vectors of equal length")
        return chosen

    def place(self, row: int) -> str:
        """See `Table`."""
        return f"sample {row + 1}"


def _vectors(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    """Header and numbers of every vector in the `value` at this path; matrices are split into their longer vectors."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _vectors(inner, _signal_name(value, name, path) or f"{path}.{name}".strip("."))
    elif isinstance(value, list):
        for k, inner in enumerate(value, 1):
            yield from _vectors(inner, f"{path}({k})")
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        if value.ndim == 1:
            yield path, value
        elif value.ndim == 2 and value.shape[0] >= value.shape[1]:
            yield from ((f"{path}(:,{k})", column) for k, column in enumerate(value.T, 1))
        elif value.ndim == 2:  # as Simulink's block "To File" saves it
            yield from ((f"{path}({k},:)", row) for k, row in enumerate(value, 1))


def _signal_name(structure: Mapping[str, Any], field: str, path: str) -> str | None:
    """The name that a structure gives to the numbers in its `field`, as Simulink's "structure with time" and files of
    ControlDesk do; None without one."""
    naming = {"values": "label", "Data": "Name"}.get(field)
    if naming is None or naming not in structure:
        return None
    name, unit = structure[naming], structure.get("Unit")
    if not (isinstance(name, str) and name):  # Simulink's label may be empty: the path stands in
        return path.removesuffix(".signals")
    return with_unit(name, unit) if isinstance(unit, str) else name


def _is_copied_time(header: str, vector: np.ndarray, other: str, time: np.ndarray) -> bool:
    """Whether this is a copy of the time vector `time`: Simulink saves one with every signal."""
    leaves = {name.rpartition(".")[2] for name in (header, other)}
    return leaves == {"time"} and np.array_equal(vector, time)
