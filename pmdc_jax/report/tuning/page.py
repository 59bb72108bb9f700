"""The HTML page of a tuning."""

from __future__ import annotations

from pathlib import Path

from ...control.tuning import Tuning
from ..notation import percent, significant
from ..page import figure_json, write_page
from .figures import loop_figure, robust_figure
from .sentences import current_excess, limits_text, summary, time_text
from .tables import COMPARISON_HEADINGS, comparison, gain_rows

METRICS = {
    "RiseTime": ("Rise time, 10 to 90 %", "s"),
    "SettlingTime": ("Settling time", "s"),
    "Overshoot": ("Overshoot", "% of the step"),
    "Undershoot": ("Undershoot", "% of the step"),
    "Peak": ("Peak speed", "rad/s"),
    "PeakTime": ("Time of the peak", "s"),
    "SteadyStateError": ("Steady-state error", "rad/s"),
}


def write_tuning_report(tuning: Tuning, path: str | Path) -> None:
    """Write the report of a tuning to one self-contained HTML file."""
    write_page(
        path,
        "tuning.html.jinja",
        title=tuning.controller.label,
        summary=summary(tuning),
        tiles=_tiles(tuning),
        messages=tuning.messages,
        gains=gain_rows(tuning),
        headings=[heading.replace("\n", " ") for heading in COMPARISON_HEADINGS],
        comparison=comparison(tuning),
        metrics=[(METRICS[name][0], significant(value, 4), METRICS[name][1]) for name, value in tuning.metrics.items()],
        figure=figure_json(loop_figure(tuning)),
        robust=figure_json(robust_figure(tuning)) if tuning.robust else None,
        seed=tuning.seed,
        seconds=f"{tuning.seconds.get('total', 0.0):.1f} s",
    )


def _tiles(tuning: Tuning) -> list[tuple[str, str, str]]:
    """Label, number and note of each tile at the top of the report."""
    settling, overshoot = tuning.metrics["SettlingTime"], tuning.metrics["Overshoot"]
    ratio = None if settling is None else settling / tuning.fastest_possible_settling
    max_overshoot = tuning.requirements.max_overshoot
    tiles = [
        ("Settling", time_text(settling), f"{significant(ratio)} times the fastest possible"),
        ("Overshoot", percent(overshoot), f"at most {max_overshoot:g} % allowed"),
        ("Largest current", f"{significant(tuning.peak_current, 4)} A", _current_note(tuning)),
    ]
    if tuning.robust is not None:
        slow = time_text(tuning.robust.SettlingTime_p95)
        tiles.append((f"Settling, {tuning.robust.samples} motors", slow, "95th percentile"))
    peak = tuning.margins.sensitivity_peak
    tiles.append(("Sensitivity peak", significant(peak), "below 2 is robust"))
    return tiles


def _current_note(tuning: Tuning) -> str:
    limit = tuning.requirements.current_limit
    excess = current_excess(tuning.peak_current, limit)
    return f"{percent(100 * excess)} above the limit of {limit:g} A" if excess else limits_text(tuning)
