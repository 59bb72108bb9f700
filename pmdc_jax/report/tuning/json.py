"""A tuning as JSON."""

from __future__ import annotations

from typing import Any

from attrs import asdict, filters

from ...control.controller_file import gains_of, law_content
from ...control.evaluation import SMALL_STEP, EvaluatedController, Robustness
from ...control.objective import SECOND_SETPOINT
from ...control.tuning import Tuning
from ..json import plain


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
            "second_step": {"to_rad_s": SECOND_SETPOINT * tuning.setpoint, **tuning.tuned.second_step},
            "small_step": {"to_rad_s": SMALL_STEP * tuning.setpoint, **tuning.tuned.small_step},
            "margins": tuning.margins,
            "noise": {"speed_rad_s": tuning.requirements.sensor_noise, "voltage_V": tuning.voltage_noise},
            "peak_current_A": tuning.peak_current,
            "meets_specification": tuning.meets_specification,
            "candidates": [_candidate_json(one) for one in (tuning.tuned, tuning.textbook)],
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
        "stable": one.margins.stable,
    }


def _robust_json(robust: Robustness | None) -> dict[str, Any] | None:
    """The percentiles, without the values of every motor."""
    return None if robust is None else asdict(robust, filter=filters.exclude("overshoot", "settling"))
