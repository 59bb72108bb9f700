"""Terminal tables of a diagnosis."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ..diagnose.diagnosis import Diagnosis
from ..effects import EFFECTS
from .diagnosis_sentences import detectable_others, drift_words, drifts, verdict_sentences
from .identification_sentences import role_word, runs_in_order
from .notation import field_words, p_value_words, significant, value_with_unit, write_estimate
from .terminal import parameter_table, plain_table, status_text


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
    rows = []
    for effect in diagnosis.effects:
        for number, (field, estimate) in enumerate(effect.parameters.items()):
            first = number == 0
            written = write_estimate(estimate)
            name = EFFECTS[effect.name].label if first else ""
            numbers = (written.value, written.unit, written.stderr, written.interval)
            probability = p_value_words(effect.p_value).removeprefix("p ").removeprefix("= ")
            end = probability if first else ""
            rows.append((name, field_words(effect.name, field), *numbers, end))
    return plain_table("Missing effects", headings, rows, left=(0, 1, 3), first_wraps="ellipsis")


def _parameters(diagnosis: Diagnosis) -> Table:
    if not diagnosis.effects:
        return parameter_table(diagnosis.final)
    headings = ("Parameter", "Before", "", "After", "", "Std. error", "Change", "Status")
    rows = []
    for one in drifts(diagnosis):
        before, after = write_estimate(one.before), write_estimate(one.after)
        numbers = (before.value, before.unit, after.value, after.unit, after.stderr)
        rows.append((one.name, *numbers, drift_words(one), status_text(one.after)))
    return plain_table("Parameters", headings, rows, left=(0, 2, 4, 7), first_wraps="ellipsis")


def _gaps(diagnosis: Diagnosis) -> Table:
    headings = ("Run", "Role", "Before", "After", "Noise")
    rows = []
    for run, fit in runs_in_order(diagnosis.final):
        gap = diagnosis.gap_of_run[run]
        numbers = (significant(error) for error in (gap.before, gap.after, gap.floor))
        rows.append((run, role_word(fit.role), *numbers))
    return plain_table("Free-run error relative to the noise", headings, rows, left=(0, 1), first_wraps="ellipsis")


def _detectable(diagnosis: Diagnosis) -> Table:
    rows = []
    for one in detectable_others(diagnosis):
        names = (EFFECTS[one.effect].label, field_words(one.effect, one.parameter))
        rows.append((*names, value_with_unit(one.amplitude, one.unit, 2)))
    headings = ("Effect", "Parameter", "From")
    return plain_table("Detectable with 90 % probability", headings, rows, left=(0, 1), first_wraps="ellipsis")
