"""Explanations of the parameter directions that the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...recordings.recording import Recording
from ...words import enumerate_words
from ..identification import Direction
from ..parameters import Parameters

# A parameter belongs to an unseen direction if it makes up at least this share of it.
MIN_SHARE = 0.05
# A direction scales the torques if, as a unit vector, it moves the logarithm of Kt by more than the first and that of
# Kb by less than the second: in proportion, Kt, J and f move by 0.6 each
MIN_MOVED_KT, MAX_MOVED_KB = 0.1, 1e-2


def moved_by(direction: np.ndarray, parameters: Parameters) -> tuple[str, ...]:
    """The parameters that belong to a direction."""
    return tuple(n for n, x in zip(parameters.names, direction, strict=True) if abs(x) > MIN_SHARE)


def sees_torque_scale(unseen: Sequence[np.ndarray], names: Sequence[str]) -> bool:
    """Whether the runs show the scale of the torques.

    If not, an unseen direction changes Kt, J and f in proportion, while Kb stays.
    """
    if not {"Kt", "Kb"} <= set(names):
        return True
    k, b = names.index("Kt"), names.index("Kb")
    return not any(abs(d[k]) > MIN_MOVED_KT and abs(d[b]) < MAX_MOVED_KB for d in unseen)


def explain_directions(
    unseen: Sequence[np.ndarray], parameters: Parameters, recordings: Sequence[Recording]
) -> tuple[Direction, ...]:
    """For each unseen direction: which parameters it moves together, why the data do not determine it, and a remedy."""
    directions = []
    for vector in unseen:
        names = moved_by(vector, parameters)
        directions.append(Direction(names, *_reason(set(names), recordings)))
    # directions that move the same parameters are reported once
    return tuple(dict.fromkeys(directions))


def _reason(names: set[str], recordings: Sequence[Recording]) -> tuple[str, str]:
    """Why the runs do not determine parameters that trade off against each other, and a remedy."""
    loads = [r.load for r in recordings if r.load is not None]
    loaded = any(np.ptp(load) > 0 or np.any(load != 0) for load in loads)
    electrical = any(r.voltage is not None for r in recordings)
    driven = any(r.drive == "torque" for r in recordings)
    measured = any(r.voltage is not None and r.current is not None for r in recordings)
    turning = any(r.speed is not None or r.angle is not None for r in recordings if not r.held)
    knows_torque = loaded or driven
    listed = enumerate_words(sorted(names))
    reasons: list[tuple[object, str, str]] = [
        (
            electrical and not measured and names & {"R", "L", "Kb", "Kt"},
            f"No run has both voltage and current, so {listed} trade off against each other",
            "Record the current too, or give values with --known",
        ),
        (
            not turning and names & {"Kb", "Kt", "J", "f"},
            f"No run with a turning rotor has a speed or an angle, so {listed} trade off against each other",
            "Record the speed or the angle too, or give values with --known",
        ),
        (
            {"J", "f"} <= names and not electrical and not knows_torque,
            "No run has a voltage or a nonzero known load torque, so only the ratios of Kt, J and f are identifiable",
            "Record the voltage too, add a run with a known load torque, or give Kt with --known",
        ),
        (
            {"Kt", "J"} <= names and not knows_torque,
            "No run has a nonzero known load torque, so only the ratios of Kt, J and f are identifiable",
            "Add a run with a known load torque, or tie Kt = Kb with --tie Kt=Kb",
        ),
        (
            names == {"L"},
            "The sampling is too slow, or the voltage too smooth, to show the electrical time constant",
            "Record voltage steps at a sample time below L / R, or give L with --known",
        ),
        (
            names == {"f"},
            "Viscous friction changes these runs by less than their noise",
            "Record long steady runs at several speeds with little load",
        ),
        (
            "J" in names and not names & {"Kt", "Kb"},
            "The speed changes too little to show the inertia",
            "Add a run with voltage steps or a rapidly changing voltage",
        ),
        (
            {"R", "Kb"} & names,
            f"Voltage, current and speed keep the same proportions, so {listed} trade off against each other",
            "Add runs at other loads, at stall, or with voltage steps",
        ),
        (
            True,
            f"The runs cannot distinguish {listed}",
            "Add a run with more excitation: voltage steps, both directions, several speeds and loads",
        ),
    ]
    return next((why, mend) for applies, why, mend in reasons if applies)
