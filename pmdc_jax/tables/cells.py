"""What cells hold: plain numbers, or dates with times."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

NUMBERS_ONLY = "Recordings hold plain numbers; leave a cell empty where a sample is missing"
# Numbers that a spreadsheet shows with a sign between thousands, by that sign; only where the decimal sign tells it
GROUPED = {",": r"^[+-]?\d{1,3}(,\d{3})+\.\d*$", ".": r"^[+-]?\d{1,3}(\.\d{3})+,\d*$"}


def is_number(cell: str) -> bool:
    """Whether a cell holds one plain number, with a point or a comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def ungrouped(text: pl.Series) -> pl.Series:
    """Numbers without a sign between thousands."""
    for sign, pattern in GROUPED.items():
        grouped = text.str.contains(pattern).fill_null(False)
        text = text.str.replace_all(sign, "", literal=True).zip_with(grouped, text)
    return text


def as_dates(text: pl.Series) -> pl.Series | None:
    """Dates with times, None if a text is none."""
    import polars as pl

    try:
        return text.str.to_datetime(time_unit="ns")
    except pl.exceptions.PolarsError:
        return None


def seconds_since_first(dates: pl.Series) -> pl.Series:
    """Seconds since the first of some dates with times."""
    first = dates.drop_nulls().first()
    return (dates - first).dt.cast_time_unit("ns").dt.total_nanoseconds() / 1e9
