"""Conversion of cells: plain numbers, and dates with times."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

NUMBERS_ONLY = "Recordings hold plain numbers; leave a cell empty where a sample is missing"
# Numbers with a thousands separator, by that separator; without a decimal separator they would be ambiguous
GROUPED = {",": r"^[+-]?\d{1,3}(,\d{3})+\.\d*$", ".": r"^[+-]?\d{1,3}(\.\d{3})+,\d*$"}


def is_number(cell: str) -> bool:
    """Whether a cell holds one plain number, with a decimal point or comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def ungrouped(text: pl.Series) -> pl.Series:
    """Texts of numbers without thousands separators."""
    for sign, pattern in GROUPED.items():
        grouped = text.str.contains(pattern).fill_null(False)
        text = text.str.replace_all(sign, "", literal=True).zip_with(grouped, text)
    return text


def as_dates(text: pl.Series) -> pl.Series | None:
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
