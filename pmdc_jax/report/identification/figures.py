"""Plotly figures of an identification: each run, the search, and the correlation of the estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from ...identify.identification import RunFit, Search
from ..figures import INK, INPUT, MEASURED, RESIDUAL, RESIDUALS, SIMULATED, envelope, mark_noise, style
from ..notation import fixed

MODEBAR_BUTTONS = ["toImage", "zoom2d", "pan2d", "resetScale2d"]


def count_traces(fit: RunFit) -> int:
    """Number of traces in the figure of a run."""
    return sum(len(panel.traces) for panel in _panels(fit, {}))


def run_figure(fit: RunFit, noise: Mapping[str, float | None], points: int) -> go.Figure:
    """Measured and simulated signals over a shared time axis, and the residuals underneath.

    Dashed lines mark two standard deviations of the noise either side of zero residual.
    """
    panels = _panels(fit, noise)
    heights = [panel.height for panel in panels]
    figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True, vertical_spacing=0.028, row_heights=heights)
    for row, panel in enumerate(panels, start=1):
        for trace in panel.traces:
            time, values = envelope(fit.time, trace["y"], points)
            figure.add_trace(go.Scatter(trace, x=time, y=values), row=row, col=1)
        figure.update_yaxes(title_text=panel.title, row=row, col=1)
        mark_noise(figure, row, panel.noise)
    figure.update_xaxes(title_text="time [s]", row=len(panels), col=1)
    style(figure, height=90 + int(190 * sum(heights)))
    figure.update_layout(hovermode="x unified")
    return figure


class _Panel(NamedTuple):
    """One row of a figure: axis title, relative height, traces, and noise of a residual."""

    title: str
    height: float
    traces: list[dict]
    noise: float | None = None


def _panels(fit: RunFit, noise: Mapping[str, float | None]) -> list[_Panel]:
    """The panels of a run from top to bottom, without empty ones."""
    speed = [
        _line("measured", fit.speed, MEASURED, 2.6, legend=True),
        _line("simulated", fit.speed_simulated, SIMULATED, 1.1, legend=True),
    ]
    current = [
        _line("measured", fit.current, MEASURED, 2.6, legend=fit.speed is None),
        _line("simulated", fit.current_simulated, SIMULATED, 1.1),
    ]
    # zero-order hold between samples
    voltage = _line("applied", fit.voltage, INPUT, 1.2, shape="hv")
    panels = [
        _Panel("speed<br>[rad/s]", 1.0, speed),
        _Panel("current<br>[A]", 1.0, current),
        _Panel("voltage<br>[V]", 0.55, [voltage]),
        *(_residual_panel(fit, channel, noise) for channel in RESIDUALS),
    ]
    # a quantity that was not recorded is an empty trace
    panels = [panel._replace(traces=[one for one in panel.traces if one]) for panel in panels]
    return [panel for panel in panels if panel.traces]


def _residual_panel(fit: RunFit, channel: str, noise: Mapping[str, float | None]) -> _Panel:
    title, column = RESIDUALS[channel]
    line = _line("residual", fit.residual(channel), RESIDUAL, 0.7)
    return _Panel(title, 0.55, [line], noise.get(column))


def _line(
    name: str, values: np.ndarray | None, colour: str, width: float, legend: bool = False, shape: str = "linear"
) -> dict:
    if values is None:
        return {}
    return {
        "name": name,
        "y": np.asarray(values, float),
        "mode": "lines",
        "line": {"color": colour, "width": width, "shape": shape},
        "showlegend": legend,
        "legendgroup": name,
    }


def search_figure(search: Search) -> go.Figure:
    """Best and median fitness of each generation, then every refined start, on one log scale."""
    figure = make_subplots(rows=1, cols=2, shared_yaxes=True, column_widths=[0.72, 0.28], horizontal_spacing=0.03)
    for name, values, colour in (
        ("median of the population", search.median, MEASURED),
        ("best", search.best, SIMULATED),
    ):
        trace = go.Scatter(x=np.arange(len(values)), y=_positive(values), name=name, line={"color": colour})
        figure.add_trace(trace, row=1, col=1)
    refined = go.Scatter(
        x=np.arange(1, len(search.refined) + 1),
        y=_positive(search.refined),
        name="refined start",
        mode="markers",
        marker={"color": RESIDUAL, "size": 8},
    )
    figure.add_trace(refined, row=1, col=2)
    figure.update_yaxes(type="log", exponentformat="power", dtick=1, tickfont_size=10)
    figure.update_yaxes(title_text="fitness", row=1, col=1)
    figure.update_xaxes(title_text="generation", row=1, col=1)
    figure.update_xaxes(title_text="refined start", row=1, col=2)
    figure.update_xaxes(dtick=1 if len(search.refined) <= 10 else None, row=1, col=2)
    style(figure, height=380)
    return figure


def _positive(values: np.ndarray) -> np.ndarray:
    """Values for a logarithmic axis: NaN, which leaves a gap, where not positive and finite."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)


def correlation_figure(correlation: np.ndarray, names: Sequence[str]) -> go.Figure:
    """The correlation matrix of the estimates as a heat map with its numbers."""
    text = [[fixed(value, 2) for value in row] for row in correlation]
    figure = go.Figure(
        go.Heatmap(
            z=correlation,
            x=list(names),
            y=list(names),
            text=text,
            texttemplate="%{text}",
            textfont={"color": INK},
            zmin=-1,
            zmax=1,
            xgap=2,
            ygap=2,
            colorscale=[[0, "#e39a5a"], [0.5, "#ffffff"], [1, "#7eacea"]],
            colorbar={"thickness": 12, "outlinewidth": 0, "tickvals": [-1, 0, 1]},
            hovertemplate="%{y} and %{x}: %{z:.3f}<extra></extra>",
        )
    )
    style(figure, height=60 + 52 * len(names))
    figure.update_yaxes(autorange="reversed", showgrid=False, showline=False, ticks="")
    figure.update_xaxes(showgrid=False, showline=False, ticks="", side="top")
    figure.update_layout(margin={"t": 30, "l": 40, "b": 10}, modebar={"remove": MODEBAR_BUTTONS})
    return figure


def correlations(covariance: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """The correlation matrix of the free parameters, those with a finite positive variance, and their names."""
    variance = np.diag(covariance) if np.size(covariance) else np.zeros(0)
    free = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    deviation = np.sqrt(variance[free])
    matrix = covariance[np.ix_(free, free)] / np.outer(deviation, deviation)
    return np.clip(matrix, -1, 1), tuple(names[int(index)] for index in free)
