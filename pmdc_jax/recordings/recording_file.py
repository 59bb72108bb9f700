"""Recording files: read from CSV, Parquet and MAT, written as CSV and Parquet."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import replacing
from .columns import QUANTITIES, Column, likely_quantity, match_columns, mixed_axes
from .recording import (
    NEEDED_TO_IDENTIFY,
    NEEDED_TO_SIMULATE,
    Fault,
    Finding,
    Recording,
    faults,
    is_driven,
    is_identifiable_from,
)
from .tables import Table, open_table

# one run or several, each a recording or the path of its file
Run = Recording | str | os.PathLike[str]
Runs = Run | Sequence[Run]


def read_recording(
    path: str | os.PathLike[str],
    columns: Mapping[str, str] | None = None,
    to_simulate: bool = False,
) -> Recording:
    """Read one run from a CSV, Parquet or MAT file.

    **Arguments**: `path`; `columns`, for headers that are not understood by themselves: a mapping from quantity (time,
    voltage, current, speed, load, angle, temperature, torque) to "header" or "header:unit"; `to_simulate`, whether the
    inputs of a simulation suffice, so that no output need be recorded.

    **Returns**: the run in SI, named after the file.

    **Raises**: `InputError` that names the file, the line or column, the fault and its remedy.
    """
    path = Path(path)
    table = open_table(path)
    matched = match_columns(table.headers, columns, str(path))
    _refuse_too_little(matched, table, str(path), to_simulate)
    numbers = table.read([column.header for column in matched.values()])
    values = {q: numbers[column.header] for q, column in matched.items()}
    values = {q: _to_si(column, values[q]) for q, column in matched.items()}
    empty = [q for q, v in values.items() if q != "time" and len(v) and np.isnan(v).all()]
    present: dict[str, Any] = {q: v for q, v in values.items() if q not in empty}
    _refuse_too_little(present, table, str(path), to_simulate)
    for fault in faults(present):
        raise _in_file(fault, matched, table, str(path))
    used = {column.header for column in matched.values()}
    return Recording(
        path.stem,
        **present,
        source=str(path),
        ignored=tuple(header for header in table.headers if header and header not in used),
        notes=tuple(_notes(path.stem, table.headers, matched, empty)),
    )


def recordings_of(runs: Runs, to_simulate: bool = False) -> list[Recording]:
    """A list of recordings from one run or several, where files are read by `read_recording`.

    **Raises**: `InputError` if a file cannot be read.
    """
    several = [runs] if isinstance(runs, Recording | str | os.PathLike) else runs
    return [
        run if isinstance(run, Recording) else read_recording(run, to_simulate=to_simulate)
        for run in several
    ]


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a run as CSV or Parquet, by suffix, with canonical headers and in full precision.

    The file is written atomically.

    **Raises**: `InputError` for another suffix, or if the file cannot be written.
    """
    import polars as pl

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        what = f"cannot write files of type '{suffix}'"
        raise InputError(str(path), what, "Use the suffix .csv or .parquet")
    data = recording.columns()
    frame = pl.DataFrame({QUANTITIES[quantity].header: array for quantity, array in data.items()})
    with replacing(path) as part, part.open("wb") as file:
        frame.write_csv(file) if suffix == ".csv" else frame.write_parquet(file)


def _refuse_too_little(
    matched: Mapping[str, object], table: Table, where: str, to_simulate: bool
) -> None:
    headers = ", ".join(filter(None, table.headers[:20])) or "none"
    content = f"columns in the file: {headers}"
    if len(table.headers) == 1:
        content += "; if this is more than one, separate them by comma, semicolon or tab"
    if "time" not in matched:
        mend = f"Name it time_s, or map it with --column time=HEADER:UNIT; {content}"
        raise InputError(where, "there is no time column", mend)
    if to_simulate and not is_driven(matched):
        what, needed, lacking = "no input column, only", NEEDED_TO_SIMULATE, "voltage"
    elif not to_simulate and not is_identifiable_from(matched):
        what, needed, lacking = (
            "too few columns to identify a motor, only",
            NEEDED_TO_IDENTIFY,
            "speed",
        )
    else:
        return
    mend = (
        f"Needed besides time: {needed}. Map columns with --column {lacking}=HEADER:UNIT; {content}"
    )
    raise InputError(where, f"{what} {', '.join(matched)}", mend)


def _to_si(column: Column, values: np.ndarray) -> np.ndarray:
    if (column.scale, column.offset) == (1.0, 0.0):
        return values
    return values * column.scale + column.offset


def _in_file(fault: Fault, matched: Mapping[str, Column], table: Table, where: str) -> InputError:
    places = [where]
    if fault.row is not None:
        places.append(table.place(fault.row))
    if fault.quantity:
        places.append(f"column {matched[fault.quantity].header}")
    return InputError(", ".join(places), fault.what, fault.mend)


def _notes(
    run: str, headers: tuple[str, ...], matched: Mapping[str, Column], empty: list[str]
) -> Iterator[Finding]:
    def note(column: str, what: str, mend: str) -> Finding:
        return Finding(run, column, "note", what, "header", mend)

    for quantity, column in matched.items():
        if quantity in empty:
            yield note(column.header, "the column is empty", "It is ignored")
        elif column.by_unit:
            mend = f"If it is something else, map the right column: --column {quantity}=HEADER:UNIT"
            yield note(column.header, f"used as the {quantity}, because of its unit", mend)
        elif column.unit is None:
            mend = f"If this is wrong, write the unit in the header, as in {QUANTITIES[quantity].header}"
            yield note(column.header, f"the header has no unit: {column.base} assumed", mend)
    if mixed := mixed_axes(matched):
        shaft, axis = mixed
        what = f"{shaft.base} is a unit of a rotating shaft, but the {axis.base} of {axis.header} is not"
        mend = "Give all columns in shaft units (rad, N m) or all in linear-axis units (m, N)"
        yield Finding(run, shaft.header, "warning", what, "header", mend)
    for header in headers:
        quantity = likely_quantity(header)
        if quantity and quantity not in matched:
            what = f"not used, although it looks like {quantity}"
            yield note(header, what, f"Map it with --column {quantity}={header}:UNIT")
