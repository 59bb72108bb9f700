"""Plotly figures of a diagnosis: where the model misfits, by how much, and the residuals before and after."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from ...diagnose.diagnosis import LearnedCurve, NextExperiment, Region
from ...identify.identification import RunFit
from ..figures import INK, INPUT, RESIDUAL, RESIDUALS, SIMULATED, envelope, mark_noise, style

T = TypeVar("T")
# colours: without the effects, and with them
BEFORE = RESIDUAL
AFTER = SIMULATED
AXIS_TITLES = {
    "speed": "speed [rad/s]",
    "current": "current [A]",
    "current_rate": "rate of change of the current [A/s]",
    "voltage": "voltage [V]",
    "angle": "angle [rad]",
    "time": "fraction of the run",
}
# number of bins with equally many samples, over each of which residuals are averaged
BINS = 30
# gap over the noise above which the bars need a logarithmic axis
LOGARITHMIC_FROM = 20.0


def where_figure(regions: Sequence[Region], fits: Mapping[str, RunFit]) -> go.Figure:
    """The misfit over its standard error (z) in every region, a panel for each equation and variable.

    Axes span the range of the variable in the runs, `fits`.
    """
    kinds = list(dict.fromkeys((one.equation, one.variable) for one in regions))
    titles = [f"{equation} equation over {variable}" for equation, variable in kinds]
    figure = make_subplots(rows=len(kinds), cols=1, subplot_titles=titles, vertical_spacing=0.42 / len(kinds))
    for row, kind in enumerate(kinds, start=1):
        for one in (r for r in regions if (r.equation, r.variable) == kind):
            low, high = one.region
            block = go.Scatter(
                x=[low, low, high, high],
                y=[0, one.z, one.z, 0],
                fill="tozeroy",
                mode="lines",
                line={"color": RESIDUAL, "width": 1},
                showlegend=False,
                name=f"z = {one.z:.1f}",
            )
            figure.add_trace(block, row=row, col=1)
        axis = {"title_text": AXIS_TITLES.get(kind[1], kind[1]), "range": _range(fits, kind[1])}
        figure.update_xaxes(**axis, row=row, col=1)
        figure.update_yaxes(title_text="z", row=row, col=1)
    style(figure, height=60 + 210 * len(kinds))
    figure.update_annotations(font_size=13)
    figure.update_yaxes(zeroline=True, zerolinecolor=INK)
    return figure


def _coloured(compared: Mapping[str, T]) -> Iterator[tuple[str, T, str]]:
    """Name, content and colour of one or two models that are compared; the last is the one that was found."""
    for (name, content), colour in zip(compared.items(), (BEFORE, AFTER)[-len(compared) :], strict=True):
        yield name, content, colour


def gap_figure(errors: Mapping[str, Mapping[str, float]], floors: Mapping[str, float]) -> go.Figure:
    """Bars of the error over the noise of one or two models, by name, and the noise floor, for every run."""
    figure = go.Figure()
    for name, of_run, colour in _coloured(errors):
        bars = go.Bar(x=[*of_run], y=[*of_run.values()], name=name, marker_color=colour)
        figure.add_trace(bars)
    floor = go.Scatter(
        x=[*floors],
        y=[*floors.values()],
        name="noise floor",
        mode="markers",
        marker={"symbol": "line-ew", "size": 34, "line": {"color": INK, "width": 2}},
    )
    figure.add_trace(floor)
    style(figure, height=340)
    wide = max(max(of_run.values()) for of_run in errors.values()) > LOGARITHMIC_FROM
    figure.update_yaxes(title_text="error relative to the noise", type="log" if wide else "linear")
    figure.update_xaxes(type="category")
    return figure


def residual_figure(fits: Mapping[str, RunFit], noise: Mapping[str, float | None], points: int) -> go.Figure | None:
    """Free-run residuals over time of two models, by name; None without any output."""
    channels = [one for one in RESIDUALS if next(iter(fits.values())).residual(one) is not None]
    if not channels:
        return None
    figure = make_subplots(rows=len(channels), cols=1, shared_xaxes=True, vertical_spacing=0.05)
    for row, channel in enumerate(channels, start=1):
        title, column = RESIDUALS[channel]
        for name, fit, colour in _coloured(fits):
            residual = fit.residual(channel)
            if residual is None:
                continue
            time, values = envelope(fit.time, residual, points)
            line = {"color": colour, "width": 0.8}
            trace = go.Scatter(x=time, y=values, name=name, line=line, showlegend=row == 1, legendgroup=name)
            figure.add_trace(trace, row=row, col=1)
        mark_noise(figure, row, noise.get(column))
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time [s]", row=len(channels), col=1)
    style(figure, height=80 + 150 * len(channels))
    return figure


def residual_over_variable_figure(
    compared: Mapping[str, Mapping[str, RunFit]], variable: str, channel: str
) -> go.Figure | None:
    """The residual of all runs, averaged over bins of a variable, of one or two models, by name; None where it is not
    known."""
    figure = go.Figure()
    for name, fits, colour in _coloured(compared):
        averaged = averages(fits, variable, channel)
        if averaged is None:
            return None
        line = {"color": colour, "width": 2}
        trace = go.Scatter(x=averaged[0], y=averaged[1], name=name, mode="lines+markers", line=line)
        figure.add_trace(trace)
    style(figure, height=320)
    figure.update_xaxes(title_text=AXIS_TITLES.get(variable, variable))
    figure.update_yaxes(title_text=f"mean {RESIDUALS[channel][0]}", zeroline=True, zerolinecolor=INK)
    return figure


def averages(fits: Mapping[str, RunFit], variable: str, channel: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean variable and mean residual of all runs together, in bins of equally many samples; None without data."""
    pairs = [(_values(fit, variable), fit.residual(channel)) for fit in fits.values()]
    there = [(x, r) for x, r in pairs if x is not None and r is not None]
    if not there:
        return None
    x, residual = (np.concatenate(parts) for parts in zip(*there, strict=True))
    known = np.isfinite(x) & np.isfinite(residual)
    order = np.argsort(x[known], kind="stable")
    groups = [g for g in np.array_split(order, BINS) if len(g)]
    means = [(x[known][g].mean(), residual[known][g].mean()) for g in groups]
    return np.array([m[0] for m in means]), np.array([m[1] for m in means])


