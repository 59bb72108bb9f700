"""Named columns of numbers in CSV, Parquet and MAT files, before anyone asks what they mean."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    import polars as pl

MISSING = ["NA", "N/A", "n/a", "null", "NULL", "None"]
# Lines that an instrument may write before its header
PREAMBLE = 200
# Numbers that a spreadsheet shows with a sign between thousands, by that sign; only where the decimal sign tells it
GROUPED = {",": r"^[+-]?\d{1,3}(,\d{3})+\.\d*$", ".": r"^[+-]?\d{1,3}(\.\d{3})+,\d*$"}
NUMBERS_ONLY = "Recordings hold plain numbers; leave a cell empty where a sample is missing"


@runtime_checkable
class Table(Protocol):
    """A file with named columns."""

    headers: tuple[str, ...]

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """These columns as float64 of shape (rows,); NaN where a cell is empty."""
        ...

    def place(self, row: int) -> str:
        """Where an editor shows this row (counted from 0), such as "line 17"."""
        ...


def open_table(path: Path) -> Table:
    """Open a CSV, Parquet or MAT file by its suffix.

    **Raises**: `InputError` if it cannot be read as such.
    """
    kinds = dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm"), CsvTable)
    kinds |= {".parquet": ParquetTable, ".pq": ParquetTable, ".mat": MatTable}
    if path.is_dir():
        raise InputError(str(path), "this is a folder", "Name the files in it, one run each")
    if not path.exists():
        raise InputError(str(path), "no such file", "Check the spelling and the folder")
    if path.suffix.lower() not in kinds:
        what = f"unknown kind of file '{path.suffix}'"
        raise InputError(str(path), what, f"Export it as one of {', '.join(kinds)}")
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
        if empty:
            raise InputError(str(path), "the file is empty", "Export the recording again")
        return kinds[path.suffix.lower()](path)
    except PermissionError:
        raise InputError(
            str(path), "no permission to read it", "Ask its owner, or copy it to your folder"
        ) from None
    except OSError as error:
        what = f"it cannot be read ({error.strerror or error})"
        raise InputError(str(path), what, "Copy it to a local disk and try again") from None


class CsvTable:
    """Text with a header line; separated by comma, semicolon or tab.

    Lines that begin with # and empty ones are skipped, and what an instrument writes before the header. Numbers may
    have a decimal comma unless the comma separates. A second line of units belongs to the header. Dates with times are
    read as seconds since the first of them.
    """

    def __init__(self, path: Path):
        self._path = path
        self._raw = _text(path)
        header, self._header_line, self._start = _past_preamble(
            self._raw, *_find_header(self._raw, path)
        )
        self._separator = _separator(header)
        names = [name.strip() for name in _fields(header, self._separator)]
        units, start = _find_units(self._raw, self._start, self._separator, len(names))
        self._start = _past_empty_lines(self._raw, start)
        self.headers = tuple(map(_with_unit, names, units)) if units else tuple(names)
        _refuse_duplicates(self.headers, path)
        self._kept: np.ndarray | None = None

    def read(self, headers: Sequence[str]) -> dict[str, np.ndarray]:
        """See `Table`."""
        wanted = [str(self.headers.index(header)) for header in headers]
        frame = self._frame(wanted)
        if frame[str(len(self.headers) - 1)].null_count():
            self._refuse_ragged()  # polars fills short lines without a word
        if frame.height and all(frame[i].null_count() for i in wanted):
            # a spreadsheet ends with lines of empty cells
            self._kept = np.array([bool(line.strip(b" \t\r,;")) for _, line in self._lines()])
            if len(self._kept) != frame.height:
                what = "it breaks lines inside quotes"
                raise InputError(str(self._path), what, "Export it as plain CSV")
            frame = frame.filter(self._kept)
        columns = (frame[i].to_numpy().astype(float) for i in wanted)
        return dict(zip(headers, columns, strict=True))

    def place(self, row: int) -> str:
        """See `Table`."""
        if self._kept is not None:
            row = int(np.flatnonzero(self._kept)[row])
        numbers = (number for number, _ in self._lines())
        return f"line {next(islice(numbers, row, None), row + 1)}"

    @cached_property
    def _body(self) -> bytes:
        return self._raw[self._start :].rstrip(b"\r\n")

    def _frame(self, wanted: Sequence[str]) -> pl.DataFrame:
        """Wanted columns as numbers and the last one of any kind, empty cells null."""
        import polars as pl

        last = str(len(self.headers) - 1)
        if not self._body:
            return pl.DataFrame(schema=dict.fromkeys({*wanted, last}, pl.Float64))
        try:
            return self._parse(dict.fromkeys(wanted, pl.Float64), last)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            self._refuse_ragged()
        try:  # padded numbers and other texts, more slowly
            text = self._parse({}, last)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
            what = f"it cannot be read as a table ({str(error).splitlines()[0]})"
            raise InputError(str(self._path), what, "Export it as plain CSV") from None
        return text.with_columns(self._numbers(text[i], self.headers[int(i)]) for i in wanted)

    def _parse(self, kinds: Mapping[str, Any], last: str) -> pl.DataFrame:
        import polars as pl

        schema = {str(i): kinds.get(str(i), pl.String) for i in range(len(self.headers))}
        frame = pl.read_csv(
            self._body,
            has_header=False,
            schema=schema,
            separator=self._separator,
            comment_prefix="#",
            null_values=MISSING,
            decimal_comma=self._separator != "," and b"," in self._body,
        )
        return frame.select(i for i in schema if i in kinds or i == last or not kinds)

    def _numbers(self, text: pl.Series, header: str) -> pl.Series:
        import polars as pl

        text = text.str.strip_chars().replace("", None)
        comma = self._separator != ","
        plain = _ungrouped(text)
        plain = plain.str.replace(",", ".", literal=True) if comma else plain
        numbers = plain.cast(pl.Float64, strict=False)
        wrong = (numbers.is_null() & text.is_not_null()).arg_true()
        if not len(wrong):
            return numbers
        if numbers.null_count() == len(numbers) and (stamps := _stamps(text)) is not None:
            return _seconds(stamps)
        row = int(wrong[0])
        where = f"{self._path}, {self.place(row)}, column {header}"
        raise InputError(where, f"'{text[row]}' is not a number", NUMBERS_ONLY)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Number and text of each line that polars makes a row of."""
        first = self._raw.count(b"\n", 0, self._start) + 1
        for number, line in enumerate(self._body.split(b"\n"), first):
            if not line.startswith(b"#"):
                yield number, line

    def _refuse_ragged(self) -> None:
        for number, line in self._lines():
            fields = len(_fields(line.decode(), self._separator)) if line.strip() else None
            if fields not in (None, len(self.headers)):
                raise InputError(
                    f"{self._path}, line {number}",
                    f"it has {fields} fields where the header (line {self._header_line}) "
                    f"has {len(self.headers)}",
                    "Mend or delete this line",
                )


