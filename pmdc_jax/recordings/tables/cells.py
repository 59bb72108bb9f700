"""Conversion of cells: plain numbers, and dates with times."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

# Of dates with times: ISO 8601, and as in German; with a number and a slash first, which may be day or month
DATE_LAYOUTS = (None, "%d.%m.%Y %H:%M:%S%.f")
SLASHED_LAYOUTS = ("%d/%m/%Y %H:%M:%S%.f", "%m/%d/%Y %H:%M:%S%.f")
SLASHED_DATE = r"^(\d{1,2})[/-](\d{1,2})[/-](\d{4})"
DAY = 86400.0  # s
NUMBERS_ONLY = "Recordings hold plain numbers; leave a cell empty where a sample is missing"
# By thousands separator: numbers with it and with a decimal separator, without which they would be ambiguous
THOUSANDS_PATTERNS = {",": r"^[+-]?\d{1,3}(,\d{3})+\.\d*$", ".": r"^[+-]?\d{1,3}(\.\d{3})+,\d*$"}

# By decimal separator: numbers with it
DECIMAL_PATTERNS = {".": r"^[+-]?\d*\.\d+$", ",": r"^[+-]?\d*,\d+$"}


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
    import polars as pl

    first = dates.drop_nulls().first()
    if first is None:
        return pl.Series(dates.name, [None] * len(dates), pl.Float64)
    return (dates - first).dt.cast_time_unit("ns").dt.total_nanoseconds() / 1e9


def seconds_of_dates(text: pl.Series) -> list[pl.Series]:
    """Texts of dates with times, or of times of the day, as seconds since the first.

    **Returns**: every different reading: two if day and month cannot be told apart and this matters, none if a text is
    neither.
    """
    import polars as pl

    text = text.str.replace(",", ".", literal=True)
    slashed = text.str.replace(SLASHED_DATE, "$1/$2/$3")
    readings: list[pl.Series] = []
    for layout in SLASHED_LAYOUTS if text.str.contains(SLASHED_DATE).any() else DATE_LAYOUTS:
        try:
            dates = slashed.str.to_datetime(layout, time_unit="ns")
        except pl.exceptions.PolarsError:
            continue
        seconds = seconds_since_first(dates)
        if not any(seconds.equals(reading) for reading in readings):
            readings.append(seconds)
    return readings or _seconds_of_day(text)


def _seconds_of_day(text: pl.Series) -> list[pl.Series]:
    import polars as pl

    try:
        seconds = text.str.to_time("%H:%M:%S%.f").cast(pl.Int64) / 1e9
    except pl.exceptions.PolarsError:
        return []
    midnights = (seconds.diff().fill_null(0.0) < -DAY / 2).cum_sum()
    return [seconds + DAY * midnights - seconds.drop_nulls().first()]
