"""An identification as JSON."""

from __future__ import annotations

from typing import Any

from attrs import asdict, filters

from ...identify.identification import Identification, RunFit, Search
from ...motor_file import COVARIANCE_OF
from ..json import plain
from .sentences import summary


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
            "covariance": {
                "of": COVARIANCE_OF,
                "names": identification.covariance_names,
                "matrix": identification.covariance,
            },
            "findings": [asdict(one, filter=filters.exclude("modelled_by")) for one in identification.findings],
            "messages": identification.messages,
            "summary": summary(identification),
        }
    )


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
