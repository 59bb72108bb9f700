"""Plotly figures of a tuning: the loop over time, and its spread over the drawn motors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from ...control.metrics import BAND
from ...control.objective import SECOND_SETPOINT
from ...control.tuning import Tuning
from ..figures import INPUT, MEASURED, RESIDUAL, SIMULATED, style

# rows of the loop figure
SPEED = 1
VOLTAGE = 2
CURRENT = 3
AXIS_TITLES = {SPEED: "speed<br>[rad/s]", VOLTAGE: "voltage<br>[V]", CURRENT: "current<br>[A]"}
HEIGHTS = [1.0, 0.6, 0.6]
SPREAD_COLOUR = "rgba(163,176,192,0.35)"  # MEASURED, translucent
LIMIT_LINE = {"color": RESIDUAL, "width": 0.8, "dash": "dot"}
EVENT_LINE = {"color": RESIDUAL, "width": 1, "dash": "dash"}


Traces = Iterator[tuple[int, go.Scatter]]  # each trace with its row


def loop_figure(tuning: Tuning) -> go.Figure:
    """Speed, voltage and current over time: the step, the load step, and the second step under load."""
    figure = make_subplots(rows=len(HEIGHTS), cols=1, shared_xaxes=True, vertical_spacing=0.04, row_heights=HEIGHTS)
    for traces in (_spread_traces, _setpoint_traces, _response_traces, _limit_traces):
        for row, trace in traces(tuning):
            figure.add_trace(trace, row=row, col=1)
    _mark_event(figure, tuning.fastest_possible_settling, "fastest possible")
    _mark_event(figure, tuning.load_step_time, "load")
    for row, title in AXIS_TITLES.items():
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time [ms]", row=len(HEIGHTS), col=1)
    style(figure, height=560)
    figure.update_layout(hovermode="x unified")
    return figure


def _spread_traces(tuning: Tuning) -> Traces:
    """The band from the 5 % to the 95 % quantile of the speeds of the drawn motors."""
    if tuning.validation_speeds is None:
        return
    instants = _milliseconds(tuning)
    samples = instants[:: max(1, len(instants) // tuning.validation_speeds.shape[1])]
    low, high = np.quantile(tuning.validation_speeds, [0.05, 0.95], axis=0)
    edge = {"color": MEASURED, "width": 0}
    yield SPEED, _line("5 %", samples, low, edge)
    fill = {"fill": "tonexty", "fillcolor": SPREAD_COLOUR}
    yield SPEED, _line("90 % of the motors", samples, high, edge, in_legend=True, **fill)


def _setpoint_traces(tuning: Tuning) -> Traces:
    """The set point and the 2 % band about it; its width is a share of the set point."""
    end, second = _milliseconds(tuning)[-1], 2e3 * tuning.load_step_time
    corners = np.array([0.0, second, second, end])
    share = np.array([1.0, 1.0, SECOND_SETPOINT, SECOND_SETPOINT])
    for edge in (-BAND, BAND):
        speeds = tuning.setpoint * (share + edge * share)
        yield SPEED, _line("2 % band", corners, speeds, LIMIT_LINE)
    dashed = {"color": INPUT, "width": 1.0, "dash": "dash"}
    yield SPEED, _line("set point", corners, tuning.setpoint * share, dashed, in_legend=True)


def _response_traces(tuning: Tuning) -> Traces:
    """Speed, voltage and current of the nominal motor."""
    time, response = _milliseconds(tuning).astype(np.float32), tuning.response
    line = {"color": SIMULATED, "width": 1.6}
    yield SPEED, _line("speed", time, response.speed, line, in_legend=True)
    # held from one sample to the next
    yield VOLTAGE, _line("voltage", time, response.voltage, line | {"shape": "hv"})
    yield CURRENT, _line("current", time, response.current, line)


def _limit_traces(tuning: Tuning) -> Traces:
    """The limits of the voltage, and of the current if it has one, in both directions."""
    ends, hardware = np.array([0.0, _milliseconds(tuning)[-1]]), tuning.hardware
    for row, limit in ((VOLTAGE, hardware.voltage_limit), (CURRENT, hardware.current_limit)):
        if limit is None:
            continue
        for level in (float(limit), -float(limit)):
            yield row, _line("limit", ends, np.full(2, level), LIMIT_LINE)


def _mark_event(figure: go.Figure, moment: float, label: str) -> None:
    """Draw a labelled vertical line at the time `moment`, s."""
    at = 1e3 * moment
    figure.add_vline(x=at, line=EVENT_LINE)
    figure.add_annotation(x=at, y=0.03, yref="y domain", text=label, showarrow=False, xanchor="left", xshift=4)


def _milliseconds(tuning: Tuning) -> np.ndarray:
    """The sample times of the response, ms."""
    return 1e3 * np.asarray(tuning.response.time)


def _line(
    name: str, time: np.ndarray, values: Any, line: dict[str, Any], in_legend: bool = False, **options: Any
) -> go.Scatter:
    return go.Scatter(
        x=time, y=np.asarray(values, np.float32), mode="lines", name=name, line=line, showlegend=in_legend, **options
    )


def robust_figure(tuning: Tuning) -> go.Figure:
    """Overshoot against settling time of every drawn motor that settles: a panel for each controller, because their
    clouds may be small and far apart."""
    names, clouds = [], []
    for one in (tuning.tuned, tuning.textbook):
        if one.robust is not None:
            settles = np.isfinite(one.robust.settling)
            names.append(one.name)
            clouds.append((1e3 * one.robust.settling[settles], one.robust.overshoot[settles]))
    figure = make_subplots(cols=len(names), subplot_titles=names)
    for column, (settling, overshoot) in enumerate(clouds, start=1):
        marker = {"color": (SIMULATED, RESIDUAL)[column - 1], "size": 5, "opacity": 0.6}
        trace = go.Scatter(x=settling, y=overshoot, mode="markers", marker=marker, showlegend=False, cliponaxis=False)
        figure.add_trace(trace, row=1, col=column)
        around = _range(settling, 0.02 * max(settling, default=0.0))
        figure.update_xaxes(title_text="settling [ms]", range=around, row=1, col=column)
        figure.update_yaxes(range=_range(overshoot, 0.2), row=1, col=column)
    figure.update_yaxes(title_text="overshoot [%]", row=1, col=1)
    style(figure, height=340)
    return figure


def _range(values: np.ndarray, smallest: float) -> list[float] | None:
    """The range of an axis with a margin around values of at least 0, no narrower than `smallest`; None without any."""
    if not len(values):
        return None
    low, high = float(values.min()), float(values.max())
    margin = max(0.1 * (high - low), (smallest - (high - low)) / 2)
    return [max(0.0, low - margin), high + margin]