class ParquetTable:
    """Columns of a Parquet file."""

    def __init__(self, path: Path):
        import polars as pl

        self._path = path
        try:
            self.headers = tuple(pl.read_parquet_schema(path))
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
            raise InputError(str(path), "it is no Parquet file", "Export it again") from None

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
                frame = frame.with_columns(_seconds(frame[header]))
            elif not kind.is_numeric() and kind != pl.Null:
                where = f"{self._path}, column {header}"
                raise InputError(where, f"it holds {kind}, not numbers", NUMBERS_ONLY)
        return {h: frame[h].cast(pl.Float64).to_numpy().astype(float) for h in headers}

    def place(self, row: int) -> str:
        """See `Table`."""
        return f"row {row + 1}"


class MatTable:
    """Vectors of a MATLAB file, also those inside structures and matrices: a header is then the path to it, or the name
    that a signal of Simulink or ControlDesk has beside its numbers."""

    def __init__(self, path: Path):
        from scipy.io import loadmat

        self._path = path
        try:
            content = loadmat(path, squeeze_me=True, simplify_cells=True)
        except NotImplementedError:
            what, mend = "it is a MATLAB v7.3 (HDF5) file", "Save it in MATLAB with the option -v7"
            raise InputError(str(path), what, mend) from None
        except Exception:  # a damaged file makes scipy raise anything, down to UnboundLocalError
            what, mend = "it is no MATLAB file, or damaged", "Save it in MATLAB with the option -v7"
            raise InputError(str(path), what, mend) from None
        vectors = list[tuple[str, np.ndarray]]()
        for header, vector in _vectors(content, ""):
            if not any(_same_time(header, vector, *other) for other in vectors):
                vectors.append((header, vector))
        self.headers = tuple(header for header, _ in vectors)
        _refuse_duplicates(self.headers, path)
        self._vectors = dict(vectors)
        if not self.headers:
            mend = "Save time, voltage, current and speed as vectors, for example named time_s"
            raise InputError(str(path), "it holds no vectors of numbers", mend)

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
    """Header and numbers of every vector in what MATLAB saved under this path."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _vectors(inner, _signal(value, name, path) or f"{path}.{name}".strip("."))
    elif isinstance(value, list):
        for k, inner in enumerate(value, 1):
            yield from _vectors(inner, f"{path}({k})")
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        if value.ndim == 1:
            yield path, value
        elif value.ndim == 2 and value.shape[0] >= value.shape[1]:
            yield from ((f"{path}(:,{k})", column) for k, column in enumerate(value.T, 1))
        elif value.ndim == 2:  # as Simulink's block "To File" writes it
            yield from ((f"{path}({k},:)", row) for k, row in enumerate(value, 1))


def _signal(structure: Mapping[str, Any], field: str, path: str) -> str | None:
    """What the numbers in a field are called by the structure around them, as in Simulink's "structure with time" and
    in files of ControlDesk; None where it says nothing."""
    naming = {"values": "label", "Data": "Name"}.get(field)
    if naming is None or naming not in structure:
        return None
    name, unit = structure[naming], structure.get("Unit")
    if not (isinstance(name, str) and name):  # Simulink's label may be empty
        return path.removesuffix(".signals")
    return _with_unit(name, unit) if isinstance(unit, str) else name


def _same_time(header: str, vector: np.ndarray, other: str, found: np.ndarray) -> bool:
    """Whether this is the time of another structure, which Simulink saves with every signal."""
    leaves = {name.rpartition(".")[2] for name in (header, other)}
    return leaves == {"time"} and np.array_equal(vector, found)


def _text(path: Path) -> bytes:
    """The bytes of a UTF-8 text, without byte order mark and with \\n somewhere."""
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(str(path), "it is UTF-16 text", "Save it as UTF-8")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in raw:
        what = f"this is no text (byte {raw.index(0)} is zero)"
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


def _find_header(raw: bytes, path: Path) -> tuple[str, int, int]:
    """The header, its line number, and the byte where the rows begin."""
    start, number, comment = 0, 1, ""
    while start < len(raw):
        end = raw.find(b"\n", start)
        end = len(raw) if end < 0 else end
        line = raw[start:end].decode().strip("\r\n")
        if line.strip() and not line.startswith(("#", "sep=")):
            if not _is_numbers(line):
                return line, number, end + 1
            if comment.count(",") == line.count(",") and "," in line:
                return comment, number - 1, start  # as numpy.savetxt writes it
            what = "the first line holds numbers where the header should be"
            raise InputError(f"{path}, line {number}", what, "Begin with time_s,voltage_V,...")
        comment = line.removeprefix("#")
        start, number = end + 1, number + 1
    raise InputError(str(path), "it holds no header and no rows", "Export the recording again")


def _past_preamble(raw: bytes, line: str, number: int, start: int) -> tuple[str, int, int]:
    """The header as `_find_header` gives it; where its fields are not as many as the numbers have that follow, the last
    line before these that has as many, for an instrument wrote of itself before."""
    header, texts = (line, number, start), []
    while start < len(raw) and len(texts) < PREAMBLE:
        end = raw.find(b"\n", start) + 1 or len(raw)
        number, now = number + 1, raw[start:end].decode().strip("\r\n")
        if _is_numbers(now) and now.strip():
            separator = _separator(now)
            count = len(_fields(now, separator))
            if count < 2 or len(_fields(line, separator)) == count:
                break
            alike = [text for text in texts if len(_fields(text[0], separator)) == count]
            # a row with a remark in it is none of numbers, and no header either
            words = [
                text for text in alike if not any(map(_is_number, _fields(text[0], separator)))
            ]
            return (words or alike or [header])[-1]
        texts.append((now, number, end))
        start = end
    return header


def _find_units(raw: bytes, start: int, separator: str, count: int) -> tuple[list[str] | None, int]:
    """The units in the line below the header, if it holds nothing else, and the byte where the rows begin."""
    start = _past_empty_lines(raw, start)
    end = raw.find(b"\n", start) + 1 or len(raw)
    line = raw[start:end].decode().strip("\r\n")
    fields = [field.strip() for field in _fields(line, separator)]
    if len(fields) != count or any(map(_is_number, fields)):
        return None, start
    units = [field.strip("()[]") for field in fields]
    return (units, end) if any(units) else (None, start)


def _past_empty_lines(raw: bytes, start: int) -> int:
    """The next byte that does not end a line; polars would take an empty first line for a column."""
    found = re.compile(rb"[\r\n]*").match(raw, start)
    return found.end() if found else start


def _with_unit(name: str, unit: str) -> str:
    """A header with the unit below it, unless it says that by itself, as speed_rad_s does of rad/s."""
    said, new = (re.sub(r"\W+|_+", "_", text).strip("_") for text in (name, unit))
    return name if not new or said.endswith(f"_{new}") else f"{name} [{unit}]"


def _ungrouped(text: pl.Series) -> pl.Series:
    """Numbers without a sign between thousands."""
    for sign, pattern in GROUPED.items():
        grouped = text.str.contains(pattern).fill_null(False)
        text = text.str.replace_all(sign, "", literal=True).zip_with(grouped, text)
    return text


def _stamps(text: pl.Series) -> pl.Series | None:
    """Dates with times, None if a text is none."""
    import polars as pl

    try:
        return text.str.to_datetime(time_unit="ns")
    except pl.exceptions.PolarsError:
        return None


def _seconds(stamps: pl.Series) -> pl.Series:
    """Seconds since the first of some dates with times."""
    first = stamps.drop_nulls().first()
    return (stamps - first).dt.cast_time_unit("ns").dt.total_nanoseconds() / 1e9


def _is_numbers(line: str) -> bool:
    """Whether a line holds nothing but numbers, in quotes perhaps, and empty cells."""
    cells = " ".join(_fields(line, _separator(line))).replace(",", " ").split()
    return all(map(_is_number, cells))


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _separator(line: str) -> str:
    """What separates the fields of a line: a tab, else a semicolon, else a comma."""
    return next((s for s in "\t;" if s in line), ",")


def _fields(line: str, separator: str) -> list[str]:
    line = line.rstrip("\r\n")
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # a field longer than any number
        return line.split(separator)


def _refuse_duplicates(headers: Sequence[str], path: Path) -> None:
    for header, count in Counter(headers).items():
        if count > 1 and header:
            what = f"the header names '{header}' {count} times"
            raise InputError(f"{path}, column {header}", what, "Give every column its own name")
