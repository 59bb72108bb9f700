"""A tuning made readable: sentences, terminal tables, JSON, and one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ..control.controller_file import gains_of, law_content
from ..control.controllers import CONTROLLERS
from ..control.judge import SMALL_STEP, JudgedController, Robustness
from ..control.metrics import BAND
from ..control.objective import SECOND_SETPOINT
from ..control.tuning import Tuning
from .notation import NARROW, UNKNOWN, percent, pretty_unit, significant

TITLES = {name: kind.label for name, kind in CONTROLLERS.items()}


def tuning_json(tuning: Tuning) -> dict[str, Any]:
    """A tuning after the contract, as plain dictionaries, finite numbers and None."""
    content = law_content(tuning.law)
    limits = content.pop("limits")
    content.pop("format")
    return {
        "controller": content,
        "limits": limits,
        "setpoint_rad_s": tuning.setpoint,
        "metrics": dict(tuning.metrics),
        "fastest_possible_settling_s": tuning.fastest_possible_settling,
        "robust": _robust_json(tuning.robust),
        "load": {"torque_Nm": tuning.load_torque, **tuning.load},
        "second_step": {
            "to_rad_s": SECOND_SETPOINT * tuning.setpoint,
            **tuning.candidates[0].second_step,
        },
        "small_step": {"to_rad_s": SMALL_STEP * tuning.setpoint, **tuning.candidates[0].small_step},
        "margins": {
            name: getattr(tuning.margins, name)
            for name in (
                "stable",
                "gain_margin",
                "phase_margin_deg",
                "delay_margin_s",
                "sensitivity_peak",
                "voltage_per_noise",
                "speed_per_noise",
            )
        },
        "peak_current_A": tuning.peak_current,
        "meets_specification": tuning.meets_specification,
        "candidates": [
            {
                "name": one.name,
                "gains": gains_of(one.controller),
                "metrics": dict(one.metrics),
                "robust": _robust_json(one.robust),
                "stable": one.stable,
            }
            for one in tuning.candidates
        ],
        "seed": tuning.seed,
        "seconds": dict(tuning.seconds),
        "messages": list(tuning.messages),
    }


def _robust_json(robust: Robustness | None) -> dict[str, Any] | None:
    if robust is None:
        return None
    return {
        "samples": robust.samples,
        "Overshoot_p95": robust.Overshoot_p95,
        "SettlingTime_p95": robust.SettlingTime_p95,
    }


def summary(tuning: Tuning) -> list[str]:
    """The sentences at the top, the most important first."""
    sentences = [_step_sentence(tuning), _load_sentence(tuning)]
    if tuning.robust is not None:
        robust = tuning.robust
        slow = "do not settle"
        if robust.SettlingTime_p95 is not None:
            slow = f"settle within {_time(robust.SettlingTime_p95)}"
        sentences.append(
            f"Of {robust.samples} motors drawn from the uncertainty, 95 % {slow}"
            f" and overshoot by at most {percent(robust.Overshoot_p95)}."
        )
    sentences.append(_margin_sentence(tuning))
    return [one for one in sentences if one]


def _step_sentence(tuning: Tuning) -> str:
    settling, overshoot = tuning.metrics["SettlingTime"], tuning.metrics["Overshoot"]
    if settling is None:
        return f"The loop does not settle at {tuning.setpoint:g} rad/s."
    ratio = settling / tuning.fastest_possible_settling
    return (
        f"Settles at {tuning.setpoint:g} rad/s in {_time(settling)},"
        f" {significant(ratio)} times the fastest that {_limits(tuning)} allow"
        f" ({_time(tuning.fastest_possible_settling)}), with {percent(overshoot)} overshoot."
    )


def _limits(tuning: Tuning) -> str:
    hardware = tuning.hardware
    limits = f"{float(hardware.voltage_limit):g} V"
    if hardware.current_limit is not None:
        limits += f" and {float(hardware.current_limit):g} A"
    return limits


def _load_sentence(tuning: Tuning) -> str:
    if not tuning.load_torque:
        return ""
    recovery, left = tuning.load["RecoveryTime"], tuning.load["SteadyStateError"]
    back = "never comes back into the 2 % band"
    if recovery is not None:
        back = (
            f"is back in the 2 % band after {_time(recovery)}" if recovery else "stays within 2 %"
        )
    return (
        f"A load of {tuning.load_torque:.3g} N m moves it by {significant(tuning.load['Deviation'])}"
        f" rad/s; it {back}, with a steady error of {significant(left, 2)} rad/s."
    )


def _margin_sentence(tuning: Tuning) -> str:
    found = tuning.margins
    if not found.stable:
        return "Near the set point the linear loop is unstable: it is held together by its limits."
    parts = []
    if found.gain_margin is not None:
        parts.append(f"gain margin {significant(found.gain_margin)}")
    if found.phase_margin_deg is not None:
        parts.append(f"phase margin {significant(found.phase_margin_deg)}°")
    if found.delay_margin_s is not None:
        parts.append(f"{_time(found.delay_margin_s)} of further delay")
    return f"Margins: {', '.join(parts)}." if parts else ""


def _time(seconds: float | None) -> str:
    if seconds is None:
        return UNKNOWN
    if 0 < seconds < 1:
        return f"{significant(1e3 * seconds)}{NARROW}ms"
    return f"{significant(seconds)}{NARROW}s"


def tuning_tables(tuning: Tuning) -> RenderableType:
    """Gains and the comparison, and what they mean."""
    gains = _table(tuning.controller.label, "Gain", "Value", "Unit")
    for name, value, unit in gain_rows(tuning):
        gains.add_row(name, value, unit)
    compared = _table("Step from rest", "", *HEADINGS)
    for row in comparison(tuning):
        compared.add_row(*row)
    sentences = [Text(sentence) for sentence in summary(tuning)]
    return Group(gains, "", compared, "", *sentences)


def gain_rows(tuning: Tuning) -> list[tuple[str, str, str]]:
    """Name, value and unit of every gain."""
    return [
        (name.replace("_", " "), significant(value, 5), pretty_unit(tuning.controller.units[name]))
        for name, value in gains_of(tuning.controller).items()
    ]


HEADINGS = (
    "Settling\n[ms]",
    "Times the\nlimit",
    "Overshoot\n[%]",
    "Rise\n[ms]",
    "Settling\np95 [ms]",
    "Overshoot\np95 [%]",
)


def comparison(tuning: Tuning) -> list[tuple[str, ...]]:
    """Ours, the textbook's and the limit, a row each."""
    limit = tuning.fastest_possible_settling
    last = ("fastest possible", significant(1e3 * limit, 4), "1", *(UNKNOWN,) * 4)
    return [*(_row(one, limit) for one in tuning.candidates), last]


