"""Tables of a diagnosis: their rows, for the terminal and for the page, and the terminal's tables."""

from __future__ import annotations

from attrs import frozen
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ...diagnose.diagnosis import Diagnosis
from ...effects import EFFECTS
from ..identification.tables import parameter_table, runs_in_order, status_text
from ..notation import (
    EstimateText,
    field_words,
    formula_text,
    p_value_words,
    role_word,
    significant,
    value_with_unit,
    write_estimate,
)
from ..terminal import plain_table
from .drift import drift_words, drifts
from .sentences import detectable_others, verdict_sentences


@frozen
class EffectRow:
    """A parameter of an effect that was found; what is said of the effect stands in the row of its first parameter."""

    parameter: str
    written: EstimateText
    effect: str = ""
    equation: str = ""
    formula: str = ""
    chance: str = ""


@frozen
class DriftRow:
    """A parameter of the motor before and after the effects were added."""

    name: str
    before: EstimateText
    after: EstimateText
    change: str
    status: Text


def effect_rows(diagnosis: Diagnosis) -> list[EffectRow]:
    """A row for each parameter of each effect that was found."""
    rows = []
    for effect in diagnosis.effects:
        about = {
            "effect": EFFECTS[effect.name].label,
            "equation": effect.equation,
            "formula": formula_text(effect.name, effect.parameters),
            "chance": p_value_words(effect.p_value),
        }
        for field, estimate in effect.parameters.items():
            rows.append(EffectRow(field_words(effect.name, field), write_estimate(estimate), **about))
            about = {}
    return rows


def drift_rows(diagnosis: Diagnosis) -> list[DriftRow]:
    """A row for each parameter of the motor without effects; none if no effect was added."""
    if not diagnosis.effects:
        return []
    return [
        DriftRow(
            one.name, write_estimate(one.before), write_estimate(one.after), drift_words(one), status_text(one.after)
        )
        for one in drifts(diagnosis)
    ]


def gap_rows(diagnosis: Diagnosis) -> list[tuple[str, ...]]:
    """Name and role of every run, its error before and after the effects were added, and its noise floor."""
    rows = []
    for run, fit in runs_in_order(diagnosis.final):
        gap = diagnosis.gap_of_run[run]
        errors = (significant(error) for error in (gap.before, gap.after, gap.floor))
        rows.append((run, role_word(fit.role), *errors))
    return rows


def detectable_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Effect, parameter and smallest detectable amplitude of every effect that was not found."""
    return [
        (EFFECTS[one.effect].label, field_words(one.effect, one.parameter), value_with_unit(one.amplitude, one.unit, 2))
        for one in detectable_others(diagnosis)
    ]


def diagnosis_tables(diagnosis: Diagnosis) -> RenderableType:
    """Tables of effects, parameters, gaps and detectable amplitudes, as far as they apply, and the verdict in words."""
    tables = [_effects(diagnosis)] if diagnosis.effects else []
    tables += [_parameters(diagnosis), _gaps(diagnosis)]
    if diagnosis.verdict == "none_detected" and diagnosis.detectable:
        tables.append(_detectable(diagnosis))
    apart = [part for table in tables for part in (table, "")]
    return Group(*apart, *(Text(sentence) for sentence in verdict_sentences(diagnosis)))


def _effects(diagnosis: Diagnosis) -> Table:
    headings = ("Effect", "Parameter", "Value", "Unit", "Std. error", "95 % interval", "p")
    rows = [
        (row.effect, row.parameter, *_numbers(row.written), row.written.interval, _without_p(row.chance))
        for row in effect_rows(diagnosis)
    ]
    return plain_table("Missing effects", headings, rows, left=(0, 1, 3), first_wraps="ellipsis")


def _without_p(chance: str) -> str:
    """ "< 0.001" or "0.21", under a heading that says what it is."""
    return chance.removeprefix("p ").removeprefix("= ")


def _parameters(diagnosis: Diagnosis) -> Table:
    if not diagnosis.effects:
        return parameter_table(diagnosis.final)
    headings = ("Parameter", "Before", "", "After", "", "Std. error", "Change", "Status")
    rows = [
        (row.name, row.before.value, row.before.unit, *_numbers(row.after), row.change, row.status)
        for row in drift_rows(diagnosis)
    ]
    return plain_table("Parameters", headings, rows, left=(0, 2, 4, 7), first_wraps="ellipsis")


def _numbers(written: EstimateText) -> tuple[str, str, str]:
    return written.value, written.unit, written.stderr


def _gaps(diagnosis: Diagnosis) -> Table:
    headings, title = ("Run", "Role", "Before", "After", "Noise"), "Free-run error relative to the noise"
    return plain_table(title, headings, gap_rows(diagnosis), left=(0, 1), first_wraps="ellipsis")


def _detectable(diagnosis: Diagnosis) -> Table:
    headings, title = ("Effect", "Parameter", "From"), "Detectable with 90 % probability"
    return plain_table(title, headings, detectable_rows(diagnosis), left=(0, 1), first_wraps="ellipsis")
