"""Conversion of cells: plain numbers, and dates with times."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

NUMBERS_ONLY = "Recordings hold plain numbers; leave a cell empty where a sample is missing"
# By thousands separator: numbers with it and with a decimal separator, without which they would be ambiguous
THOUSANDS_PATTERNS = {",": r"^[+-]?\d{1,3}(,\d{3})+\.\d*$", ".": r"^[+-]?\d{1,3}(\.\d{3})+,\d*$"}


def is_number(cell: str) -> bool:
    """Whether a cell holds one plain number, with a decimal point or comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def without_thousands_separators(text: pl.Series) -> pl.Series:
    """The texts, those of numbers with thousands separators without them."""
    for sign, pattern in THOUSANDS_PATTERNS.items():
        grouped = text.str.contains(pattern).fill_null(False)
        text = text.str.replace_all(sign, "", literal=True).zip_with(grouped, text)
    return text


def parse_dates(text: pl.Series) -> pl.Series | None:
    """Texts converted to dates with times; None if one of them is not a date."""
    import polars as pl

    try:
        return text.str.to_datetime(time_unit="ns")
    except pl.exceptions.PolarsError:
        return None


def seconds_since_first(dates: pl.Series) -> pl.Series:
    """Dates with times as seconds since the first of them."""
    first = dates.drop_nulls().first()
    return (dates - first).dt.cast_time_unit("ns").dt.total_nanoseconds() / 1e9
