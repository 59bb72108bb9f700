"""Results as JSON: finite numbers in SI, and null for unknown values."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attrs import asdict, filters, has

from ..files import write_text
from ..identify.identification import Identification, RunFit, Search
from .diagnosis_sentences import verdict_sentences
from .identification_sentences import summary

if TYPE_CHECKING:
    from ..diagnose.diagnosis import Diagnosis, NextExperiment

UNKNOWN_GAP = dict.fromkeys(("before", "after", "floor"))


def identification_json(identification: Identification) -> dict[str, Any]:
    """An identification as plain dictionaries, lists, finite numbers and None."""
    return plain(
        {
            "parameters": identification.parameters,
            "unidentified_directions": identification.unidentified_directions,
            "fit": {run: _run_fit(fit) for run, fit in identification.fit.items()},
            "noise": identification.noise,
            "converged": identification.converged,
            "seed": identification.seed,
            "seconds": identification.seconds,
            "search": _search(identification.search),
            "covariance_of_logarithms": {
                "parameters": identification.covariance_names,
                "matrix": identification.covariance,
            },
            "findings": [asdict(one, filter=filters.exclude("modelled_by")) for one in identification.findings],
            "messages": identification.messages,
            "summary": summary(identification),
        }
    )


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


def write_json(content: dict[str, Any], path: str | Path) -> None:
    """Write `plain` content to a file atomically, or to standard output if the path is "-"."""
    to_stdout = str(path) == "-"  # its encoding is unknown, hence plain ASCII
    text = json.dumps(content, indent=2, ensure_ascii=to_stdout, allow_nan=False) + "\n"
    if to_stdout:
        sys.stdout.write(text)
        sys.stdout.flush()
    else:
        write_text(path, text)


def plain(value: Any) -> Any:
    """Records as dictionaries of their fields, tuples and arrays as lists, NumPy and JAX scalars as Python scalars, NaN
    and infinity as None.

    A confidence interval with an unknown end becomes None as a whole.
    """
    if has(type(value)):
        value = asdict(value, recurse=False)
    if isinstance(value, Mapping):
        return {
            str(key): None if key == "ci95" and _has_unknown_end(item) else plain(item) for key, item in value.items()
        }
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if isfinite(value) else None
    return str(value)


def _has_unknown_end(interval: Any) -> bool:
    return interval is not None and not all(isfinite(float(end)) for end in interval)


def _run_fit(fit: RunFit) -> dict[str, Any]:
    """How well a run is reproduced, without its signals."""
    signals = ("time", "voltage", "current", "current_simulated", "speed", "speed_simulated", "load")
    return asdict(fit, filter=filters.exclude(*signals)) | {"samples": len(fit.time)}


def _search(search: Search) -> dict[str, Any]:
    return {
        "method": search.method,
        "evaluations": search.evaluations,
        "generations": len(search.best),
        "refined": search.refined,
        "times_found": search.times_found,
    }


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
