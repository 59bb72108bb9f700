"""The header of a CSV file: below what an instrument wrote of itself, above a line of units perhaps."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from .cells import is_number
from .headers import refuse_duplicates, with_unit

# Lines that an instrument may write before its header
PREAMBLE = 200


class Header(NamedTuple):
    """Names of the columns with their units, and the file about them: the rows begin at byte `end`."""

    names: tuple[str, ...]
    line: int
    separator: str
    end: int


class _Line(NamedTuple):
    """A line of a file and where it stands: its number from 1, and the bytes that it and the next begin with."""

    text: str
    number: int
    start: int
    end: int


def find_header(raw: bytes, path: Path) -> Header:
    """What the header of a CSV file says, and where it stands.

    **Raises**: `InputError` where there is none, or where it names two columns alike.
    """
    line = _past_preamble(raw, _first_line(raw, path))
    separator = _separator(line.text)
    names = [name.strip() for name in fields_of(line.text, separator)]
    units, end = _find_units(raw, _past_empty_lines(raw, line.end), separator, len(names))
    headers = tuple(map(with_unit, names, units) if units else names)
    refuse_duplicates(headers, path)
    return Header(headers, line.number, separator, _past_empty_lines(raw, end))


def fields_of(line: str, separator: str) -> list[str]:
    """The cells of a line, out of their quotes."""
    line = line.rstrip("\r\n")
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # a field longer than any number
        return line.split(separator)


def _first_line(raw: bytes, path: Path) -> _Line:
    """The first line that is no comment: the header, unless an instrument wrote of itself before."""
    above = _Line("", 0, 0, 0)
    for line in _lines(raw):
        if line.text.strip() and not line.text.startswith(("#", "sep=")):
            if not _is_numbers(line.text):
                return line
            if above.text.count(",") == line.text.count(",") and "," in line.text:
                return above  # as numpy.savetxt writes it
            what = "the first line holds numbers where the header should be"
            raise InputError(f"{path}, line {line.number}", what, "Begin with time_s,voltage_V,...")
        above = line._replace(text=line.text.removeprefix("#"))
    raise InputError(str(path), "it holds no header and no rows", "Export the recording again")


def _past_preamble(raw: bytes, first: _Line) -> _Line:
    """The header: the first line, or, where its fields are not as many as the numbers have that follow, the last line
    before these that has as many, for an instrument wrote of itself before."""
    texts: list[_Line] = []
    for line in islice(_lines(raw, first), PREAMBLE):
        if not line.text.strip() or not _is_numbers(line.text):
            texts.append(line)
            continue
        separator = _separator(line.text)
        count = len(fields_of(line.text, separator))
        if count < 2 or len(fields_of(first.text, separator)) == count:
            return first
        alike = [text for text in texts if len(fields_of(text.text, separator)) == count]
        # a row with a remark in it is none of numbers, and no header either
        words = [text for text in alike if not _has_number(fields_of(text.text, separator))]
        return (words or alike or [first])[-1]
    return first


def _find_units(raw: bytes, start: int, separator: str, count: int) -> tuple[list[str] | None, int]:
    """The units in the line at `start`, if it holds nothing else, and the byte where the rows begin."""
    line = _line_at(raw, start, 0)
    fields = [field.strip() for field in fields_of(line.text, separator)]
    if len(fields) != count or _has_number(fields):
        return None, start
    units = [field.strip("()[]") for field in fields]
    return (units, line.end) if any(units) else (None, start)


def _lines(raw: bytes, after: _Line | None = None) -> Iterator[_Line]:
    """All lines, or those after one."""
    start, number = (after.end, after.number) if after else (0, 0)
    while start < len(raw):
        number += 1
        line = _line_at(raw, start, number)
        yield line
        start = line.end


def _line_at(raw: bytes, start: int, number: int) -> _Line:
    end = raw.find(b"\n", start) + 1 or len(raw)
    return _Line(raw[start:end].decode().strip("\r\n"), number, start, end)


def _past_empty_lines(raw: bytes, start: int) -> int:
    """The next byte that does not end a line; polars would take an empty first line for a column."""
    found = re.compile(rb"[\r\n]*").match(raw, start)
    return found.end() if found else start


def _separator(line: str) -> str:
    """What separates the fields of a line: a tab, else a semicolon, else a comma."""
    return next((s for s in "\t;" if s in line), ",")


def _is_numbers(line: str) -> bool:
    """Whether a line holds nothing but numbers, in quotes perhaps, and empty cells."""
    cells = " ".join(fields_of(line, _separator(line))).replace(",", " ").split()
    return all(map(is_number, cells))


def _has_number(fields: list[str]) -> bool:
    return any(map(is_number, fields))
