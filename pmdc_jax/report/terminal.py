"""Results and progress in the terminal, with rich."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from attrs import evolve, frozen
from rich.console import Console, Group, OverflowMethod, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ..identify.identification import Estimate, Identification
from ..progress import ReportProgress, silent
from ..recordings.recording import Finding
from ..words import enumerate_words
from .identification_sentences import role_word, runs_in_order, status_word, summary
from .notation import fixed, percent, significant, thousands, write_estimate

STATUS_STYLES = {"identified": "green", "at_bound": "yellow", "not_identifiable": "red"}
SEVERITY_STYLES = {"error": "red", "warning": "yellow"}
PIPE_WIDTH = 100  # without a terminal, rich would fold tables at 80 columns


def print_tables(tables: RenderableType) -> None:
    """Print tables and sentences to standard output."""
    console_for(stderr=False).print(tables)


def print_messages(messages: Iterable[str]) -> None:
    """Print remarks to standard error."""
    console = console_for(stderr=True)
    for message in messages:
        console.print(Text(f"note: {message}"), soft_wrap=True)


def print_findings(identification: Identification) -> None:
    """Print findings of the data checks, and remarks of the identification, to standard error."""
    console = console_for(stderr=True)
    runs: dict[Finding, list[str]] = {}  # a finding common to several runs is printed once
    for finding in identification.findings:
        runs.setdefault(evolve(finding, run=""), []).append(finding.run)
    for finding, names in runs.items():
        line = Text(f"{finding.severity}: ", SEVERITY_STYLES.get(finding.severity, ""))
        place = ", ".join(filter(None, [enumerate_words(names), finding.column]))
        where = f", {finding.where}" if finding.where else ""
        line.append(f"{place}: {finding.what}{where}. {finding.mend or ''}", "default")
        console.print(line, soft_wrap=True)
    print_messages(identification.messages)


def identification_tables(identification: Identification) -> RenderableType:
    """Summary, parameter table and fit table, one under the other."""
    sentences = [Text(sentence) for sentence in summary(identification)]
    return Group(parameter_table(identification), "", _fit_table(identification), "", *sentences)


@contextmanager
def progress() -> Iterator[ReportProgress]:
    """A live progress line on standard error; none if that is no terminal."""
    console = console_for(stderr=True)
    if not console.is_terminal:
        yield silent
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("starting", total=None)

        def report(doing: str, fitness: float | None = None, fraction: float | None = None) -> None:
            done, total = (None, None) if fraction is None else (fraction, 1.0)
            known = "" if fitness is None else f", best fitness {significant(fitness, 4)}"
            display.update(task, description=doing + known, completed=done, total=total)

        yield report


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


def _fit_table(identification: Identification) -> Table:
    headings = ("Run", "Role", "Speed RMSE\n[rad/s]", "Speed fit", "Current RMSE\n[A]", "Current fit")
    rows = [
        (one.run, one.role, one.speed_rmse, one.speed_fit, one.current_rmse, one.current_fit)
        for one in fit_rows(identification)
    ]
    return plain_table("Free-run simulation", headings, rows, left=(0, 1), first_wraps="fold")


def plain_table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    left: Sequence[int] = (0,),
    first_wraps: OverflowMethod | None = None,
) -> Table:
    """A table without rules.

    **Arguments**: `left`, indices of the left-aligned columns; `first_wraps`, what to do with words too long for the
    first column, whose cells then wrap on a narrow terminal; None if they do not wrap. Other columns are shortened.
    """
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    for number, heading in enumerate(headings):
        wraps = first_wraps if number == 0 else None
        table.add_column(
            Text(heading),  # not markup: headings may have units in brackets
            justify="left" if number in left else "right",
            no_wrap=wraps is None,
            overflow=wraps or "ellipsis",
        )
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def console_for(stderr: bool) -> Console:
    """A console on standard output or standard error, `PIPE_WIDTH` wide if that is no terminal."""
    console = Console(stderr=stderr, highlight=False)
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, width=PIPE_WIDTH)
