"""Tables of an identification: their rows, for the terminal and for the page, and the terminal's tables."""

from __future__ import annotations

from attrs import frozen
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ...identify.identification import Estimate, Identification, RunFit
from ..notation import fixed, percent, role_word, significant, status_word, thousands, write_estimate
from ..terminal import plain_table
from .sentences import summary

STATUS_STYLES = {"identified": "green", "at_bound": "yellow", "not_identifiable": "red"}


def identification_tables(identification: Identification) -> RenderableType:
    """Summary, parameter table and fit table, one under the other."""
    sentences = [Text(sentence) for sentence in summary(identification)]
    return Group(parameter_table(identification), "", _fit_table(identification), "", *sentences)


def parameter_table(identification: Identification) -> Table:
    """Every parameter with its uncertainty and status."""
    headings = ("Parameter", "Value", "Unit", "Std. error", "95 % interval", "Status")
    rows = []
    for name, estimate in identification.parameters.items():
        written = write_estimate(estimate)
        numbers = (written.value, written.unit, written.stderr, written.interval)
        rows.append((name, *numbers, status_text(estimate)))
    return plain_table("Parameters", headings, rows, left=(0, 2, 5))


def status_text(estimate: Estimate) -> Text:
    """The status, coloured."""
    return Text(status_word(estimate.status), STATUS_STYLES.get(estimate.status, ""))


@frozen
class FitRow:
    """How a run is reproduced, as texts."""

    run: str
    role: str
    samples: str
    duration: str
    speed_rmse: str
    speed_fit: str
    current_rmse: str
    current_fit: str
    load_offset: str


def fit_rows(identification: Identification) -> list[FitRow]:
    """A row for each run, hold-outs first."""
    return [
        FitRow(
            run,
            role_word(fit.role),
            thousands(len(fit.time)),
            f"{fixed(fit.time[-1] - fit.time[0] if len(fit.time) else 0.0, 2)} s",
            significant(fit.speed_rmse),
            percent(fit.speed_fit_percent),
            significant(fit.current_rmse),
            percent(fit.current_fit_percent),
            significant(fit.load_offset),
        )
        for run, fit in runs_in_order(identification)
    ]


def runs_in_order(identification: Identification) -> list[tuple[str, RunFit]]:
    """The runs, hold-outs first, because they are what tests the fit."""
    return sorted(identification.fit.items(), key=lambda item: item[1].role != "holdout")


def _fit_table(identification: Identification) -> Table:
    headings = ("Run", "Role", "Speed RMSE\n[rad/s]", "Speed fit", "Current RMSE\n[A]", "Current fit")
    rows = [
        (one.run, one.role, one.speed_rmse, one.speed_fit, one.current_rmse, one.current_fit)
        for one in fit_rows(identification)
    ]
    return plain_table("Free-run simulation", headings, rows, left=(0, 1), first_wraps="fold")
