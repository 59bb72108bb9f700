"""Results and progress in the terminal, with rich."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from attrs import evolve
from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ..identify.identification import Identification
from ..progress import ReportProgress
from ..recording import Finding
from .notation import enumerate_words, percent, significant, write_estimate
from .summary import runs_in_order, status_word, summary

STATUS_STYLES = {"identified": "green", "at_bound": "yellow", "not_identifiable": "red"}
SEVERITY_STYLES = {"error": "red", "warning": "yellow"}
PIPE_WIDTH = 100  # rich would fold tables at 80 columns where there is no terminal


def print_identification(identification: Identification) -> None:
    """Summary, parameters and fits on standard output."""
    print_tables(identification_tables(identification))


def print_tables(tables: RenderableType) -> None:
    """Tables and sentences on standard output."""
    console_for(stderr=False).print(tables)


def print_messages(messages: Iterable[str]) -> None:
    """Remarks on standard error."""
    console = console_for(stderr=True)
    for message in messages:
        console.print(Text(f"note: {message}"), soft_wrap=True)


def print_findings(identification: Identification) -> None:
    """What the data checks found, and remarks of the identification, on standard error."""
    console = console_for(stderr=True)
    runs: dict[Finding, list[str]] = {}  # what is the same in several is told once
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
def progress() -> Iterator[ReportProgress | None]:
    """A live line on standard error saying what goes on; None where that is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("starting", total=None)

        def report(doing: str, fitness: float | None = None, fraction: float | None = None) -> None:
            so_far = "" if fitness is None else f", best fitness {significant(fitness, 4)}"
            done, total = (None, None) if fraction is None else (fraction, 1.0)
            display.update(task, description=doing + so_far, completed=done, total=total)

        yield report


def parameter_table(identification: Identification) -> Table:
    """Every parameter with its uncertainty and status."""
    table = plain_table("Parameters")
    for header in ("Parameter", "Value", "Unit", "Std. error", "95 % interval", "Status"):
        left = header in ("Parameter", "Unit", "Status")
        table.add_column(header, justify="left" if left else "right", no_wrap=True)
    for name, estimate in identification.parameters.items():
        written = write_estimate(estimate)
        status = Text(status_word(estimate.status), STATUS_STYLES.get(estimate.status, ""))
        row = (written.value, written.unit, written.stderr, written.interval)
        table.add_row(Text(name), *row, status)
    return table


def _fit_table(identification: Identification) -> Table:
    table = plain_table("Free-run simulation")
    table.add_column("Run", overflow="fold")
    table.add_column("Role", no_wrap=True)
    for header in ("Speed RMSE\n[rad/s]", "Speed fit", "Current RMSE\n[A]", "Current fit"):
        table.add_column(Text(header), justify="right", no_wrap=True)
    for name, fit in runs_in_order(identification):
        table.add_row(
            Text(name),
            "hold-out" if fit.role == "holdout" else "training",
            significant(fit.speed_rmse),
            percent(fit.speed_fit_percent),
            significant(fit.current_rmse),
            percent(fit.current_fit_percent),
        )
    return table


def plain_table(title: str) -> Table:
    """A table without lines."""
    return Table(
        title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0)
    )


def console_for(stderr: bool) -> Console:
    """Standard output or standard error, wide enough where it is a pipe."""
    console = Console(stderr=stderr, highlight=False)
    return (
        console
        if console.is_terminal
        else Console(stderr=stderr, highlight=False, width=PIPE_WIDTH)
    )
