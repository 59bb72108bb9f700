"""Remarks on the reproduced paper."""

from __future__ import annotations

from ...control.controllers import CONTROLLERS
from ...paper.printed import SETPOINT, TABLE_2, VOLTAGE
from ...paper.reproduction import SUFFICIENT_VOLTAGE, Paper


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
