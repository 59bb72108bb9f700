"""The tables of the paper beside ours."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Group, RenderableType
from rich.text import Text

from ...control.controllers import CONTROLLERS
from ...motor import PARAMETERS
from ...paper.printed import PRINTED, SETPOINT, TABLE_2, VOLTAGE
from ...paper.reproduction import SUFFICIENT_VOLTAGE, Paper, Recovered
from ..notation import pretty_unit, significant, thousands
from ..terminal import plain_table
from .sentences import remarks


def table_1(paper: Paper) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of Table 1: each parameter as printed, and as recovered by each method with its error."""
    headings = ["", "Printed"]
    for one in paper.recovered:
        headings += [one.method, "error [%]"]
    rows = []
    for name in PARAMETERS:
        printed = significant(float(getattr(PRINTED, name)), 4)
        row = [f"{name} [{pretty_unit(PARAMETERS[name])}]", printed]
        for one in paper.recovered:
            row += [significant(float(getattr(one.motor, name)), 4), significant(one.errors[name], 2)]
        rows.append(row)
    rows.append(_effort_row("evaluations", paper, lambda one: thousands(one.evaluations)))
    rows.append(_effort_row("time [s]", paper, lambda one: f"{one.seconds:.1f}"))
    return headings, rows


def _effort_row(name: str, paper: Paper, text_of: Callable[[Recovered], str]) -> list[str]:
    row = [name, ""]
    for one in paper.recovered:
        row += [text_of(one), ""]
    return row


def table_2(paper: Paper) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of Table 2: settling and overshoot of each controller, with the physical limits beside them."""
    headings = [
        "",
        "Printed",
        "Simulated\nas printed",
        f"Ours,\n{SUFFICIENT_VOLTAGE:g} V",
        f"Limit,\n{SUFFICIENT_VOLTAGE:g} V",
        f"Limit,\n{VOLTAGE:g} V",
    ]
    rows = []
    for kind, printed in TABLE_2.items():
        ours, simulated = paper.tunings[kind].metrics, paper.as_printed.get(kind)
        limits = (paper.fastest[SUFFICIENT_VOLTAGE], paper.fastest[VOLTAGE])
        rows.append(
            [
                f"{CONTROLLERS[kind].label}, settling [s]",
                f"{printed.settling:g}",
                significant(simulated and simulated.settling, 3),
                significant(ours["SettlingTime"], 3),
                *(significant(limit, 3) for limit in limits),
            ]
        )
        rows.append(
            [
                f"{CONTROLLERS[kind].label}, overshoot [%]",
                f"{printed.overshoot:g}",
                significant(simulated and simulated.overshoot, 3),
                significant(ours["Overshoot"], 2),
                "0",
                "0",
            ]
        )
    return headings, rows


def paper_tables(paper: Paper) -> RenderableType:
    """Both tables and the remarks."""
    tables = [
        plain_table("Table 1: the motor, from a virtual load test", *table_1(paper)),
        plain_table(f"Table 2: steps to {SETPOINT:g} rad/s", *table_2(paper)),
    ]
    return Group(tables[0], "", tables[1], "", *(Text(one) for one in remarks(paper)))
