"""The header of a CSV file, which may follow a preamble of the instrument and precede a line of units."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from ...errors import InputError
from .cells import is_number
from .headers import refuse_duplicates, with_unit

MAX_PREAMBLE_LINES = 200  # before the header
MAX_PREAMBLE_FIELDS = 2  # a name and a value


class Header(NamedTuple):
    """The column names with their units, the line number of the header, and the byte `end` at which the rows begin."""

    names: tuple[str, ...]
    line: int
    separator: str
    end: int


class _Line(NamedTuple):
    """A line of a file: its text, its number from 1, and the bytes at which it and the next line begin."""

    text: str
    number: int
    start: int
    end: int


def find_header(raw: bytes, path: Path) -> Header:
    """Find and read the header of a CSV file.

    **Arguments**: `raw`, the content of the file; `path`, for messages.

    **Raises**: `InputError` if there is none, or if two columns have the same name.
    """
    line = _header_line(raw, _first_text_line(raw, path))
    separator = _separator(line.text)
    names = [name.strip() for name in split_fields(line.text, separator)]
    units, end = _find_units(raw, _skip_empty_lines(raw, line.end), separator, len(names))
    headers = tuple(map(with_unit, names, units) if units else names)
    refuse_duplicates(headers, path)
    return Header(headers, line.number, separator, _skip_empty_lines(raw, end))


def split_fields(line: str, separator: str) -> list[str]:
    """The cells of a line, without quotes."""
    line = line.rstrip("\r\n")
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # a field longer than the limit of the module, hence no number
        return line.split(separator)


def _first_text_line(raw: bytes, path: Path) -> _Line:
    """The first line that is neither empty nor a comment: the header, or the first line of a preamble.

    A comment directly above numbers is the header if it has as many fields.

    **Raises**: `InputError` if numbers come first without one, or there is no such line.
    """
    above = _Line("", 0, 0, 0)
    for line in _lines(raw):
        if line.text.strip() and not line.text.startswith(("#", "sep=")):
            if not _has_only_numbers(line.text):
                return line
            separator = _separator(line.text)
            if above.text.count(separator) == line.text.count(separator) > 0:
                return above  # as numpy.savetxt writes it
            what = "the first line holds numbers where the header should be"
            raise InputError(f"{path}, line {line.number}", what, "Begin with time_s,voltage_V,...")
        above = line._replace(text=line.text.removeprefix("#"))
    raise InputError(str(path), "it holds no header and no rows", "Export the recording again")


def _header_line(raw: bytes, first: _Line) -> _Line:
    """The header: the last line above the numbers with as many fields as these have, preferably without a number.

    It is the `first` line if that has as many fields, or if no line has.
    """
    text_lines: list[_Line] = []
    for line in islice(_lines(raw, first), MAX_PREAMBLE_LINES):
        if not line.text.strip() or not _has_only_numbers(line.text):
            text_lines.append(line)
            continue
        separator = _separator(line.text)
        count = len(split_fields(line.text, separator))
        if count < 2 or len(split_fields(first.text, separator)) == count:
            return first
        alike = [text for text in text_lines if len(split_fields(text.text, separator)) == count]
        # a row of data with a remark is not all numbers, but not a header either
        all_words = [text for text in alike if not _has_number(split_fields(text.text, separator))]
        *above, last = all_words or alike or [first]
        has_names_above = above and above[-1].number == last.number - 1
        return above[-1] if has_names_above and _may_be_units(last.text, separator) else last
    return first


def _find_units(raw: bytes, start: int, separator: str, count: int) -> tuple[list[str] | None, int]:
    """The units in the line at byte `start`, None if it is no line of units, and the byte at which the rows begin."""
    line = _line_at(raw, start, 0)
    fields = [field.strip() for field in split_fields(line.text, separator)]
    if len(fields) != count or _has_number(fields):
        return None, start
    units = [field.strip("()[]") for field in fields]
    return (units, line.end) if any(units) else (None, start)


def _may_be_units(line: str, separator: str) -> bool:
    """Whether a line below the names may hold their units: each in brackets, or more of them than a preamble has."""
    fields = [field.strip() for field in split_fields(line, separator)]
    bracketed = all(field[:1] in ("(", "[", "") for field in fields)
    return bracketed or len(fields) > MAX_PREAMBLE_FIELDS


def _lines(raw: bytes, after: _Line | None = None) -> Iterator[_Line]:
    """All lines, or those after the line `after`."""
    start, number = (after.end, after.number) if after else (0, 0)
    while start < len(raw):
        number += 1
        line = _line_at(raw, start, number)
        yield line
        start = line.end


def _line_at(raw: bytes, start: int, number: int) -> _Line:
    end = raw.find(b"\n", start) + 1 or len(raw)
    return _Line(raw[start:end].decode().strip("\r\n"), number, start, end)


def _skip_empty_lines(raw: bytes, start: int) -> int:
    """The next byte that is no line end; polars would misread an empty first line as a column."""
    empty = re.compile(rb"[\r\n]*").match(raw, start)
    return empty.end() if empty else start


def _separator(line: str) -> str:
    """The separator of the fields of a line: a tab, else a semicolon, else a comma."""
    return next((s for s in "\t;" if s in line), ",")


def _has_only_numbers(line: str) -> bool:
    """Whether a line holds nothing but numbers, quoted or not, and empty cells."""
    cells = " ".join(split_fields(line, _separator(line))).replace(",", " ").split()
    return all(map(is_number, cells))


def _has_number(fields: list[str]) -> bool:
    return any(map(is_number, fields))
