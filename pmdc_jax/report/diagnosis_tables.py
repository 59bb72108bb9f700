"""The tables of a diagnosis for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from ..diagnose.diagnosis import Diagnosis
from .notation import amount, chance, field_words, significant, words_of, write_estimate
from .summary import runs_in_order, status_word
from .terminal import STATUS_STYLES, console_for, parameter_table, plain_table
from .verdict import drifts, moved, verdict_sentences, would_be_seen


def print_diagnosis(diagnosis: Diagnosis) -> None:
    """Effects, what adding them did, and the verdict on standard output."""
    console_for(stderr=False).print(diagnosis_tables(diagnosis))


def diagnosis_tables(diagnosis: Diagnosis) -> RenderableType:
    """Tables of what there is to tell, and under them the verdict in words."""
    tables = [_effects(diagnosis)] if diagnosis.effects else []
    tables += [_parameters(diagnosis), _gaps(diagnosis)]
    if diagnosis.verdict == "none_detected" and diagnosis.detectable:
        tables.append(_detectable(diagnosis))
    apart = [part for table in tables for part in (table, "")]
    return Group(*apart, *(Text(sentence) for sentence in verdict_sentences(diagnosis)))


def _effects(diagnosis: Diagnosis) -> Table:
    headers = ("Effect", "Parameter", "Value", "Unit", "Std. error", "95 % interval", "p")
    rows = []
    for effect in diagnosis.effects:
        for number, (field, estimate) in enumerate(effect.parameters.items()):
            first = number == 0
            written = write_estimate(estimate)
            name = words_of(effect.name) if first else ""
            numbers = (written.value, written.unit, written.stderr, written.interval)
            probability = chance(effect.p_value).removeprefix("p ").removeprefix("= ")
            end = probability if first else ""
            rows.append((name, field_words(effect.name, field), *numbers, end))
    return _filled("Missing", headers, (0, 1, 3), rows)


def _parameters(diagnosis: Diagnosis) -> Table:
    if not diagnosis.effects:
        return parameter_table(diagnosis.final)
    headers = ("Parameter", "Before", "", "After", "", "Std. error", "Moved", "Status")
    rows = []
    for one in drifts(diagnosis):
        before, after = write_estimate(one.before), write_estimate(one.after)
        status = Text(status_word(one.after.status), STATUS_STYLES.get(one.after.status, ""))
        numbers = (before.value, before.unit, after.value, after.unit, after.stderr)
        rows.append((one.name, *numbers, moved(one), status))
    return _filled("Parameters", headers, (0, 2, 4, 7), rows)


def _gaps(diagnosis: Diagnosis) -> Table:
    headers = ("Run", "Role", "Before", "After", "Noise")
    rows = []
    for run, fit in runs_in_order(diagnosis.final):
        gap = diagnosis.gap_of_run[run]
        role = "hold-out" if fit.role == "holdout" else "training"
        rows.append((run, role, *(significant(x) for x in (gap.before, gap.after, gap.floor))))
    return _filled("Free-run error over the noise", headers, (0, 1), rows)


def _detectable(diagnosis: Diagnosis) -> Table:
    rows = []
    for one in would_be_seen(diagnosis):
        names = (words_of(one.effect), field_words(one.effect, one.parameter))
        rows.append((*names, amount(one.amplitude, one.unit, 2)))
    headers = ("Effect", "Parameter", "From")
    return _filled("Would have been seen nine times of ten", headers, (0, 1), rows)


def _filled(
    title: str,
    headers: Sequence[str],
    left: Sequence[int],
    rows: Iterable[Sequence[str | Text]],
) -> Table:
    """A table whose columns stand right but for those in `left`."""
    table = plain_table(title)
    for number, header in enumerate(headers):
        table.add_column(header, justify="left" if number in left else "right", no_wrap=number > 0)
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table