def curve_figure(curve: LearnedCurve) -> go.Figure:
    """A learned term of an equation, with a band of two standard errors either side."""
    over, under = curve.value + 2 * curve.stderr, curve.value - 2 * curve.stderr
    figure = go.Figure()
    band = go.Scatter(
        x=np.concatenate([curve.x, curve.x[::-1]]),
        y=np.concatenate([over, under[::-1]]),
        fill="toself",
        mode="none",
        fillcolor="rgba(11, 95, 204, 0.16)",
        name="two standard errors",
        hoverinfo="skip",
    )
    line = {"color": AFTER, "width": 2}
    figure.add_trace(band)
    figure.add_trace(go.Scatter(x=curve.x, y=curve.value, mode="lines+markers", line=line, name="learned"))
    style(figure, height=300)
    figure.update_xaxes(title_text=AXIS_TITLES.get(curve.variable, curve.variable))
    titles = {
        "N m": "friction [N·m]" if curve.reverses else "torque [N·m]",
        "V": "voltage [V]",
        "A": "error of the current [A]",
        "": "fraction of the speed",
    }
    title = titles[curve.unit]
    figure.update_yaxes(title_text=title, zeroline=True, zerolinecolor=INK)
    return figure


def experiment_figure(experiment: NextExperiment, points: int) -> go.Figure:
    """The voltage of the next experiment over time."""
    time, voltage = envelope(experiment.time, experiment.voltage, points)
    line = {"color": INPUT, "width": 1.2, "shape": "hv"}
    figure = go.Figure(go.Scatter(x=time, y=voltage, mode="lines", line=line, name="voltage"))
    style(figure, height=230)
    figure.update_xaxes(title_text="time [s]")
    figure.update_yaxes(title_text="voltage [V]")
    return figure


def _range(fits: Mapping[str, RunFit], variable: str) -> list[float] | None:
    """Lowest and highest value of a variable in all runs; None if no run has it."""
    parts = [values for fit in fits.values() if (values := _values(fit, variable)) is not None]
    if not parts:
        return None
    return [float(np.nanmin(np.concatenate(parts))), float(np.nanmax(np.concatenate(parts)))]


def _values(fit: RunFit, variable: str) -> np.ndarray | None:
    """The variable along a run, simulated if it was not measured, None if neither; "time" runs from 0 to 1."""
    if variable == "time":
        return np.linspace(0, 1, len(fit.time))
    measured = getattr(fit, variable, None)
    return getattr(fit, f"{variable}_simulated", None) if measured is None else np.asarray(measured)
