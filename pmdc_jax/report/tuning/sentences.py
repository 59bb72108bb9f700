"""A tuning in sentences."""

from __future__ import annotations

from ...control.evaluation import Robustness
from ...control.remarks import CURRENT_TO_REPORT
from ...control.specification import NO_OVERSHOOT
from ...control.tuning import Tuning
from ..notation import NARROW_SPACE, UNKNOWN, percent, significant

VISIBLE_EXCESS = 5e-4  # of the current over its limit


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
        return f"The loop does not settle at {significant(tuning.setpoint)} rad/s."
    ratio = settling / tuning.fastest_possible_settling
    return (
        f"Settles at {significant(tuning.setpoint)} rad/s in {time_text(settling)},"
        f" {significant(ratio)} times the fastest possible with {limits_text(tuning)}"
        f" ({time_text(tuning.fastest_possible_settling)}), {_overshoot_words(overshoot)}."
    )


def _overshoot_words(overshoot: float | None) -> str:
    if overshoot is not None and overshoot < NO_OVERSHOOT:
        return "without overshoot"
    return f"with {percent(overshoot)} overshoot"


def limits_text(tuning: Tuning) -> str:
    """The limits of voltage and current: "18 V and 20 A"."""
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
        back = f"returns to the 2 % band after {time_text(recovery)}" if recovery else "stays within 2 %"
    torque, deviation = significant(tuning.load_torque), significant(tuning.load["Deviation"])
    return (
        f"A load step of {torque} N·m changes the speed by {deviation} rad/s; it {back},"
        f" with a steady-state error of {significant(steady_state_error, 2)} rad/s."
    )


def _robust_sentence(robust: Robustness | None, current_limit: float | None) -> str:
    if robust is None:
        return ""
    current = ""
    if current_excess(robust.PeakCurrent_p95 or 0.0, current_limit) > CURRENT_TO_REPORT - 1:
        current = f"; 95 % draw at most {significant(robust.PeakCurrent_p95)} A"
    slow = "more than 5 % do not settle"
    if robust.SettlingTime_p95 is not None:
        slow = f"95 % settle within {time_text(robust.SettlingTime_p95)}"
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
        parts.append(f"delay margin {time_text(margins.delay_margin_s)}")
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
    excess = current_excess(peak, limit)
    if not excess or excess > CURRENT_TO_REPORT - 1:
        return ""
    return (
        f"The current reaches {significant(peak, 4)} A, {percent(100 * excess)} above its limit: the law"
        " limits what it predicts for one instant of each sample."
    )


def current_excess(peak: float, limit: float | None) -> float:
    """The largest current over its limit, less one; 0 without a limit, or where both look the same as printed."""
    excess = peak / limit - 1 if limit else 0.0
    return excess if excess > VISIBLE_EXCESS else 0.0


def time_text(seconds: float | None) -> str:
    """A time with its unit, in ms if it is below a second; a dash if it is unknown."""
    if seconds is None:
        return UNKNOWN
    if 0 < seconds < 1:
        return f"{significant(1e3 * seconds)}{NARROW_SPACE}ms"
    return f"{significant(seconds)}{NARROW_SPACE}s"
