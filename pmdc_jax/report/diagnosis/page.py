"""The HTML page of a diagnosis, the identified motor at its end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from ...diagnose.diagnosis import Diagnosis, Gap, LearnedCurve, NextExperiment, Region
from ...identify.identification import RunFit
from ...words import enumerate_words
from ..figures import points_per_trace
from ..identification.page import identification_content
from ..identification.tables import runs_in_order
from ..notation import effect_words, fixed, p_value_words, percent, role_word, significant, write_estimate
from ..page import figure_json, write_page
from .figures import (
    AXIS_TITLES,
    curve_figure,
    experiment_figure,
    gap_figure,
    residual_figure,
    residual_over_variable_figure,
    where_figure,
)
from .places import intervals_in_words
from .sentences import VERDICTS, judged_role, verdict_sentences
from .tables import detectable_rows, drift_rows, effect_rows, gap_rows

# traces of one run in the figure of its residuals, and in that of its simulation: they share the points drawn
TRACES_OF_RESIDUALS = 4
TRACES_OF_SIMULATION = 7


def write_diagnosis_report(diagnosis: Diagnosis, path: str | Path) -> None:
    """Write the report of a diagnosis to one self-contained HTML file."""
    write_page(
        path,
        "diagnosis.html.jinja",
        verdict=diagnosis.verdict,
        summary=verdict_sentences(diagnosis),
        tiles=_tiles(diagnosis),
        effects=effect_rows(diagnosis),
        rivals=[enumerate_words([effect_words(e) for e in one]) for one in diagnosis.rivals],
        experiment=_experiment(diagnosis.next_experiment),
        where=[_region(region) for region in diagnosis.where],
        where_figure=_where_figure(diagnosis),
        gaps=gap_rows(diagnosis),
        gap_figure=figure_json(_gap_figure(diagnosis)),
        residuals=_residuals(diagnosis),
        against=_residual_over_variable(diagnosis),
        varies=_varies(diagnosis),
        curves=[_curve(curve) for curve in diagnosis.curves],
        drifts=drift_rows(diagnosis),
        detectable=detectable_rows(diagnosis),
        **identification_content(diagnosis.final, TRACES_OF_RESIDUALS * len(diagnosis.final.fit)),
    )


def _tiles(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Label, value and small print of the key figures at the top of the report."""
    role = judged_role(diagnosis)
    gap = diagnosis.gap[role]
    error = significant(gap.before)
    if diagnosis.effects:
        error += f" → {significant(gap.after)}"
    chance = f"{p_value_words(diagnosis.p_nothing)} if nothing were missing"
    if diagnosis.varies and not diagnosis.effects:
        varies = diagnosis.varies
        chance = f"{p_value_words(varies.p_value)} if {varies.name} were the same in all runs"
    tiles = [("Verdict", VERDICTS[diagnosis.verdict], chance)]
    tiles.append((f"{role_word(role).capitalize()} error", error, "times the noise"))
    if diagnosis.effects and diagnosis.closed_fraction is not None:
        tiles.append(("Gap closed", percent(100 * diagnosis.closed_fraction), ""))
    tiles.append(("Effects added", str(len(diagnosis.effects)), ""))
    return tiles


def _experiment(experiment: NextExperiment | None) -> dict[str, Any] | None:
    if experiment is None:
        return None
    return {
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
        "where": intervals_in_words(region.variable, [region.region]).removeprefix(f"at a {region.variable} "),
        "z": fixed(region.z, 1),
    }


def _compared(diagnosis: Diagnosis) -> dict[str, Mapping[str, RunFit]]:
    """The fits of one or two models, by name: without and with the effects, or with a common value of what differs from
    run to run and with its own."""
    if diagnosis.effects:
        return {"before": diagnosis.base.fit, "after": diagnosis.final.fit}
    if diagnosis.varies:
        name = diagnosis.varies.name
        return {f"common {name}": diagnosis.final.fit, f"{name} by run": diagnosis.varies.fit}
    return {"error": diagnosis.final.fit}


def _gap_figure(diagnosis: Diagnosis) -> go.Figure:
    gaps = _gap_by_run(diagnosis)
    before, after = ({run: getattr(g, at) for run, g in gaps.items()} for at in ("before", "after"))
    errors = [before, after] if diagnosis.effects else [after]
    if diagnosis.varies and not diagnosis.effects:
        errors.append({run: g.after for run, g in diagnosis.gap_by_own_value.items()})
    floors = {run: gap.floor for run, gap in gaps.items()}
    return gap_figure(dict(zip(_compared(diagnosis), errors, strict=True)), floors)


def _gap_by_run(diagnosis: Diagnosis) -> dict[str, Gap]:
    return {run: diagnosis.gap_of_run[run] for run, _ in runs_in_order(diagnosis.final)}


def _residuals(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """A figure for each run of its residuals by two models; none if there is only one."""
    models = _compared(diagnosis)
    if len(models) < 2:
        return []
    runs = [name for name, _ in runs_in_order(diagnosis.final)]
    points = points_per_trace((TRACES_OF_RESIDUALS + TRACES_OF_SIMULATION) * len(runs))
    figures = {
        run: residual_figure({name: fits[run] for name, fits in models.items()}, diagnosis.final.noise, points)
        for run in runs
        if all(run in fits for fits in models.values())
    }
    return [{"run": name, "figure": figure_json(one)} for name, one in figures.items() if one]


def _residual_over_variable(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """The residual over the variable in which the motor without effects disagreed most clearly."""
    equation, variable = _clearest_misfit(diagnosis)
    wanted = "current" if equation == "electrical" else "speed"
    for channel in (wanted, "speed", "current"):
        figure = residual_over_variable_figure(_compared(diagnosis), variable, channel)
        if figure:
            return {"variable": variable, "channel": channel, "figure": figure_json(figure)}
    return None


def _clearest_misfit(diagnosis: Diagnosis) -> tuple[str, str]:
    """The equation and the variable of the clearest misfit."""
    if diagnosis.where:
        return diagnosis.where[0].equation, diagnosis.where[0].variable
    electrical = any(effect.equation == "electrical" for effect in diagnosis.effects)
    return ("electrical", "current") if electrical else ("mechanical", "speed")


def _curve(curve: LearnedCurve) -> dict[str, Any]:
    reading = "current reading" if curve.unit == "A" else "speed reading"
    where = reading if curve.equation == "sensor" else f"{curve.equation} equation"
    return {
        "title": f"{'friction' if curve.reverses else where} over {AXIS_TITLES.get(curve.variable, curve.variable)}",
        "chance": p_value_words(curve.p_value),
        "figure": figure_json(curve_figure(curve)),
    }


def _varies(diagnosis: Diagnosis) -> dict[str, Any] | None:
    varies = diagnosis.varies
    if varies is None:
        return None
    estimates = {run: write_estimate(estimate) for run, estimate in varies.by_run.items()}
    return {
        "name": varies.name,
        "chance": p_value_words(varies.p_value),
        "runs": [
            (run, estimates.get(run), significant(gap.before), significant(gap.after))
            for run, gap in diagnosis.gap_by_own_value.items()
        ],
    }
