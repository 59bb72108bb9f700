"""The methods under test: each takes a case's recordings and answers as `pmdc diagnose --json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.virtual_bench import Columns

from .sparse import sparse
from .stepwise import stepwise

Answer = dict[str, Any]
Runs = Mapping[str, Columns]


def ours(runs: Runs, holdout: Runs) -> Answer:
    """`pmdc_jax.diagnose`."""
    import pmdc_jax
    from pmdc_jax.report.json import diagnosis_json

    result = pmdc_jax.diagnose(_recordings(runs), holdout=_recordings(holdout))
    return diagnosis_json(result)


def _recordings(runs: Runs):
    from pmdc_jax import Recording

    names = ("time_s", "voltage_V", "current_A", "speed_rad_s")
    return [
        Recording(name, *(c[n] for n in names), load=c.get("load_torque_Nm"))
        for name, c in runs.items()
    ]


METHODS: Mapping[str, Callable[[Runs, Runs], Answer]] = {
    "pmdc": ours,
    "stepwise": stepwise,
    "sparse": sparse,
}
