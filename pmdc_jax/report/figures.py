"""Plotly figures of results. Long runs are thinned for display without loss of peaks."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from ..recordings.readings import reading_interval

# colours
MEASURED = "#a3b0c0"
SIMULATED = "#0b5fcc"
RESIDUAL = "#c9702b"
INPUT = "#4b5563"
INK = "#27313f"
GRID = "#e6e9ee"
EDGE = "#c3cad4"
NOISE_LINE = {"color": INK, "width": 1, "dash": "4px 3px"}
FONT = "Inter, system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
# by channel: axis title of its residual, and key of its noise
RESIDUALS = {"speed": ("Δ speed<br>[rad/s]", "speed_rad_s"), "current": ("Δ current<br>[A]", "current_A")}

POINTS_PER_TRACE = 4000
POINTS_PER_PAGE = 90_000  # about one megabyte as base64: the page stays under 6 MB with plotly.js


def points_per_trace(traces: int) -> int:
    """Number of points for each of `traces` traces that keeps the whole page small."""
    return min(POINTS_PER_TRACE, max(200, POINTS_PER_PAGE // max(traces, 1)))


def mark_noise(figure: go.Figure, row: int, noise: float | None) -> None:
    """Draw dashed lines two standard deviations of the noise either side of zero, if it is known."""
    for level in (-2 * noise, 2 * noise) if noise else ():
        # the type annotation of `row` in plotly allows only "all"
        figure.add_hline(y=level, line=NOISE_LINE, row=row)  # pyright: ignore[reportArgumentType]


def envelope(time: np.ndarray, values: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin a trace to at most `points` samples (even): the lowest and highest of each group of neighbours, in order.

    Unlike decimation this keeps every peak, but shows noise at its full width. Of a sensor slower than the log only the
    readings are drawn, joined by lines.
    """
    known = ~np.isnan(values)
    if reading_interval(known) > 1:
        time, values = time[known], values[known]
    if len(values) > points:
        group = group_size(len(values), points)
        padding = (0, -len(values) % group)
        groups = np.pad(values, padding, mode="edge").reshape(-1, group)
        lowest = np.where(np.isnan(groups), np.inf, groups).argmin(axis=1)
        highest = np.where(np.isnan(groups), -np.inf, groups).argmax(axis=1)
        inside = np.sort(np.stack([lowest, highest], axis=1), axis=1)
        keep = inside + group * np.arange(len(groups))[:, None]
        keep = np.minimum(keep.ravel(), len(values) - 1)
        time, values = time[keep], values[keep]
    exact = np.abs(time).max(initial=0.0) > 1e5  # absolute times, which float32 would round
    return np.asarray(time, float if exact else np.float32), np.asarray(values, np.float32)


def group_size(samples: int, points: int) -> int:
    """Number of samples in each group of which a thinned trace keeps the lowest and the highest."""
    return -(-2 * samples // points)


AXIS = {"gridcolor": GRID, "zeroline": False, "linecolor": EDGE, "title": {"font": {"size": 12}}}
# in place of plotly's default template, which would add 7 kB to every figure
TEMPLATE = go.layout.Template(
    layout={
        "margin": {"l": 62, "r": 12, "t": 34, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#ffffff",
        "font": {"family": FONT, "size": 12, "color": INK},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "hoverlabel": {"font": {"family": FONT}},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#9aa5b4", "activecolor": INK},
        "xaxis": AXIS | {"showline": True, "ticks": "outside", "tickcolor": EDGE, "ticklen": 4},
        "yaxis": AXIS | {"title": AXIS["title"] | {"standoff": 6}},
    }
)


def style(figure: go.Figure, height: int) -> None:
    """Apply the template common to all figures, and a height in pixels."""
    figure.update_layout(template=TEMPLATE, height=height)
