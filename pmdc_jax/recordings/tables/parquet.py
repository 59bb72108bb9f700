"""Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import InputError
from .cells import NUMBERS_ONLY, seconds_since_first


class ParquetTable:
    """Columns of a Parquet file."""

    def __init__(self, path: Path) -> None:
        import polars as pl

        self._path = path
        self.dates: set[str] = set()
        try:
            self.headers = tuple(pl.read_parquet_schema(path))
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            raise InputError(str(path), "this is not a Parquet file", "Export it again") from None

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """See `Table`."""
        import polars as pl

        try:
            frame = pl.read_parquet(self._path, columns=list(headers))
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            raise InputError(str(self._path), "it is damaged", "Export it again") from None
        for header in headers:
            kind = frame.schema[header]
            if isinstance(kind, pl.Datetime):
                self.dates.add(header)
                frame = frame.with_columns(seconds_since_first(frame[header]))
            elif not kind.is_numeric() and kind != pl.Null:
                where = f"{self._path}, column {header}"
                raise InputError(where, f"it contains {kind}, not numbers", NUMBERS_ONLY)
        return {h: frame[h].cast(pl.Float64).to_numpy().astype(float) for h in headers}

    def place(self, row: int) -> str:
        """See `Table`."""
        return f"row {row + 1}"
