"""Recording files: read from CSV, Parquet and MAT, written as CSV and Parquet."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from attrs import evolve

from ..errors import InputError
from ..files import replacing
from .columns import (
    QUANTITIES,
    Column,
    column_option,
    header_and_unit,
    likely_quantity,
    match_columns,
    may_be_dates,
    mixed_axes,
    quantity_named,
)
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
from .tables import NUMBERS_ONLY, Table, open_table

# one run or several, each a recording or the path of its file
Run = Recording | str | os.PathLike[str]
Runs = Run | Sequence[Run]


def read_recording(
    path: str | os.PathLike[str], columns: Mapping[str, str] | None = None, to_simulate: bool = False
) -> Recording:
    """Read one run from a CSV, Parquet or MAT file.

    **Arguments**: `path`; `columns`, for headers that are not understood by themselves: a mapping from quantity (time,
    voltage, current, speed, load, angle, temperature, torque) to "header" or "header:unit", as "header:-unit" with the
    sign reversed; `to_simulate`, whether the inputs of a simulation suffice, so that no output need be recorded.

    **Returns**: the run in SI, named after the file.

    **Raises**: `InputError` that names the file, the line or column, the fault and its remedy.
    """
    path = Path(path)
    return _read(open_table(path), path, columns, to_simulate)


def read_recordings(
    paths: Sequence[Path], mappings: Sequence[tuple[str, str]] = (), to_simulate: bool = False
) -> list[Recording]:
    """Read runs, which may be of several loggers.

    **Arguments**: `paths`; `mappings` from quantity to "header" or "header:unit", each for the files with that header;
    `to_simulate` as of `read_recording`.

    **Raises**: `InputError` as `read_recording` does, and if no file has the header of a mapping, or one has those of
    two mappings of one quantity.
    """
    tables = {path: open_table(path) for path in paths}
    columns: dict[Path, dict[str, str]] = {path: {} for path in paths}
    for quantity, spec in mappings:
        quantity_named(quantity, f"--column {quantity}={spec}")
        having = [p for p, table in tables.items() if _has(table, spec)]
        if not having:
            header, _ = header_and_unit(spec, ())
            what = f"no column '{header}' in {', '.join(map(str, tables))}"
            headers = dict.fromkeys(h for table in tables.values() for h in table.headers if h)
            mend = f"Columns there are: {', '.join([*headers][:20])}"
            raise InputError(f"--column {quantity}={spec}", what, mend)
        for path in having:
            if columns[path].setdefault(quantity, spec) != spec:
                what = f"{columns[path][quantity]} is mapped to {quantity}, too"
                mend = "Map one column of a file to each quantity"
                raise InputError(f"{path}, --column {quantity}={spec}", what, mend)
    return [_read(tables[path], path, columns[path], to_simulate) for path in paths]


def _has(table: Table, spec: str) -> bool:
    return header_and_unit(spec, table.headers)[0] in table.headers


def _read(table: Table, path: Path, columns: Mapping[str, str] | None, to_simulate: bool = False) -> Recording:
    matched = match_columns(table.headers, columns, str(path))
    if "time" not in matched:
        matched = _time_of_dates(table) | matched
    _refuse_too_little(matched, table, str(path), to_simulate)
    numbers = table.read([column.header for column in matched.values()])
    matched = _with_dates_in_seconds(matched, table, str(path))
    values = {q: numbers[column.header] for q, column in matched.items()}
    values = {q: _to_si(column, values[q]) for q, column in matched.items()}
    empty = [q for q, v in values.items() if q != "time" and len(v) and np.isnan(v).all()]
    present: dict[str, Any] = {q: v for q, v in values.items() if q not in empty}
    nothing_in = [matched[quantity].header for quantity in empty]
    _refuse_too_little(present, table, str(path), to_simulate, nothing_in)
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
    return [run if isinstance(run, Recording) else read_recording(run, to_simulate=to_simulate) for run in several]


def named_apart(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings, those with the same name renamed after as much of the paths of their files as tells them apart.

    **Raises**: `InputError` if a file is listed twice, or if two without files have the same name.
    """
    count = Counter(run.name for run in recordings)
    paths: list[Path] = []
    for run in recordings:
        if count[run.name] == 1:
            continue
        if run.source is None:
            what, mend = "two runs have this name", "Rename one, or list it only once"
            raise InputError(run.name, what, mend)
        path = Path(run.source).resolve()
        if path in paths:
            raise InputError(run.source, "this file is listed twice", "List it only once")
        paths.append(path)
    return [run if count[run.name] == 1 else _named_after_path(run, paths) for run in recordings]


def refuse_copies(recordings: Sequence[Recording]) -> None:
    """**Raises**: `InputError` if two recordings hold the same data: they would count twice in the fit, or validate
    nothing as hold-outs."""
    for first, second in combinations(recordings, 2):
        if _hold_the_same(first, second):
            what, mend = f"it holds the same data as {first.name}", "List only one of them"
            raise InputError(second.source or second.name, what, mend)


def _hold_the_same(first: Recording, second: Recording) -> bool:
    own, other = first.columns(), second.columns()
    return own.keys() == other.keys() and all(np.array_equal(own[name], other[name], equal_nan=True) for name in own)


