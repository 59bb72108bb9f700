"""The reproduced paper as JSON."""

from __future__ import annotations

from typing import Any

from ...motor import PARAMETERS
from ...paper.printed import TABLE_2, VOLTAGE
from ...paper.reproduction import AsPrinted, Paper
from ..json import plain
from .sentences import remarks


def paper_json(paper: Paper) -> dict[str, Any]:
    """All numbers as plain dictionaries, for JSON."""
    return plain(
        {
            "table_1": {
                one.method: {
                    "parameters": {name: float(getattr(one.motor, name)) for name in PARAMETERS},
                    "error_percent": one.errors,
                    "evaluations": one.evaluations,
                    "seconds": one.seconds,
                }
                for one in paper.recovered
            },
            "table_2": {
                kind: {
                    "printed": {"Overshoot": printed.overshoot, "SettlingTime": printed.settling},
                    "simulated_as_printed": _as_printed_json(paper.as_printed.get(kind)),
                    "ours": paper.tunings[kind].metrics,
                }
                for kind, printed in TABLE_2.items()
            },
            "fastest_possible_settling_s": {f"{volts:g} V": s for volts, s in paper.fastest.items()},
            "reach_rad_s": {f"{VOLTAGE:g} V": paper.reach},
            "remarks": remarks(paper),
        }
    )


def _as_printed_json(printed: AsPrinted | None) -> dict[str, float] | None:
    if printed is None:
        return None
    return {"Overshoot": printed.overshoot, "SettlingTime": printed.settling, "PeakVoltage": printed.peak_voltage}
