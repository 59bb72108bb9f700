"""Conversion of cells: plain numbers, and dates with times."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

# Of dates with times: ISO 8601, and as in German
DATE_LAYOUTS = (None, "%d.%m.%Y %H:%M:%S%.f")
DAY = 86400.0  # s
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


def seconds_since_first(dates: pl.Series) -> pl.Series:
    """Dates with times as seconds since the first of them."""
    first = dates.drop_nulls().first()
    return (dates - first).dt.cast_time_unit("ns").dt.total_nanoseconds() / 1e9


def seconds_of_dates(text: pl.Series) -> pl.Series | None:
    """Texts of dates with times, or of times of the day, as seconds since the first; None if one is neither."""
    import polars as pl

    text = text.str.replace(",", ".", literal=True)
    for layout in DATE_LAYOUTS:
        try:
            dates = text.str.to_datetime(layout, time_unit="ns")
        except pl.exceptions.PolarsError:
            continue
        return seconds_since_first(dates)
    try:
        seconds = text.str.to_time("%H:%M:%S%.f").cast(pl.Int64) / 1e9
    except pl.exceptions.PolarsError:
        return None
    midnights = (seconds.diff().fill_null(0.0) < -DAY / 2).cum_sum()
    return seconds + DAY * midnights - seconds.drop_nulls().first()
