"""Results as JSON: finite numbers in SI, and null for unknown values."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attrs import asdict

from ..files import write_text
from ..identify.identification import Estimate, Identification, RunFit, Search
from ..recordings.recording import Finding
from .diagnosis_sentences import verdict_sentences
from .identification_sentences import summary

if TYPE_CHECKING:
    from ..diagnose.diagnosis import Diagnosis, EffectFound, Gap, NextExperiment


def identification_json(identification: Identification) -> dict[str, Any]:
    """An identification as plain dictionaries, lists, finite numbers and None."""
    parameters = identification.parameters.items()
    return _plain(
        {
            "parameters": {name: _estimate(estimate) for name, estimate in parameters},
            "unidentified_directions": [
                {"parameters": list(one.parameters), "why": one.why, "mend": one.mend}
                for one in identification.unidentified_directions
            ],
            "fit": {run: _run_fit(fit) for run, fit in identification.fit.items()},
            "noise": dict(identification.noise),
            "converged": identification.converged,
            "seed": identification.seed,
            "seconds": dict(identification.seconds),
            "search": _search(identification.search),
            "covariance_of_logarithms": {
                "parameters": list(identification.covariance_names),
                "matrix": identification.covariance,
            },
            "findings": [_finding(finding) for finding in identification.findings],
            "messages": list(identification.messages),
            "summary": summary(identification),
        }
    )


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """A diagnosis as plain dictionaries: `identification_json` of the completed motor, and what was missing; the
    summary is that of the diagnosis."""
    before = diagnosis.base.parameters.items()
    gap = {role: _gap(diagnosis.gap.get(role)) for role in ("train", "holdout")}
    content = {
        "verdict": diagnosis.verdict,
        "effects": [_effect(effect, diagnosis.rivals) for effect in diagnosis.effects],
        "where": [asdict(region) for region in diagnosis.where],
        "gap": {**gap, "closed_fraction": diagnosis.closed_fraction},
        "gap_of_run": {run: _gap(one) for run, one in diagnosis.gap_of_run.items()},
        "next_experiment": _experiment(diagnosis.next_experiment),
        "varies": _varying(diagnosis),
        "curves": [asdict(curve) for curve in diagnosis.curves],
        "detectable": [asdict(one) for one in diagnosis.detectable],
        "p_nothing_missing": diagnosis.p_nothing,
        "electrical_misfit": diagnosis.electrical_misfit,
        "summary": verdict_sentences(diagnosis),
        "before": {"parameters": {name: _estimate(estimate) for name, estimate in before}},
    }
    return identification_json(diagnosis.final) | _plain(content)


def write_json(obj: Any, path: str | Path) -> None:
    """Write `obj` to a file atomically, or to standard output if the path is "-"; NaN and infinity become null."""
    to_stdout = str(path) == "-"  # its encoding is unknown, hence plain ASCII
    text = json.dumps(_plain(obj), indent=2, ensure_ascii=to_stdout, allow_nan=False) + "\n"
    if to_stdout:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_text(path, text)


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "stderr": estimate.stderr,
        "ci95": estimate.ci95,
        "unit": estimate.unit,
        "status": estimate.status,
    }


def _effect(effect: EffectFound, rivals: Sequence[Sequence[str]]) -> dict[str, Any]:
    return {
        "name": effect.name,
        "equation": effect.equation,
        "parameters": {name: _estimate(one) for name, one in effect.parameters.items()},
        "p_value": effect.p_value,
        "also_possible": [" + ".join(names) for names in rivals],
    }


def _varying(diagnosis: Diagnosis) -> dict[str, Any] | None:
    varies = diagnosis.varies
    if varies is None:
        return None
    return {
        "parameter": varies.name,
        "by_run": {run: _estimate(one) for run, one in varies.by_run.items()},
        "p_value": varies.p_value,
        "also_possible": list(varies.also_possible),
        "gap_of_run": {run: _gap(one) for run, one in diagnosis.gap_by_own_value.items()},
    }


def _gap(gap: Gap | None) -> dict[str, Any]:
    return {name: getattr(gap, name, None) for name in ("before", "after", "floor")}


def _experiment(experiment: NextExperiment | None) -> dict[str, Any] | None:
    """The next experiment without its waveform, which --experiment writes."""
    if experiment is None:
        return None
    return {name: getattr(experiment, name) for name in ("why", "description", "power")}


def _run_fit(fit: RunFit) -> dict[str, Any]:
    return {
        "role": fit.role,
        "current_rmse": fit.current_rmse,
        "speed_rmse": fit.speed_rmse,
        "current_fit_percent": fit.current_fit_percent,
        "speed_fit_percent": fit.speed_fit_percent,
        "load_offset": fit.load_offset,
        "initial_rise": fit.initial_rise,
        "samples": len(fit.time),
    }


def _search(search: Search) -> dict[str, Any]:
    return {
        "method": search.method,
        "evaluations": search.evaluations,
        "generations": len(search.best),
        "refined": search.refined,
        "times_found": search.times_found,
    }


def _finding(finding: Finding) -> dict[str, Any]:
    names = ("run", "column", "severity", "what", "where", "mend")
    return {name: getattr(finding, name) for name in names}


def _plain(value: Any) -> Any:
    """Tuples and arrays as lists, NumPy and JAX scalars as Python scalars, NaN and infinity as None.

    A confidence interval with an unknown end becomes None as a whole.
    """
    if isinstance(value, dict):
        return {
            str(key): None if key == "ci95" and _has_unknown_end(item) else _plain(item) for key, item in value.items()
        }
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if isfinite(value) else None
    return str(value)


def _has_unknown_end(interval: Any) -> bool:
    return interval is not None and not all(isfinite(float(end)) for end in interval)
