"""The figures of the paper, drawn again with plotly."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from ...control.controllers import CONTROLLERS
from ...paper.printed import LOADS, LOWER_SETPOINT, SETPOINT
from ...paper.reproduction import Paper, Recovered, load_errors
from ..figures import INPUT, MEASURED, RESIDUAL, SIMULATED, style

COLOURS = (RESIDUAL, SIMULATED, INPUT)


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
