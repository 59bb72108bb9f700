"""Results and progress in the terminal, with rich."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from attrs import evolve
from rich.console import Console, OverflowMethod, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ..identify.identification import Identification
from ..progress import ReportProgress, silent
from ..recordings.recording import Finding
from ..words import enumerate_words
from .notation import significant

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
