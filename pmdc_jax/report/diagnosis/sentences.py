"""A diagnosis in plain English: where simulation and recordings disagree, what is missing, what adding it did."""

from __future__ import annotations

from ...diagnose.diagnosis import Detectable, Diagnosis, EffectFound, effects_worsen_holdouts, holdouts_show_more
from ...diagnose.hypotheses.effect_relations import CONTAINS, unbalanced_equation
from ...identify.identification import Role
from ...words import enumerate_words
from ..identification.sentences import as_sentence, cautions
from ..notation import (
    effect_words,
    estimate_words,
    field_words,
    p_value_words,
    percent,
    role_word,
    significant,
    value_with_unit,
)
from .drift import drift_sentence
from .places import disagreement
from .remainder import (
    curve_sentence,
    held_out_sentence,
    rest_sentence,
    run_apart_sentence,
    slow_rest_sentence,
    varying_sentence,
)

VERDICTS = {
    "named": "named",
    "ambiguous": "ambiguous",
    "none_detected": "none detected",
    "not_in_library": "not in the library",
}
# the three effects that drives most often have, for a sentence; the table of the report has all
COMMON_EFFECTS = ("coulomb_friction", "constant_load", "brush_voltage_drop")


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
        sentences += [_gap_sentence(diagnosis), drift_sentence(diagnosis)]
    if diagnosis.verdict != "not_in_library":
        sentences += [rest_sentence(diagnosis), slow_rest_sentence(diagnosis), held_out_sentence(diagnosis)]
    sentences.append(run_apart_sentence(diagnosis))
    return [sentence for sentence in sentences if sentence] + cautions(diagnosis.final)


def _none_detected(diagnosis: Diagnosis) -> list[str]:
    found = "No missing effect of the motor was detected."
    if diagnosis.leaves_noise:
        found = (
            "No missing effect was detected: simulation and measurement differ by no more than the noise"
            f" explains ({p_value_words(diagnosis.p_nothing)})."
        )
    return [found, _detectable_sentence("", diagnosis)]


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
        sentences.append(varying_sentence(diagnosis, diagnosis.varies))
    elif diagnosis.curves:
        sentences.append(curve_sentence(diagnosis))
    # a misread current or speed leaves the electrical equation unbalanced, too
    misread = any(curve.equation == "sensor" for curve in diagnosis.curves[:1])
    if diagnosis.breaks_electrical_equation and not (misread or diagnosis.varies):
        sentences.append(
            "From sample to sample the current deviates from the prediction by voltage and speed by"
            f" {significant(diagnosis.electrical_misfit)} times what the sensor noise explains, which no torque"
            " can cause: what is missing acts on voltage or current, such as a sagging supply where the recorded"
            " voltage is duty cycle times nominal voltage; or the recorded current was filtered or averaged."
        )
    sentences.append(held_out_sentence(diagnosis))
    if effects_worsen_holdouts(diagnosis.gap):
        sentences.append(
            "The addition increases the error of the held-out runs: something else is missing that looks alike in the"
            " training runs. Include one of the held-out runs in the fit."
        )
    return [*sentences, "The parameters compensate for what is missing: the intervals do not cover this error."]


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
        f"{field_words(effect.name, field)} {estimate_words(estimate)}" for field, estimate in effect.parameters.items()
    ]
    name, chance = effect_words(effect.name), p_value_words(effect.p_value)
    if len(values) == 1:
        (only,) = effect.parameters.values()
        return f"{name} of {estimate_words(only)} ({chance})"
    return f"{name} ({', '.join(values)}; {chance})"


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


def _detectable_sentence(begin: str, diagnosis: Diagnosis) -> str:
    told = [one for one in detectable_others(diagnosis) if one.effect in COMMON_EFFECTS]
    parts = [f"{effect_words(x.effect)} above {value_with_unit(x.amplitude, x.unit)}" for x in told]
    if not parts:
        return ""
    return _capitalised(f"{begin}{enumerate_words(parts)} would have been detected with 90 % probability.")


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


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]
