"""A diagnosis as JSON."""

from __future__ import annotations

from typing import Any

from attrs import asdict, filters

from ...diagnose.diagnosis import Diagnosis, NextExperiment
from ..identification.json import identification_json
from ..json import plain
from .sentences import verdict_sentences

UNKNOWN_GAP = dict.fromkeys(("before", "after", "floor"))


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """A diagnosis as plain dictionaries: `identification_json` of the completed motor, and what was missing; the
    summary is that of the diagnosis."""
    gap = {role: diagnosis.gap.get(role, UNKNOWN_GAP) for role in ("train", "holdout")}
    rivals = [" + ".join(names) for names in diagnosis.rivals]
    content = {
        "verdict": diagnosis.verdict,
        "effects": [asdict(effect) | {"also_possible": rivals} for effect in diagnosis.effects],
        "where": diagnosis.where,
        "gap": {**gap, "closed_fraction": diagnosis.closed_fraction},
        "gap_of_run": diagnosis.gap_of_run,
        "next_experiment": _experiment(diagnosis.next_experiment),
        "varies": _varying(diagnosis),
        "curves": diagnosis.curves,
        "detectable": diagnosis.detectable,
        "p_nothing_missing": diagnosis.p_nothing,
        "electrical_misfit": diagnosis.electrical_misfit,
        "summary": verdict_sentences(diagnosis),
        "before": {"parameters": diagnosis.base.parameters},
    }
    return identification_json(diagnosis.final) | plain(content)


def _experiment(experiment: NextExperiment | None) -> dict[str, Any] | None:
    """The next experiment without its waveform, which --experiment writes."""
    if experiment is None:
        return None
    return asdict(experiment, filter=filters.exclude("time", "voltage"))


def _varying(diagnosis: Diagnosis) -> dict[str, Any] | None:
    varies = diagnosis.varies
    if varies is None:
        return None
    return {
        "parameter": varies.name,
        "by_run": varies.by_run,
        "p_value": varies.p_value,
        "also_possible": varies.also_possible,
        "gap_of_run": diagnosis.gap_by_own_value,
    }
