"""The report of a tuning: sentences, terminal tables, JSON, and one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attrs import asdict, filters
from rich.console import Group, RenderableType
from rich.text import Text

from ..control.controller_file import gains_of, law_content
from ..control.evaluation import SMALL_STEP, EvaluatedController, Robustness
from ..control.objective import SECOND_SETPOINT
from ..control.remarks import CURRENT_TO_REPORT
from ..control.specification import NO_OVERSHOOT
from ..control.tuning import Tuning
from .json import plain
from .notation import NARROW_SPACE, UNKNOWN, percent, pretty_unit, significant
from .terminal import plain_table

GAIN_HEADINGS = ("Gain", "Value", "Unit")
VISIBLE_EXCESS = 5e-4  # of the current over its limit
METRICS = {
    "RiseTime": ("Rise time, 10 to 90 %", "s"),
    "SettlingTime": ("Settling time", "s"),
    "Overshoot": ("Overshoot", "% of the step"),
    "Undershoot": ("Undershoot", "% of the step"),
    "Peak": ("Peak speed", "rad/s"),
    "PeakTime": ("Time of the peak", "s"),
    "SteadyStateError": ("Steady-state error", "rad/s"),
}
COMPARISON_HEADINGS = (
    "Settling\n[ms]",
    "Relative to\nfastest",
    "Overshoot\n[%]",
    "Rise\n[ms]",
    "Settling\np95 [ms]",
    "Overshoot\np95 [%]",
)


def tuning_json(tuning: Tuning) -> dict[str, Any]:
    """A tuning as plain dictionaries, lists, finite numbers and None, for JSON."""
    law = law_content(tuning.law)
    return plain(
        {
            "controller": {name: value for name, value in law.items() if name not in ("format", "limits")},
            "limits": law["limits"],
            "setpoint_rad_s": tuning.setpoint,
            "metrics": tuning.metrics,
            "fastest_possible_settling_s": tuning.fastest_possible_settling,
            "robust": _robust_json(tuning.robust),
            "load": {"torque_Nm": tuning.load_torque, **tuning.load},
            "second_step": {"to_rad_s": SECOND_SETPOINT * tuning.setpoint, **tuning.candidates[0].second_step},
            "small_step": {"to_rad_s": SMALL_STEP * tuning.setpoint, **tuning.candidates[0].small_step},
            "margins": tuning.margins,
            "noise": {"speed_rad_s": tuning.requirements.sensor_noise, "voltage_V": tuning.voltage_noise},
            "peak_current_A": tuning.peak_current,
            "meets_specification": tuning.meets_specification,
            "candidates": [_candidate_json(one) for one in tuning.candidates],
            "seed": tuning.seed,
            "seconds": tuning.seconds,
            "messages": tuning.messages,
        }
    )


def _candidate_json(one: EvaluatedController) -> dict[str, Any]:
    return {
        "name": one.name,
        "gains": gains_of(one.controller),
        "metrics": one.metrics,
        "robust": _robust_json(one.robust),
        "stable": one.stable,
    }


def _robust_json(robust: Robustness | None) -> dict[str, Any] | None:
    """The percentiles, without the values of every motor."""
    return None if robust is None else asdict(robust, filter=filters.exclude("overshoot", "settling"))


def summary(tuning: Tuning) -> list[str]:
    """The sentences at the top of the report, the most important first."""
    sentences = (
        _step_sentence(tuning),
        _load_sentence(tuning),
        _robust_sentence(tuning.robust, tuning.requirements.current_limit),
        _margin_sentence(tuning),
        _noise_sentence(tuning),
        _current_sentence(tuning.peak_current, tuning.requirements.current_limit),
    )
    return [one for one in sentences if one]


def _step_sentence(tuning: Tuning) -> str:
    settling, overshoot = tuning.metrics["SettlingTime"], tuning.metrics["Overshoot"]
    if settling is None:
        return f"The loop does not settle at {tuning.setpoint:g} rad/s."
    ratio = settling / tuning.fastest_possible_settling
    return (
        f"Settles at {tuning.setpoint:g} rad/s in {_time_text(settling)},"
        f" {significant(ratio)} times the fastest possible with {_limits_text(tuning)}"
        f" ({_time_text(tuning.fastest_possible_settling)}), {_overshoot_words(overshoot)}."
    )


def _overshoot_words(overshoot: float | None) -> str:
    if overshoot is not None and overshoot < NO_OVERSHOOT:
        return "without overshoot"
    return f"with {percent(overshoot)} overshoot"


def _limits_text(tuning: Tuning) -> str:
    hardware = tuning.hardware
    limits = f"{float(hardware.voltage_limit):g} V"
    if hardware.current_limit is not None:
        limits += f" and {float(hardware.current_limit):g} A"
    return limits


def _load_sentence(tuning: Tuning) -> str:
    if not tuning.load_torque:
        return ""
    recovery, steady_state_error = tuning.load["RecoveryTime"], tuning.load["SteadyStateError"]
    back = "does not return to the 2 % band"
    if recovery is not None:
        back = f"returns to the 2 % band after {_time_text(recovery)}" if recovery else "stays within 2 %"
    torque, deviation = significant(tuning.load_torque), significant(tuning.load["Deviation"])
    return (
        f"A load step of {torque} N·m changes the speed by {deviation} rad/s; it {back},"
        f" with a steady-state error of {significant(steady_state_error, 2)} rad/s."
    )


def _robust_sentence(robust: Robustness | None, current_limit: float | None) -> str:
    if robust is None:
        return ""
    current = ""
    if _current_excess(robust.PeakCurrent_p95 or 0.0, current_limit) > CURRENT_TO_REPORT - 1:
        current = f"; 95 % draw at most {significant(robust.PeakCurrent_p95)} A"
    slow = "more than 5 % do not settle"
    if robust.SettlingTime_p95 is not None:
        slow = f"95 % settle within {_time_text(robust.SettlingTime_p95)}"
    return (
        f"Of {robust.samples} motors drawn from the uncertainty, {slow}"
        f" and 95 % overshoot by at most {percent(robust.Overshoot_p95)}{current}."
    )


def _margin_sentence(tuning: Tuning) -> str:
    margins = tuning.margins
    if not margins.stable:
        return "The loop linearised at the set point is unstable: only its limits keep it bounded."
    parts = []
    if margins.gain_margin is not None:
        parts.append(f"gain margin {significant(margins.gain_margin)}")
    if margins.phase_margin_deg is not None:
        parts.append(f"phase margin {significant(margins.phase_margin_deg)}°")
    if margins.delay_margin_s is not None:
        parts.append(f"delay margin {_time_text(margins.delay_margin_s)}")
    return f"Margins: {', '.join(parts)}." if parts else ""


def _noise_sentence(tuning: Tuning) -> str:
    noise, voltage = tuning.requirements.sensor_noise, tuning.voltage_noise
    if not noise or voltage is None:
        return ""
    source = "" if tuning.requirements.speed_noise else ", as in the recordings,"
    return (
        f"Noise of {significant(noise)} rad/s of the speed sensor{source} moves the voltage by"
        f" {significant(voltage, 2)} V RMS."
    )


def _current_sentence(peak: float, limit: float | None) -> str:
    """By how much the current exceeds its limit, where no message says so."""
    excess = _current_excess(peak, limit)
    if not excess or excess > CURRENT_TO_REPORT - 1:
        return ""
    return (
        f"The current reaches {significant(peak, 4)} A, {percent(100 * excess)} above its limit: the law"
        " limits what it predicts for one instant of each sample."
    )


def _current_excess(peak: float, limit: float | None) -> float:
    """The largest current over its limit, less one; 0 without a limit, or where both look the same as printed."""
    excess = peak / limit - 1 if limit else 0.0
    return excess if excess > VISIBLE_EXCESS else 0.0


def _time_text(seconds: float | None) -> str:
    if seconds is None:
        return UNKNOWN
    if 0 < seconds < 1:
        return f"{significant(1e3 * seconds)}{NARROW_SPACE}ms"
    return f"{significant(seconds)}{NARROW_SPACE}s"


def tuning_tables(tuning: Tuning) -> RenderableType:
    """Gains, comparison and summary for the terminal."""
    gains = plain_table(tuning.controller.label, GAIN_HEADINGS, gain_rows(tuning))
    compared = plain_table("Step from rest", ("", *COMPARISON_HEADINGS), comparison(tuning))
    sentences = [Text(sentence) for sentence in summary(tuning)]
    return Group(gains, "", compared, "", *sentences)


def gain_rows(tuning: Tuning) -> list[tuple[str, str, str]]:
    """Name, value and unit of every gain."""
    return [
        (name.replace("_", " "), significant(value, 5), pretty_unit(tuning.controller.units[name]))
        for name, value in gains_of(tuning.controller).items()
    ]


def comparison(tuning: Tuning) -> list[tuple[str, ...]]:
    """A row for each candidate (tuned, and textbook rule if any), and one for the physical limit."""
    fastest = tuning.fastest_possible_settling
    last = ("fastest possible", significant(1e3 * fastest, 4), "1", *(UNKNOWN,) * 4)
    return [*(_candidate_row(one, fastest) for one in tuning.candidates), last]


def _candidate_row(one: EvaluatedController, fastest: float) -> tuple[str, ...]:
    settling, rise, robust = one.metrics["SettlingTime"], one.metrics["RiseTime"], one.robust
    return (
        one.name,
        significant(_milli(settling), 4),
        significant(None if settling is None else settling / fastest, 4),
        significant(one.metrics["Overshoot"], 3),
        significant(_milli(rise), 4),
        significant(None if robust is None else _milli(robust.SettlingTime_p95), 4),
        significant(None if robust is None else robust.Overshoot_p95, 3),
    )


def _current_note(tuning: Tuning) -> str:
    limit = tuning.requirements.current_limit
    excess = _current_excess(tuning.peak_current, limit)
    return f"{percent(100 * excess)} above the limit of {limit:g} A" if excess else _limits_text(tuning)


def _milli(value: float | None) -> float | None:
    return None if value is None else 1e3 * value


def write_tuning_report(tuning: Tuning, path: str | Path) -> None:
    """Write the report of a tuning to one self-contained HTML file."""
    from .page import figure_json, write_page
    from .tuning_figures import loop_figure, robust_figure

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
        ("Settling", _time_text(settling), f"{significant(ratio)} times the fastest possible"),
        ("Overshoot", percent(overshoot), f"at most {max_overshoot:g} % allowed"),
        ("Largest current", f"{significant(tuning.peak_current, 4)} A", _current_note(tuning)),
    ]
    if tuning.robust is not None:
        slow = _time_text(tuning.robust.SettlingTime_p95)
        tiles.append((f"Settling, {tuning.robust.samples} motors", slow, "95th percentile"))
    peak = tuning.margins.sensitivity_peak
    tiles.append(("Sensitivity peak", significant(peak), "below 2 is robust"))
    return tiles