def _row(one: JudgedController, limit: float) -> tuple[str, ...]:
    settling, rise, robust = one.metrics["SettlingTime"], one.metrics["RiseTime"], one.robust
    return (
        one.name,
        significant(_milli(settling), 4),
        significant(None if settling is None else settling / limit, 4),
        significant(one.metrics["Overshoot"], 3),
        significant(_milli(rise), 4),
        significant(None if robust is None else _milli(robust.SettlingTime_p95), 4),
        significant(None if robust is None else robust.Overshoot_p95, 3),
    )


def _milli(value: float | None) -> float | None:
    return None if value is None else 1e3 * value


def _table(title: str, *headings: str) -> Table:
    table = Table(
        title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0)
    )
    for k, heading in enumerate(headings):
        table.add_column(Text(heading), justify="left" if k == 0 else "right", no_wrap=True)
    return table


def write_tuning_report(tuning: Tuning, path: str | Path) -> None:
    """Write the report of a tuning to one self-contained HTML file."""
    from .page import figure_json, write_page

    settling, overshoot = tuning.metrics["SettlingTime"], tuning.metrics["Overshoot"]
    ratio = None if settling is None else settling / tuning.fastest_possible_settling
    tiles = [
        ("Settling", _time(settling), f"{significant(ratio)} times the limit"),
        ("Overshoot", percent(overshoot), f"at most {tuning.asked.max_overshoot:g} % asked for"),
        ("Largest current", f"{significant(tuning.peak_current)} A", _limits(tuning)),
    ]
    if tuning.robust is not None:
        slow = _time(tuning.robust.SettlingTime_p95)
        tiles.append((f"Settling, {tuning.robust.samples} motors", slow, "95th percentile"))
    peak = tuning.margins.sensitivity_peak
    tiles.append(("Sensitivity peak", significant(peak), "below 2 is comfortable"))
    write_page(
        path,
        "tuning.html.jinja",
        title=tuning.controller.label,
        summary=summary(tuning),
        tiles=tiles,
        messages=tuning.messages,
        gains=gain_rows(tuning),
        headings=[heading.replace("\n", " ") for heading in HEADINGS],
        comparison=comparison(tuning),
        metrics=[(name, significant(value, 4)) for name, value in tuning.metrics.items()],
        figure=figure_json(loop_figure(tuning)),
        robust=figure_json(robust_figure(tuning)) if tuning.robust else None,
        seed=tuning.seed,
        seconds=f"{tuning.seconds.get('total', 0.0):.1f} s",
    )


