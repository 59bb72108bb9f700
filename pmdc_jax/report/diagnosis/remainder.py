"""What the final model of a diagnosis leaves unexplained, in sentences."""

from __future__ import annotations

import numpy as np

from ...diagnose.diagnosis import Diagnosis, LearnedCurve, VaryingParameter
from ...words import enumerate_words
from ..notation import estimate_words, p_value_words, percent, significant, value_with_unit
from .places import place_in_words

# What makes a parameter of a motor differ from run to run
REASONS = {
    "R": "a warmer winding or another cable",
    "L": "another current or another cable",
    "Kb": "warmer magnets, or a sensor with another gain",
    "Kt": "warmer magnets, or a sensor with another gain",
    "J": "another inertia on the shaft",
    "f": "warmer bearings, or another load",
}


def rest_sentence(diagnosis: Diagnosis) -> str:
    """What is left beside noise; empty if nothing is."""
    if diagnosis.varies:
        rest = varying_sentence(diagnosis, diagnosis.varies)
    elif diagnosis.leaves_noise:
        return ""
    elif diagnosis.curves:
        rest = curve_sentence(diagnosis)
    else:
        return (
            "The remaining error is small compared with the effect, but exceeds the noise: as much as another formula"
            " of the same effect would leave. The intervals do not cover it."
        )
    return f"Not only noise is left. {rest}"


def curve_sentence(diagnosis: Diagnosis) -> str:
    """What the clearest unknown term looks like."""
    curve = diagnosis.curves[0]
    if curve.variable == "current_rate":
        looks = _late_current(curve)
    elif curve.equation == "sensor":
        looks = _oscillating_speed(curve, diagnosis.final.missed.get("current"))
    else:
        looks = _missing_term(curve)
    return f"Estimated from the data, it looks most like a {looks}"


def _late_current(curve: LearnedCurve) -> str:
    late = -curve.value[-1] / curve.x[-1]
    when = "late" if late > 0 else "early"
    return (
        f"current that is read {when}, by {value_with_unit(abs(late), 's')} ({p_value_words(curve.p_value)}): current,"
        " voltage and speed are not filtered alike. Record all of them unfiltered, or filter all in the same way."
    )


def _oscillating_speed(curve: LearnedCurve, current_residual: float | None) -> str:
    """**Arguments**: `current_residual`, that of the current over its white noise, if that is large."""
    times, share = 2 * np.pi / curve.x[-1], 100 * float(np.max(np.abs(curve.value)))
    causes = "tachometer ripple, or an eccentric encoder"
    if current_residual:
        causes = (
            f"but no sensor of the speed disturbs the current, whose residual is {significant(current_residual)} times"
            " its white noise. Something on the shaft varies with its angle, such as the inertia of a crank"
        )
    return (
        f"speed reading that oscillates {significant(times)} times per turn, by {percent(share)} of the speed"
        f" ({p_value_words(curve.p_value)}): {causes}."
    )


def _missing_term(curve: LearnedCurve) -> str:
    known = curve.stderr > 0
    peak = int(np.argmax(np.abs(curve.value) / np.where(known, curve.stderr, np.inf)))
    torque = "friction torque" if curve.reverses else "torque opposing motion"
    kind = torque if curve.unit == "N m" else "voltage at the terminals"
    value, place = value_with_unit(curve.value[peak], curve.unit), place_in_words(curve.variable, curve.x[peak])
    return f"{kind} over {curve.variable}, most significant with {value} {place} ({p_value_words(curve.p_value)})."


def varying_sentence(diagnosis: Diagnosis, varies: VaryingParameter) -> str:
    """What differs from run to run, why it may, and how much of the gap a value for each run closes."""
    by_size = sorted(varies.by_run, key=lambda run: varies.by_run[run].value or 0.0)
    ends = [f"{estimate_words(varies.by_run[run])} in the run {run}" for run in (by_size[0], by_size[-1])]
    other = f" (or {enumerate_words(varies.also_possible)})" if varies.also_possible else ""
    run, gap = max(diagnosis.gap_by_own_value.items(), key=lambda named: named[1].before - named[1].after)
    closes = (
        f" With a value for each run, the error of the run {run} falls from {significant(gap.before)} to"
        f" {significant(gap.after)} times the noise."
    )
    return (
        f"{varies.name}{other} is not the same in all runs: {ends[0]}, {ends[1]} ({p_value_words(varies.p_value)}),"
        f" as {REASONS[varies.name]} would make it.{closes if gap.after < gap.before else ''} Record all runs in one"
        " state of the motor, or identify those of each state separately."
    )


def slow_rest_sentence(diagnosis: Diagnosis) -> str:
    """A warning that what counts as noise exceeds the white noise of the sensors; empty where it does not, or where
    something differs from run to run."""
    rest = [
        f"{significant(times)} times the white noise of the {name}" for name, times in diagnosis.final.missed.items()
    ]
    if not rest or diagnosis.varies:
        return ""
    return (
        f"The remaining residual was treated as noise, but is {enumerate_words(rest)}: a fluctuating torque may cause"
        " this, and so may another missing effect. Inspect the residuals over time."
    )


def held_out_sentence(diagnosis: Diagnosis) -> str:
    """That the hold-outs are reproduced far worse than the fitted runs, if they are."""
    if not (beyond := diagnosis.beyond_fitted):
        return ""
    return (
        f"The error of the held-out runs is {significant(beyond)} times that of the training runs: they contain"
        " something that the training runs do not show. Include one of them in the fit."
    )


def run_apart_sentence(diagnosis: Diagnosis) -> str:
    """Which single run holds what is left; empty if all do, if nothing is left, or if a parameter differs there."""
    if diagnosis.run_apart is None or diagnosis.varies:
        return ""
    name, ratio = diagnosis.run_apart
    return (
        f"The error is largest in the run {name}, {significant(ratio)} times that of any other: something acted there"
        " that was not recorded, such as a changing load, or that the other runs do not excite. Record it as well, or"
        " diagnose the other runs without this one."
    )
