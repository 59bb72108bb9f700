"""The report of the reproduced paper: terminal tables, JSON, one HTML page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from rich.console import Group, RenderableType
from rich.text import Text

from ..control.controllers import CONTROLLERS
from ..motor import PARAMETERS
from ..wheelchair import (
    LOADS,
    LOWER_SETPOINT,
    PRINTED,
    SETPOINT,
    SUFFICIENT_VOLTAGE,
    TABLE_2,
    VOLTAGE,
    AsPrinted,
    Paper,
    Recovered,
    load_errors,
)
from .figures import INPUT, MEASURED, RESIDUAL, SIMULATED, style
from .json import plain
from .notation import pretty_unit, significant, thousands
from .page import figure_json, write_page
from .terminal import plain_table

COLOURS = (RESIDUAL, SIMULATED, INPUT)


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


def remarks(paper: Paper) -> list[str]:
    """Errors and impossible results in the paper, with the numbers that show them."""
    return [
        f"{VOLTAGE:g} V reaches {paper.reach:.1f} rad/s: no controller can reach the set point of {SETPOINT:g} rad/s.",
        f"From rest at full voltage, {VOLTAGE:g} V enters the 2 % band after {paper.fastest[VOLTAGE]:.4f} s; the"
        f" printed 0.08 s takes {SUFFICIENT_VOLTAGE:g} V ({paper.fastest[SUFFICIENT_VOLTAGE]:.4f} s).",
        *_printed_remarks(paper),
        "Equation (8) prints +R/L where equation (5) gives −R/L, and multiplies the load column by u.",
        "Kt and Kb are one constant in SI; the paper has 0.0501 and 0.0492.",
        "A motor with two poles does not oscillate at any gain, so the Ziegler-Nichols rule cannot be applied to the"
        " ideal loop.",
    ]


def _printed_remarks(paper: Paper) -> list[str]:
    return [
        f"The printed gains of the {CONTROLLERS[kind].label}, simulated on the printed motor without any limit, give"
        f" {printed.overshoot:.1f} % and {printed.settling:.3f} s instead of {TABLE_2[kind].overshoot:g} % and"
        f" {TABLE_2[kind].settling:g} s, with a peak of {printed.peak_voltage:.0f} V."
        for kind, printed in paper.as_printed.items()
    ]


def paper_tables(paper: Paper) -> RenderableType:
    """Both tables and the remarks."""
    tables = [
        plain_table("Table 1: the motor, from a virtual load test", *table_1(paper)),
        plain_table(f"Table 2: steps to {SETPOINT:g} rad/s", *table_2(paper)),
    ]
    return Group(tables[0], "", tables[1], "", *(Text(one) for one in remarks(paper)))


def paper_json(paper: Paper) -> dict[str, Any]:
    """All numbers as plain dictionaries, for JSON."""
    return plain(
        {
            "table_1": {
                one.method: {
                    "parameters": {name: float(getattr(one.motor, name)) for name in PARAMETERS},
                    "error_percent": one.errors,
                    "evaluations": one.evaluations,
                    "seconds": one.seconds,
                }
                for one in paper.recovered
            },
            "table_2": {
                kind: {
                    "printed": {"Overshoot": printed.overshoot, "SettlingTime": printed.settling},
                    "simulated_as_printed": _as_printed_json(paper.as_printed.get(kind)),
                    "ours": paper.tunings[kind].metrics,
                }
                for kind, printed in TABLE_2.items()
            },
            "fastest_possible_settling_s": {f"{volts:g} V": s for volts, s in paper.fastest.items()},
            "reach_rad_s": {f"{VOLTAGE:g} V": paper.reach},
            "remarks": remarks(paper),
        }
    )


def _as_printed_json(printed: AsPrinted | None) -> dict[str, float] | None:
    if printed is None:
        return None
    return {"Overshoot": printed.overshoot, "SettlingTime": printed.settling, "PeakVoltage": printed.peak_voltage}


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


def fitness_figure(recovered: tuple[Recovered, ...]) -> go.Figure:
    """Fig. 4: the best fitness of each method over the generations."""
    figure = go.Figure()
    for one, colour in zip(recovered, COLOURS, strict=False):
        figure.add_trace(go.Scatter(x=np.arange(1, len(one.best) + 1), y=one.best, name=one.method, line_color=colour))
    figure.update_yaxes(type="log", title_text="best fitness", exponentformat="power")
    figure.update_xaxes(title_text="generation")
    style(figure, height=340)
    return figure


def errors_figure(paper: Paper, quantity: str) -> go.Figure:
    """Figs 5 and 6: error of the steady "speed" or "current" over the load torque."""
    figure = go.Figure()
    for one, colour in zip(paper.recovered, COLOURS, strict=False):
        errors = load_errors(one.motor)[quantity]
        figure.add_trace(go.Scatter(x=LOADS, y=errors, name=one.method, line_color=colour, mode="lines+markers"))
    figure.update_yaxes(title_text=f"error of {quantity} [%]")
    figure.update_xaxes(title_text="load torque [N·m]")
    style(figure, height=300)
    return figure


def steps_figure(paper: Paper) -> go.Figure:
    """Figs 7 and 8: speed over time, and below it the voltage that produces it."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[1.0, 0.5])
    for (kind, response), colour in zip(paper.steps.items(), COLOURS, strict=True):
        time = 1e3 * response.time
        shared = {"x": time, "name": CONTROLLERS[kind].label, "mode": "lines", "legendgroup": kind}
        speed = go.Scatter(**shared, y=response.speed, line={"color": colour, "width": 1.6})
        shape = {"color": colour, "width": 1.2, "shape": "hv"}
        voltage = go.Scatter(**shared, y=response.voltage, line=shape, showlegend=False)
        figure.add_trace(speed, row=1, col=1)
        figure.add_trace(voltage, row=2, col=1)
        if kind in paper.as_printed:
            printed = paper.as_printed[kind]
            thin = {"color": colour, "width": 1.2, "dash": "dot"}
            shared |= {"x": 1e3 * printed.time, "name": f"{CONTROLLERS[kind].label}, printed gains"}
            figure.add_trace(go.Scatter(**shared, y=printed.speed, line=thin), row=1, col=1)
    for level in (SETPOINT, LOWER_SETPOINT):
        line = {"color": MEASURED, "width": 1, "dash": "dash"}
        # the type annotation of `row` in plotly allows only "all"
        figure.add_hline(y=level, line=line, row=1)  # pyright: ignore[reportArgumentType]
    figure.update_yaxes(title_text="speed<br>[rad/s]", row=1, col=1)
    figure.update_yaxes(title_text="voltage<br>[V]", row=2, col=1)
    figure.update_xaxes(title_text="time [ms]", row=2, col=1)
    style(figure, height=460)
    return figure
