"""The HTML page of the reproduced paper."""

from __future__ import annotations

from pathlib import Path

from ...paper.printed import LOWER_SETPOINT, SETPOINT
from ...paper.reproduction import Paper
from ..page import figure_json, write_page
from .figures import errors_figure, fitness_figure, steps_figure
from .sentences import remarks
from .tables import table_1, table_2


def write_paper_report(paper: Paper, path: str | Path) -> None:
    """Write tables, figures and remarks to one self-contained HTML file."""
    steps = f"0 to {SETPOINT:g}, then to {LOWER_SETPOINT:g} rad/s"
    load_errors_title = "Error of the steady {} against load torque"
    figures = [
        ("Fig. 4", "Best fitness against generations", fitness_figure(paper.recovered)),
        ("Fig. 5", load_errors_title.format("speed"), errors_figure(paper, "speed")),
        ("Fig. 6", load_errors_title.format("current"), errors_figure(paper, "current")),
        ("Figs 7 and 8", steps, steps_figure(paper)),
    ]
    tables = [
        ("Table 1", "The motor, from a virtual load test", *table_1(paper)),
        ("Table 2", f"Steps to {SETPOINT:g} rad/s", *table_2(paper)),
    ]
    write_page(
        path,
        "paper.html.jinja",
        setpoint=f"{SETPOINT:g}",
        remarks=remarks(paper),
        tables=tables,
        figures=[(number, title, figure_json(figure)) for number, title, figure in figures],
        fastest=[(f"{volts:g}", f"{s:.4f}") for volts, s in paper.fastest.items()],
    )
