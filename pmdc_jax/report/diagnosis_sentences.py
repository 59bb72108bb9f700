"""A diagnosis in plain English: where simulation and recordings disagree, what is missing, what adding it did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..diagnose.diagnosis import (
    Detectable,
    Diagnosis,
    EffectFound,
    LearnedCurve,
    Region,
    VaryingParameter,
    effects_worsen_holdouts,
    holdouts_show_more,
)
from ..diagnose.hypotheses.effect_relations import CONTAINS, unbalanced_equation
from ..identify.identification import Estimate, Role, RunFit
from ..words import enumerate_words
from .identification_sentences import as_sentence, cautions, role_word
from .notation import effect_words, field_words, p_value_words, percent, significant, value_with_unit, write_estimate

VERDICTS = {
    "named": "named",
    "ambiguous": "ambiguous",
    "none_detected": "none detected",
    "not_in_library": "not in the library",
}
VARIABLE_UNITS = {"speed": "rad/s", "current": "A", "voltage": "V", "angle": "rad", "frequency": "Hz"}
# a parameter whose change in % is smaller is not mentioned
MIN_DRIFT = 1.0
# the regions of both directions are described as one if their far ends differ by no more than this factor
MAX_END_RATIO = 2.0

Interval = tuple[float, float]


def verdict_sentences(diagnosis: Diagnosis) -> list[str]:
    """What was found and what it means, the most important first."""
    tell = {
        "none_detected": _none_detected,
        "named": _named,
        "ambiguous": _ambiguous,
        "not_in_library": _not_in_library,
    }
    sentences = tell[diagnosis.verdict](diagnosis)
    if diagnosis.effects:
        sentences += [_gap_sentence(diagnosis), _drift_sentence(diagnosis)]
    if diagnosis.verdict != "not_in_library":
        sentences += [_formula_sentence(diagnosis), _slow_rest_sentence(diagnosis), _held_out_sentence(diagnosis)]
    sentences.append(_run_apart_sentence(diagnosis))
    return [sentence for sentence in sentences if sentence] + cautions(diagnosis.final)


def _none_detected(diagnosis: Diagnosis) -> list[str]:
    return [
        "No missing effect was detected: simulation and measurement differ by no more than the noise"
        f" explains ({p_value_words(diagnosis.p_nothing)}).",
        _detectable_sentence("", diagnosis),
    ]


def _named(diagnosis: Diagnosis) -> list[str]:
    return [
        _disagreement_sentence(diagnosis),
        f"Missing: {_effects_in_words(diagnosis)}. Added to the model.",
        _detectable_sentence("No other effect of the library was detected: ", diagnosis),
    ]


def _ambiguous(diagnosis: Diagnosis) -> list[str]:
    names = [effect.name for effect in diagnosis.effects]
    sets = [names, *diagnosis.rivals]
    either = " or ".join(enumerate_words([effect_words(name) for name in one]) for one in sets)
    return [
        _disagreement_sentence(diagnosis),
        f"These runs do not determine what is missing: {either} would explain them equally well.",
        f"Added to the model, as the best fit: {_effects_in_words(diagnosis)}.",
        _experiment_sentence(diagnosis),
    ]


def _not_in_library(diagnosis: Diagnosis) -> list[str]:
    sentences = [_disagreement_sentence(diagnosis)]
    if diagnosis.effects:
        rest = "" if holdouts_show_more(diagnosis.gap) else "; no effect of the library explains the rest"
        subject = _capitalised(_effects_in_words(diagnosis))
        verb, added = ("explain", "were") if len(diagnosis.effects) > 1 else ("explains", "was")
        sentences.append(f"{subject} {verb} part of this and {added} added to the model{rest}.")
    elif not diagnosis.varies:
        sentences.append("Something is missing that no effect of the library explains.")
    if diagnosis.varies:
        sentences.append(_varying_sentence(diagnosis, diagnosis.varies))
    elif diagnosis.curves:
        sentences.append(_curve_sentence(diagnosis.curves[0]))
    # a misread current or speed leaves the electrical equation unbalanced, too
    misread = any(curve.equation == "sensor" for curve in diagnosis.curves[:1])
    if diagnosis.breaks_electrical_equation and not (misread or diagnosis.varies):
        sentences.append(
            "From sample to sample the current deviates from the prediction by voltage and speed by"
            f" {significant(diagnosis.electrical_misfit)} times what the sensor noise explains, which no torque"
            " can cause: what is missing acts on voltage or current, such as a sagging supply where the recorded"
            " voltage is duty cycle times nominal voltage; or the recorded current was filtered or averaged."
        )
    sentences.append(_held_out_sentence(diagnosis))
    if effects_worsen_holdouts(diagnosis.gap):
        sentences.append(
            "The addition increases the error of the held-out runs: something else is missing that looks alike in the"
            " training runs. Include one of the held-out runs in the fit."
        )
    return [*sentences, "The parameters compensate for what is missing: the intervals do not cover this error."]


def _held_out_sentence(diagnosis: Diagnosis) -> str:
    """That the hold-outs are reproduced far worse than the fitted runs, if they are."""
    if not (beyond := diagnosis.beyond_fitted):
        return ""
    return (
        f"The error of the held-out runs is {significant(beyond)} times that of the training runs: they contain"
        " something that the training runs do not show. Include one of them in the fit."
    )


def _curve_sentence(curve: LearnedCurve) -> str:
    """What the clearest unknown term looks like."""
    chance = p_value_words(curve.p_value)
    if curve.variable == "current_rate":
        late = -curve.value[-1] / curve.x[-1]
        when = "late" if late > 0 else "early"
        return (
            f"Estimated from the data, it looks most like a current that is read {when}, by"
            f" {value_with_unit(abs(late), 's')} ({chance}): current, voltage and speed are not filtered alike. Record"
            " all of them unfiltered, or filter all in the same way."
        )
    if curve.equation == "sensor":
        times, share = 2 * np.pi / curve.x[-1], 100 * float(np.max(np.abs(curve.value)))
        return (
            f"Estimated from the data, it looks most like a speed reading that oscillates {significant(times)} times"
            f" per turn, by {percent(share)} of the speed ({chance}): tachometer ripple, or an eccentric encoder."
        )
    known = curve.stderr > 0
    peak = int(np.argmax(np.abs(curve.value) / np.where(known, curve.stderr, np.inf)))
    torque = "friction torque" if curve.reverses else "torque opposing motion"
    kind = torque if curve.unit == "N m" else "voltage at the terminals"
    value = value_with_unit(curve.value[peak], curve.unit)
    return (
        f"Estimated from the data, it looks most like a {kind} over {curve.variable}, most significant with"
        f" {value} {place_in_words(curve.variable, curve.x[peak])} ({chance})."
    )


def disagreement(regions: Sequence[Region], fits: Mapping[str, RunFit]) -> str:
    """Which equation disagrees, and where, in words: by the clearest region and those of the same variable."""
    if not regions:
        return "by more than noise"
    clearest = regions[0]
    kind = _equation_and_variable(clearest)
    alike = [region.region for region in regions if _equation_and_variable(region) == kind]
    largest = _largest_size(clearest.variable, fits)
    where = intervals_in_words(clearest.variable, alike, largest)
    return f"in the {clearest.equation} equation, {where}"


def intervals_in_words(variable: str, intervals: Sequence[Interval], largest: float | None = None) -> str:
    """Intervals of one variable in words; `largest` is its largest magnitude in the runs, a few outliers excluded."""
    joined = _merged(intervals)
    if variable == "time":
        parts = [f"{percent(100 * low)} to {percent(100 * high)}" for low, high in joined]
        return f"from {enumerate_words(parts)} of the run"
    unit = VARIABLE_UNITS.get(variable, "")
    ends = _symmetric(joined)
    if ends is None:
        parts = [f"from {significant(low)} to {significant(high)} {unit}" for low, high in joined]
        named = "" if variable == "speed" else f"at a {variable} "
        return named + enumerate_words(parts)
    low, high = ends
    size = f"from {significant(low)} to {significant(high)} {unit}"
    if low == 0:
        size = f"below {significant(high)} {unit}"
    if largest is not None and low == 0 and high > 0.95 * largest:
        return f"at every {variable}, in both directions"
    named = "" if variable == "speed" else f"at a {variable} "
    return f"{named}{size}, in both directions"


def _merged(intervals: Sequence[Interval]) -> list[Interval]:
    """The intervals in order, with those that touch merged."""
    joined: list[Interval] = []
    for low, high in sorted(intervals):
        if joined and low <= joined[-1][1]:
            begin, end = joined.pop()
            low, high = begin, max(high, end)
        joined.append((low, high))
    return joined


def _symmetric(intervals: Sequence[Interval]) -> Interval | None:
    """The range of magnitudes that describes both directions; None if they differ, or there is only one."""
    forward = [(max(low, 0.0), high) for low, high in intervals if high > 0]
    backward = [(max(-high, 0.0), -low) for low, high in intervals if low < 0]
    if not (forward and backward):
        return None
    (nearest, farthest) = zip(*(_ends(side) for side in (forward, backward)), strict=True)
    if max(farthest) > MAX_END_RATIO * min(farthest):
        return None
    return min(nearest), max(farthest)


def _ends(intervals: Sequence[Interval]) -> Interval:
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)


def _largest_size(variable: str, fits: Mapping[str, RunFit]) -> float | None:
    values = [getattr(fit, variable, None) for fit in fits.values()]
    # the knots of the curves end at this quantile
    sizes = [np.nanquantile(np.abs(one), 0.999) for one in values if one is not None and len(one)]
    return float(max(sizes)) if sizes else None


def _equation_and_variable(region: Region) -> tuple[str, str]:
    return region.equation, region.variable


def _disagreement_sentence(diagnosis: Diagnosis) -> str:
    # parameters that compensate for what is missing make the other equation disagree, too: leave that out
    of = {unbalanced_equation(effect.equation) for effect in diagnosis.effects}
    regions = [region for region in diagnosis.where if region.equation in of] or diagnosis.where
    return f"Simulation and measurement disagree {disagreement(regions, diagnosis.base.fit)}."


def _effects_in_words(diagnosis: Diagnosis) -> str:
    return enumerate_words([_effect_in_words(effect) for effect in diagnosis.effects])


def _effect_in_words(effect: EffectFound) -> str:
    """ "Stribeck friction (coulomb 61 mN·m, static 148 mN·m, speed 11 rad/s; p < 0.001)"."""
    values = [
        f"{field_words(effect.name, field)} {_value_in_words(estimate)}"
        for field, estimate in effect.parameters.items()
    ]
    name, chance = effect_words(effect.name), p_value_words(effect.p_value)
    if len(values) == 1:
        (only,) = effect.parameters.values()
        return f"{name} of {_value_in_words(only)} ({chance})"
    return f"{name} ({', '.join(values)}; {chance})"


def _value_in_words(estimate: Estimate) -> str:
    written = write_estimate(estimate)
    return f"{written.value} {written.unit}".strip()


def place_in_words(variable: str, value: float) -> str:
    """Where on the axis of a variable."""
    if variable == "time":
        return f"at {percent(100 * float(value))} of the run"
    return f"at {significant(float(value))} {VARIABLE_UNITS.get(variable, '')}".strip()


def _experiment_sentence(diagnosis: Diagnosis) -> str:
    experiment = diagnosis.next_experiment
    if experiment is None:
        return "No experiment within the recorded voltage range was found that would distinguish them."
    return (
        f"To decide, record this: {as_sentence(experiment.description)} It distinguishes them with a"
        f" probability of {percent(100 * experiment.power)}; --experiment OUT.csv writes its voltage."
    )


def detectable_others(diagnosis: Diagnosis) -> list[Detectable]:
    """The smallest amplitudes of the effects that were not found, nor are part of one that was."""
    named = {effect.name for effect in diagnosis.effects}
    named |= {part for name in named for part in CONTAINS.get(name, set())}
    return [one for one in diagnosis.detectable if one.effect not in named]


# the three effects that drives most often have, for a sentence; the table of the report has all
COMMON_EFFECTS = ("coulomb_friction", "constant_load", "brush_voltage_drop")


def _detectable_sentence(begin: str, diagnosis: Diagnosis) -> str:
    told = [one for one in detectable_others(diagnosis) if one.effect in COMMON_EFFECTS]
    parts = [f"{effect_words(x.effect)} above {value_with_unit(x.amplitude, x.unit)}" for x in told]
    if not parts:
        return ""
    sentence = f"{begin}{enumerate_words(parts)} would have been detected with 90 % probability."
    return sentence[0].upper() + sentence[1:]


def judged_role(diagnosis: Diagnosis) -> Role:
    """The role of the runs by which the result is judged: hold-outs where there are any."""
    return "holdout" if "holdout" in diagnosis.gap else "train"


def _gap_sentence(diagnosis: Diagnosis) -> str:
    role = judged_role(diagnosis)
    gap = diagnosis.gap[role]
    what = role_word(role).capitalize()
    sentence = f"{what} error from {significant(gap.before)} to {significant(gap.after)} times the noise"
    if diagnosis.closed_fraction is None or diagnosis.closed_fraction <= 0:
        return f"{sentence}."
    return f"{sentence}: {percent(100 * diagnosis.closed_fraction)} of the gap is closed."


def _formula_sentence(diagnosis: Diagnosis) -> str:
    if diagnosis.varies:
        return f"Not only noise is left. {_varying_sentence(diagnosis, diagnosis.varies)}"
    if diagnosis.leaves_noise or not diagnosis.effects:
        return ""
    if diagnosis.curves:
        return f"Not only noise is left. {_curve_sentence(diagnosis.curves[0])}"
    return (
        "The remaining error is small compared with the effect, but exceeds the noise: as much as another formula of"
        " the same effect would leave. The intervals do not cover it."
    )


def _slow_rest_sentence(diagnosis: Diagnosis) -> str:
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


# What makes a parameter of a motor differ from run to run
REASONS = {
    "R": "a warmer winding or another cable",
    "L": "another current or another cable",
    "Kb": "warmer magnets, or a sensor with another gain",
    "Kt": "warmer magnets, or a sensor with another gain",
    "J": "another inertia on the shaft",
    "f": "warmer bearings, or another load",
}


def _varying_sentence(diagnosis: Diagnosis, varies: VaryingParameter) -> str:
    """What differs from run to run, why it may, and how much of the gap a value for each run closes."""
    by_size = sorted(varies.by_run, key=lambda run: varies.by_run[run].value or 0.0)
    ends = [f"{_value_in_words(varies.by_run[run])} in the run {run}" for run in (by_size[0], by_size[-1])]
    other = f" (or {enumerate_words(varies.also_possible)})" if varies.also_possible else ""
    run, gap = max(diagnosis.gap_by_own_value.items(), key=lambda named: named[1].before)
    return (
        f"{varies.name}{other} is not the same in all runs: {ends[0]}, {ends[1]} ({p_value_words(varies.p_value)}),"
        f" as {REASONS[varies.name]} would make it. With a value for each run, the error of the run {run} falls from"
        f" {significant(gap.before)} to {significant(gap.after)} times the noise. Record all runs in one state of the"
        " motor, or identify those of each state separately."
    )


def _run_apart_sentence(diagnosis: Diagnosis) -> str:
    """Which single run holds what is left; empty if all do, if nothing is left, or if a parameter differs there."""
    if diagnosis.run_apart is None or diagnosis.varies:
        return ""
    name, ratio = diagnosis.run_apart
    return (
        f"The error is largest in the run {name}, {significant(ratio)} times that of any other: something acted there"
        " that was not recorded, such as a changing load, or that the other runs do not excite. Record it as well, or"
        " diagnose the other runs without this one."
    )


class Drift(NamedTuple):
    """A parameter of the plain motor before and after the effects were added."""

    name: str
    before: Estimate
    after: Estimate

    @property
    def is_known(self) -> bool:
        """Whether the recordings determined it in both fits: a change from a limit of the search means nothing."""
        return {self.before.status, self.after.status} <= {"identified", "tied"}

    @property
    def percent(self) -> float | None:
        """The change in %, if it is known."""
        if not self.is_known or not self.before.value or self.after.value is None:
            return None
        return 100 * (self.after.value / self.before.value - 1)


def drifts(diagnosis: Diagnosis) -> list[Drift]:
    """Every parameter of the motor without effects, before and after these were added."""
    after = diagnosis.final.parameters
    return [Drift(name, estimate, after[name]) for name, estimate in diagnosis.base.parameters.items() if name in after]


def drift_words(one: Drift) -> str:
    """The change in per cent with its sign."""
    if one.percent is None:
        return percent(None)
    return ("+" if one.percent > 0 else "") + percent(one.percent)


def _drift_sentence(diagnosis: Diagnosis) -> str:
    far = [one for one in drifts(diagnosis) if abs(one.percent or 0.0) > MIN_DRIFT]
    far = sorted(far, key=lambda one: -abs(one.percent or 0.0))[:3]
    if not far:
        return f"No parameter determined by both fits changed by more than {MIN_DRIFT:g} %."
    drifted = enumerate_words([f"{one.name} by {drift_words(one)}" for one in far])
    return f"Adding it changed {drifted}."


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]
