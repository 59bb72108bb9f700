"""The report of a diagnosis: one HTML page, the identified motor at its end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..diagnose.diagnosis import Diagnosis, EffectFound, Gap, LearnedCurve, NextExperiment, Region
from ..effects import EFFECTS
from .diagnosis_figures import (
    AXES,
    against_figure,
    curve_figure,
    experiment_figure,
    gap_figure,
    residual_figure,
    where_figure,
)
from .figures import points_per_trace
from .identification import identification_content
from .notation import (
    amount,
    chance,
    enumerate_words,
    field_words,
    fixed,
    parameter_words,
    percent,
    significant,
    words_of,
    write_estimate,
)
from .page import figure_json, write_page
from .summary import role_word, runs_in_order
from .verdict import (
    VERDICTS,
    drifts,
    moved,
    role_that_counts,
    stretch,
    verdict_sentences,
    would_be_seen,
)

# traces that a run has in the picture of its residuals, and in that of its simulation
OF_RESIDUALS, OF_SIMULATION = 4, 7


def write_diagnosis(diagnosis: Diagnosis, path: str | Path) -> None:
    """Write the report of a diagnosis to one self-contained HTML file."""
    write_page(
        path,
        "diagnosis.html.jinja",
        verdict=diagnosis.verdict,
        summary=verdict_sentences(diagnosis),
        tiles=_tiles(diagnosis),
        effects=[_effect(effect) for effect in diagnosis.effects],
        rivals=_rivals(diagnosis),
        experiment=_experiment(diagnosis.next_experiment),
        where=[_region(region) for region in diagnosis.where],
        where_figure=_where_figure(diagnosis),
        gaps=_gaps(diagnosis),
        gap_figure=figure_json(gap_figure(_gap_by_run(diagnosis))),
        residuals=_residuals(diagnosis),
        against=_against(diagnosis),
        curves=[_curve(curve) for curve in diagnosis.curves],
        drifts=_drifts(diagnosis),
        detectable=_detectable(diagnosis),
        **identification_content(diagnosis.final, OF_RESIDUALS * len(diagnosis.final.fit)),
    )


def _tiles(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Label, number and small print of the figures worth knowing first."""
    role = role_that_counts(diagnosis)
    gap = diagnosis.gap[role]
    error = significant(gap.before)
    if diagnosis.effects:
        error += f" → {significant(gap.after)}"
    tiles = [
        ("Verdict", VERDICTS[diagnosis.verdict], f"nothing missing: {chance(diagnosis.p_nothing)}")
    ]
    tiles.append((f"{role_word(role).capitalize()} error", error, "times the noise"))
    if diagnosis.effects and diagnosis.closed_fraction is not None:
        tiles.append(("Gap closed", percent(100 * diagnosis.closed_fraction), ""))
    tiles.append(("Effects added", str(len(diagnosis.effects)), ""))
    return tiles


def _effect(effect: EffectFound) -> dict[str, Any]:
    parameters = [
        (field_words(effect.name, field), write_estimate(estimate))
        for field, estimate in effect.parameters.items()
    ]
    kind = EFFECTS[effect.name]
    return {
        "label": kind.label,
        "formula": kind.formula,
        "equation": effect.equation,
        "parameters": parameters,
        "chance": chance(effect.p_value),
    }


def _rivals(diagnosis: Diagnosis) -> list[str]:
    """The other sets that would do as well, in words."""
    rivals = dict.fromkeys(r for effect in diagnosis.effects for r in effect.also_possible)
    return [enumerate_words([words_of(name) for name in one.split(" + ")]) for one in rivals]


def _experiment(experiment: NextExperiment | None) -> dict[str, Any] | None:
    if experiment is None:
        return None
    return {
        "why": experiment.why,
        "description": experiment.description,
        "power": percent(100 * experiment.power),
        "figure": figure_json(experiment_figure(experiment, 4000)),
    }


def _where_figure(diagnosis: Diagnosis) -> str | None:
    if not diagnosis.where:
        return None
    return figure_json(where_figure(diagnosis.where, diagnosis.base.fit))


def _region(region: Region) -> dict[str, str]:
    return {
        "equation": region.equation,
        "variable": region.variable,
        "where": stretch(region.variable, [region.region]),
        "z": fixed(region.z, 1),
    }


def _gap_by_run(diagnosis: Diagnosis) -> dict[str, Gap]:
    return {run: diagnosis.gap_of_run[run] for run, _ in runs_in_order(diagnosis.final)}


def _gaps(diagnosis: Diagnosis) -> list[dict[str, str]]:
    fits = diagnosis.final.fit
    return [
        {
            "run": run,
            "role": role_word(fits[run].role),
            "before": significant(gap.before),
            "after": significant(gap.after),
            "floor": significant(gap.floor),
        }
        for run, gap in _gap_by_run(diagnosis).items()
    ]


def _residuals(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """A picture for every run whose residual the effects changed."""
    if not diagnosis.effects:
        return []
    runs = runs_in_order(diagnosis.final)
    points = points_per_trace((OF_RESIDUALS + OF_SIMULATION) * len(runs))
    figures = {
        name: residual_figure(diagnosis.base.fit[name], fit, diagnosis.final.noise, points)
        for name, fit in runs
    }
    return [{"run": name, "figure": figure_json(one)} for name, one in figures.items() if one]


def _against(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """The residual over the variable in which the plain motor was most clearly off."""
    equation, variable = _gave_away(diagnosis)
    wanted = "current" if equation == "electrical" else "speed"
    for channel in (wanted, "speed", "current"):
        fits = diagnosis.base.fit, diagnosis.final.fit
        figure = against_figure(*fits, variable, channel)
        if figure:
            return {
                "variable": variable,
                "channel": channel,
                "figure": figure_json(figure),
            }
    return None


def _gave_away(diagnosis: Diagnosis) -> tuple[str, str]:
    """The equation and the variable of the clearest misfit."""
    if diagnosis.where:
        return diagnosis.where[0].equation, diagnosis.where[0].variable
    electrical = any(effect.equation == "electrical" for effect in diagnosis.effects)
    return ("electrical", "current") if electrical else ("mechanical", "speed")


def _curve(curve: LearnedCurve) -> dict[str, Any]:
    return {
        "title": f"{'friction' if curve.reverses else curve.equation + ' equation'} over"
        f" {AXES.get(curve.variable, curve.variable)}",
        "chance": chance(curve.p_value),
        "figure": figure_json(curve_figure(curve)),
    }


def _drifts(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    return [
        {
            "name": one.name,
            "before": write_estimate(one.before),
            "after": write_estimate(one.after),
            "moved": moved(one),
        }
        for one in (drifts(diagnosis) if diagnosis.effects else ())
    ]


def _detectable(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    return [
        (parameter_words(one.effect, one.parameter), amount(one.amplitude, one.unit, 2))
        for one in would_be_seen(diagnosis)
    ]