def _named_after_path(run: Recording, paths: Sequence[Path]) -> Recording:
    """The run, named after the fewest last parts of the path of its file that no other path ends with."""
    parts = Path(run.source or "").resolve().parts
    ends = (parts[-count:] for count in range(1, len(parts) + 1))
    own = next(end for end in ends if sum(path.parts[-len(end) :] == end for path in paths) == 1)
    name = "/".join(own)
    return evolve(run, name=name, notes=tuple(evolve(note, run=name) for note in run.notes))


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a run as CSV or Parquet, by suffix, with canonical headers and in full precision.

    The file is written atomically.

    **Raises**: `InputError` for another suffix, or if the file cannot be written.
    """
    import polars as pl

    path = Path(path)
    check_recording_suffix(path)
    data = recording.columns()
    frame = pl.DataFrame({QUANTITIES[quantity].header: array for quantity, array in data.items()})
    with replacing(path) as part, part.open("wb") as file:
        frame.write_csv(file) if path.suffix.lower() == ".csv" else frame.write_parquet(file)


def check_recording_suffix(path: Path) -> None:
    """**Raises**: `InputError` if recordings are not written to files with the suffix of this one."""
    if path.suffix.lower() not in (".csv", ".parquet"):
        what = f"cannot write files of type '{path.suffix}'"
        raise InputError(str(path), what, "Use the suffix .csv or .parquet")


def _time_of_dates(table: Table) -> dict[str, Column]:
    """The time, if a column has the name and the cells of dates with times."""
    for header in filter(may_be_dates, table.headers):
        table.read([header])
        if header in table.dates:
            return {"time": Column(header, "time", "s", "s")}
    return {}


def _with_dates_in_seconds(matched: Mapping[str, Column], table: Table, where: str) -> dict[str, Column]:
    """The columns; a time that was read from dates is in seconds, whatever its header says."""
    for quantity, column in matched.items():
        if column.header in table.dates and quantity != "time":
            what = "it contains dates or times of the day, not numbers"
            raise InputError(f"{where}, column {column.header}", what, NUMBERS_ONLY)
    return {
        quantity: evolve(column, unit="s", scale=1.0) if column.header in table.dates else column
        for quantity, column in matched.items()
    }


def _refuse_too_little(
    matched: Mapping[str, object], table: Table, where: str, to_simulate: bool, empty: Sequence[str] = ()
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
            "voltage" if "speed" in matched else "speed",
        )
    else:
        return
    what = f"{what} {', '.join(matched)}"
    if empty:
        what += f"; nothing is in {', '.join(empty)}"
    mend = f"Needed besides time: {needed}. Map columns with --column {lacking}=HEADER:UNIT; {content}"
    raise InputError(where, what, mend)


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


def _notes(run: str, headers: tuple[str, ...], matched: Mapping[str, Column], empty: list[str]) -> Iterator[Finding]:
    """What was assumed about the columns, and which were not used."""
    yield from _notes_on_used(run, matched, empty)
    if mixed := mixed_axes(matched):
        shaft, axis = mixed
        what = f"{shaft.base} is a unit of a rotating shaft, but the {axis.base} of {axis.header} is not"
        mend = "Give all columns in shaft units (rad, N m) or all in linear-axis units (m, N)"
        yield Finding(run, shaft.header, "warning", what, "", mend)
    yield from _notes_on_unused(run, headers, matched)


def _notes_on_used(run: str, matched: Mapping[str, Column], empty: list[str]) -> Iterator[Finding]:
    for quantity, column in matched.items():
        if quantity in empty:
            yield _note(run, column.header, "the column is empty", "It is ignored")
        elif quantity == "temperature":
            mend = "That of the winding is computed from its current: see resistance_heating"
            yield _note(run, column.header, "a recorded temperature is not used", mend)
        elif column.by_unit:
            mend = f"If it is something else, map the right column: --column {quantity}=HEADER:UNIT"
            why = "name and unit" if quantity == "load" else "unit"
            yield _note(run, column.header, f"used as the {quantity}, because of its {why}", mend)
        elif column.unit is None:
            mend = f"If this is wrong, write the unit in the header, as in {QUANTITIES[quantity].header}"
            yield _note(run, column.header, f"the header has no unit: {column.base} assumed", mend)


def _notes_on_unused(run: str, headers: tuple[str, ...], matched: Mapping[str, Column]) -> Iterator[Finding]:
    used = {column.header for column in matched.values()}
    # a position of the shaft stands in for its speed
    moving = ("angle",) if "angle" in matched else ("speed",)
    lacking = [q for q in ("voltage", "current", *moving) if q not in matched]
    not_understood: list[str] = []
    for header in headers:
        quantity = likely_quantity(header)
        if quantity and quantity not in matched:
            what = f"not used, although it looks like {quantity}"
            yield _note(run, header, what, f"Map it with {column_option(quantity, header, 'UNIT')}")
        elif header and header not in used:
            not_understood.append(header)
    if not_understood and lacking:
        what = f"not understood, and not used: {', '.join(not_understood[:20])}"
        example = column_option(lacking[0], not_understood[0], "UNIT")
        mend = f"If this includes the {' or the '.join(lacking)}, map it, as in {example}"
        yield _note(run, None, what, mend)


def _note(run: str, column: str | None, what: str, mend: str) -> Finding:
    return Finding(run, column, "note", what, "", mend)
