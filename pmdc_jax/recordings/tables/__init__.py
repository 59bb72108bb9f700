"""Named columns of numbers in CSV, Parquet and MAT files, not yet interpreted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from ...errors import InputError
from .cells import NUMBERS_ONLY as NUMBERS_ONLY
from .csv import CsvTable
from .mat import MatTable
from .parquet import ParquetTable


@runtime_checkable
class Table(Protocol):
    """A file with named columns.

    **Fields**: `headers`; `dates`, those of the columns read so far that hold dates with times, read as seconds since
    the first.
    """

    headers: tuple[str, ...]
    dates: set[str]

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns with these headers as float64 of shape (rows,), NaN where a cell is empty."""
        ...

    def place(self, row: int) -> str:
        """The place of a row, counted from 0, for messages, such as "line 17" of a text file."""
        ...


def open_table(path: Path) -> Table:
    """Open a CSV, Parquet or MAT file by its suffix.

    **Raises**: `InputError` if it is missing, empty, of another kind, or cannot be read.
    """
    kinds = dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm"), CsvTable)
    kinds |= {".parquet": ParquetTable, ".pq": ParquetTable, ".mat": MatTable}
    if path.is_dir():
        raise InputError(str(path), "this is a folder", "Give the files in it, one run each")
    if not path.exists():
        raise InputError(str(path), "no such file", "Check the name and the folder")
    if path.suffix.lower() not in kinds:
        what = f"unknown file type '{path.suffix}'"
        raise InputError(str(path), what, f"Export it as one of {', '.join(kinds)}")
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
        if empty:
            raise InputError(str(path), "the file is empty", "Export the recording again")
        return kinds[path.suffix.lower()](path)
    except PermissionError:
        raise InputError(str(path), "no permission to read it", "Ask its owner, or copy it to your folder") from None
    except OSError as error:
        what = f"it cannot be read ({error.strerror or error})"
        raise InputError(str(path), what, "Copy it to a local disk and try again") from None