def loop_figure(tuning: Tuning):
    """Speed, voltage and current over time: the step, then the load."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    from .figures import INPUT, MEASURED, RESIDUAL, SIMULATED, style

    response, hardware = tuning.response, tuning.hardware
    time = 1e3 * np.asarray(response.time)
    figure = make_subplots(
        rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.04, row_heights=[1.0, 0.6, 0.6]
    )

    def line(row: int, y, name: str, colour: str, shown: bool = False, **options) -> None:
        trace = go.Scatter(
            x=time[: len(y)].astype(np.float32) if "x" not in options else options.pop("x"),
            y=np.asarray(y, np.float32),
            mode="lines",
            name=name,
            line={"color": colour, "width": 1.6, **options.pop("line", {})},
            showlegend=shown,
            **options,
        )
        figure.add_trace(trace, row=row, col=1)

    if tuning.bundle is not None:
        per_sample = time[:: max(1, len(time) // tuning.bundle.shape[1])]
        low, high = np.quantile(tuning.bundle, [0.05, 0.95], axis=0)
        none = {"width": 0}
        line(1, low, "5 %", MEASURED, x=per_sample, line=none)
        fill = {"fill": "tonexty", "fillcolor": "rgba(163,176,192,0.35)"}
        line(1, high, "90 % of the motors", MEASURED, True, x=per_sample, line=none, **fill)
    ends, down = np.array([0.0, time[-1]]), 2e3 * tuning.load_from
    corners, target = (
        np.array([0.0, down, down, time[-1]]),
        np.array([1.0, 1.0, SECOND_SETPOINT, SECOND_SETPOINT]),
    )
    for edge in (-BAND, BAND):
        band = tuning.setpoint * (
            target + edge * np.array([1.0, 1.0, SECOND_SETPOINT, SECOND_SETPOINT])
        )
        line(1, band, "2 % band", RESIDUAL, x=corners, line={"width": 0.8, "dash": "dot"})
    wanted = tuning.setpoint * target
    line(1, wanted, "set point", INPUT, True, x=corners, line={"width": 1.0, "dash": "dash"})
    line(1, response.speed, "speed", SIMULATED, True)
    line(2, response.voltage, "voltage", SIMULATED, line={"shape": "hv"})
    line(3, response.current, "current", SIMULATED)
    limits = {2: float(hardware.voltage_limit)}
    if hardware.current_limit is not None:
        limits[3] = float(hardware.current_limit)
    for row, limit in limits.items():
        line(row, [limit, limit], "limit", RESIDUAL, x=ends, line={"width": 0.8, "dash": "dot"})
    fastest = 1e3 * tuning.fastest_possible_settling
    marks = ((fastest, "fastest possible"), (1e3 * tuning.load_from, "load"))
    for at, label in marks:
        figure.add_vline(x=at, line={"color": RESIDUAL, "width": 1, "dash": "dash"})
        figure.add_annotation(
            x=at, y=0.03, yref="y domain", text=label, showarrow=False, xanchor="left", xshift=4
        )
    for row, title in enumerate(("speed<br>[rad/s]", "voltage<br>[V]", "current<br>[A]"), start=1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time [ms]", row=3, col=1)
    style(figure, height=560)
    figure.update_layout(hovermode="x unified")
    return figure


def robust_figure(tuning: Tuning):
    """Overshoot against settling time of every drawn motor, ours beside the textbook's."""
    import plotly.graph_objects as go

    from .figures import RESIDUAL, SIMULATED, style

    figure = go.Figure()
    for one, colour in zip(tuning.candidates, (SIMULATED, RESIDUAL), strict=False):
        if one.robust is None:
            continue
        settles = np.isfinite(one.robust.settling)
        figure.add_trace(
            go.Scatter(
                x=1e3 * one.robust.settling[settles],
                y=one.robust.overshoot[settles],
                mode="markers",
                name=one.name,
                marker={"color": colour, "size": 5, "opacity": 0.6},
            )
        )
    figure.update_xaxes(title_text="settling [ms]")
    figure.update_yaxes(title_text="overshoot [%]", rangemode="tozero")
    style(figure, height=340)
    return figure
