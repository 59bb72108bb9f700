"""Tables of a tuning: their rows, for the terminal and for the page, and the terminal's tables."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from ...control.controller_file import gains_of
from ...control.evaluation import EvaluatedController
from ...control.tuning import Tuning
from ..notation import UNKNOWN, pretty_unit, significant
from ..terminal import plain_table
from .sentences import summary

GAIN_HEADINGS = ("Gain", "Value", "Unit")
COMPARISON_HEADINGS = (
    "Settling\n[ms]",
    "Relative to\nfastest",
    "Overshoot\n[%]",
    "Rise\n[ms]",
    "Settling\np95 [ms]",
    "Overshoot\np95 [%]",
)


def tuning_tables(tuning: Tuning) -> RenderableType:
    """Gains, comparison and summary for the terminal."""
    gains = plain_table(tuning.controller.label, GAIN_HEADINGS, gain_rows(tuning))
    compared = plain_table("Step from rest", ("", *COMPARISON_HEADINGS), comparison(tuning))
    sentences = [Text(sentence) for sentence in summary(tuning)]
    return Group(gains, "", compared, "", *sentences)


def gain_rows(tuning: Tuning) -> list[tuple[str, str, str]]:
    """Name, value and unit of every gain."""
    return [
        (name.replace("_", " "), significant(value, 5), pretty_unit(tuning.controller.units[name]))
        for name, value in gains_of(tuning.controller).items()
    ]


def comparison(tuning: Tuning) -> list[tuple[str, ...]]:
    """A row for each candidate (tuned, and by a textbook rule), and one for the physical limit."""
    fastest = tuning.fastest_possible_settling
    last = ("fastest possible", significant(1e3 * fastest, 4), "1", *(UNKNOWN,) * 4)
    return [*(_candidate_row(one, fastest) for one in (tuning.tuned, tuning.textbook)), last]


def _candidate_row(one: EvaluatedController, fastest: float) -> tuple[str, ...]:
    settling, rise, robust = one.metrics["SettlingTime"], one.metrics["RiseTime"], one.robust
    return (
        one.name,
        significant(_milli(settling), 4),
        significant(None if settling is None else settling / fastest, 4),
        significant(one.metrics["Overshoot"], 3),
        significant(_milli(rise), 4),
        significant(None if robust is None else _milli(robust.SettlingTime_p95), 4),
        significant(None if robust is None else robust.Overshoot_p95, 3),
    )


def _milli(value: float | None) -> float | None:
    return None if value is None else 1e3 * value
