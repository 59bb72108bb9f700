"""CSV files: text with a header line, separated by comma, semicolon or tab."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError
from .cells import DECIMAL_PATTERNS, NUMBERS_ONLY, seconds_of_dates, without_thousands_separators
from .csv_header import find_header, split_fields

if TYPE_CHECKING:
    import polars as pl

NULL_VALUES = ["NA", "N/A", "n/a", "null", "NULL", "None"]


class CsvTable:
    """A text file with a header line, separated by comma, semicolon or tab.

    Skipped are empty lines, lines that begin with #, and a preamble of the instrument before the header. Numbers may
    have a decimal comma unless the comma is the separator. A line of units below the header is read as part of it.
    Dates with times are read as seconds since the first of them.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._raw = _text(path)
        self._header = find_header(self._raw, path)
        self.headers = self._header.names
        self.dates: set[str] = set()
        self._kept_rows: np.ndarray | None = None

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """See `Table`."""
        wanted = [str(self.headers.index(header)) for header in headers]
        frame = self._frame(wanted)
        if frame[str(len(self.headers) - 1)].null_count():
            self._refuse_unequal_lines()  # polars silently fills short lines with nulls
        if frame.height and all(frame[i].null_count() for i in wanted):
            # spreadsheets may append lines of empty cells
            self._kept_rows = np.array([bool(line.strip(b" \t\r,;")) for _, line in self._lines()])
            if len(self._kept_rows) != frame.height:
                what = "a quoted cell contains a line break"
                raise InputError(str(self._path), what, "Export it as plain CSV")
            frame = frame.filter(self._kept_rows)
        columns = (frame[i].to_numpy().astype(float) for i in wanted)
        return dict(zip(headers, columns, strict=True))

    def place(self, row: int) -> str:
        """See `Table`."""
        if self._kept_rows is not None:
            row = int(np.flatnonzero(self._kept_rows)[row])
        numbers = (number for number, _ in self._lines())
        return f"line {next(islice(numbers, row, None), row + 1)}"

    @cached_property
    def _body(self) -> bytes:
        """The rows, without line ends and comments after the last: polars would miss a row in such a comment."""
        body = self._raw[self._header.end :].rstrip(b"\r\n")
        while (last := body[body.rfind(b"\n") + 1 :]).startswith(b"#"):
            body = body.removesuffix(last).rstrip(b"\r\n")
        return body

    @property
    def _has_decimal_commas(self) -> bool:
        return self._header.separator != "," and b"," in self._body

    @property
    def _may_mix_decimals(self) -> bool:
        """Whether there are commas and points, as of decimals, thousands or dates."""
        return self._has_decimal_commas and b"." in self._body

    def _frame(self, wanted: Sequence[str]) -> pl.DataFrame:
        """The wanted columns as numbers, and the last column, of any type, to detect short lines; null if empty."""
        import polars as pl

        last = str(len(self.headers) - 1)
        if not self._body:
            return pl.DataFrame(schema=dict.fromkeys({*wanted, last}, pl.Float64))
        try:
            if not self._may_mix_decimals:  # polars would accept both
                return self._parse(dict.fromkeys(wanted, pl.Float64), last)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            self._refuse_unequal_lines()
        try:  # padded numbers, dates and the like: slower
            text = self._parse({}, last)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            what = "it cannot be read as a table"
            raise InputError(str(self._path), what, "Export it as plain CSV") from None
        self._refuse_mixed_decimals(text, wanted)
        return text.with_columns(self._numbers(text[i], self.headers[int(i)]) for i in wanted)

    def _refuse_mixed_decimals(self, text: pl.DataFrame, wanted: Sequence[str]) -> None:
        """`InputError` if some numbers have a decimal point and others a comma: one of both separates thousands."""
        if not self._may_mix_decimals:
            return
        found: dict[str, str] = {}
        for i in wanted:
            for sign, pattern in DECIMAL_PATTERNS.items():
                rows = text[i].str.strip_chars().str.contains(pattern).fill_null(False).arg_true()
                if len(rows):
                    found.setdefault(sign, f"'{text[i][int(rows[0])]}' in {self.place(int(rows[0]))}")
        if len(found) == len(DECIMAL_PATTERNS):
            what = f"{found['.']} has a decimal point, but {found[',']} a comma"
            raise InputError(str(self._path), what, "Export the file without thousands separators")

    def _parse(self, kinds: Mapping[str, Any], last: str) -> pl.DataFrame:
        import polars as pl

        schema = {str(i): kinds.get(str(i), pl.String) for i in range(len(self.headers))}
        frame = pl.read_csv(
            self._body,
            has_header=False,
            schema=schema,
            separator=self._header.separator,
            comment_prefix="#",
            null_values=NULL_VALUES,
            decimal_comma=self._has_decimal_commas,
        )
        return frame.select(i for i in schema if i in kinds or i == last or not kinds)

    def _numbers(self, text: pl.Series, header: str) -> pl.Series:
        """A column of text, which may hold decimal commas or dates, as numbers; `InputError` where it holds neither."""
        import polars as pl

        text = text.str.strip_chars().replace("", None)
        plain = without_thousands_separators(text)
        if self._header.separator != ",":
            plain = plain.str.replace(",", ".", literal=True)
        numbers = plain.cast(pl.Float64, strict=False)
        wrong = (numbers.is_null() & text.is_not_null()).arg_true()
        if not len(wrong):
            return numbers
        row = int(wrong[0])
        where = f"{self._path}, {self.place(row)}, column {header}"
        if numbers.null_count() == len(numbers) and (readings := seconds_of_dates(text)):
            if len(readings) > 1:
                what = f"'{text[row]}' may begin with the day or the month"
                raise InputError(where, what, "Write dates as 2026-03-01 12:00:00.125")
            self.dates.add(header)
            return readings[0]
        raise InputError(where, f"'{text[row]}' is not a number", NUMBERS_ONLY)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Number and text of each line that is a row for polars."""
        first = self._raw.count(b"\n", 0, self._header.end) + 1
        for number, line in enumerate(self._body.split(b"\n"), first):
            if not line.startswith(b"#"):
                yield number, line

    def _refuse_unequal_lines(self) -> None:
        for number, line in self._lines():
            if not line.strip():
                continue
            fields = len(split_fields(line.decode(), self._header.separator))
            if fields != len(self.headers):
                raise InputError(
                    f"{self._path}, line {number}",
                    f"it has {fields} fields where the header (line {self._header.line}) has {len(self.headers)}",
                    "Correct or delete this line",
                )


def _text(path: Path) -> bytes:
    """The bytes of a UTF-8 text file, without byte order mark; line ends \\r alone become \\n."""
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(str(path), "it is UTF-16 text", "Save it as UTF-8")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in raw:
        what = f"this is not a text file (byte {raw.index(0)} is zero)"
        raise InputError(str(path), what, "Export the recording as CSV")
    if not raw.isascii():
        try:
            raw.decode()
        except UnicodeDecodeError as error:
            line = raw.count(b"\n", 0, error.start) + 1
            byte = f"byte {error.start + 1} (0x{raw[error.start]:02x})"
            where, mend = f"{path}, line {line}", "Save it as UTF-8"
            raise InputError(where, f"{byte} is not UTF-8 text", mend) from None
    return raw if b"\n" in raw else raw.replace(b"\r", b"\n")
