"""The methods under test: each takes a case's recordings and answers as `pmdc diagnose --json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.naming.sparse import sparse
from benchmarks.naming.stepwise import stepwise
from benchmarks.virtual_bench import Columns

Answer = dict[str, Any]
Runs = Mapping[str, Columns]


def ours(runs: Runs, holdout: Runs) -> Answer:
    """`pmdc_jax.diagnose`."""
    import pmdc_jax
    from pmdc_jax.report.diagnosis.json import diagnosis_json

    result = pmdc_jax.diagnose(_recordings(runs), holdout=_recordings(holdout))
    return diagnosis_json(result)


def _recordings(runs: Runs):
    from pmdc_jax import Recording

    names = ("time_s", "voltage_V", "current_A", "speed_rad_s", "load_torque_Nm", "angle_rad")
    return [Recording(run, *map(columns.get, names)) for run, columns in runs.items()]


def _with_speed(method: Callable[[Runs, Runs], Answer]) -> Callable[[Runs, Runs], Answer]:
    """A method that does not use the angle, given differences of it if no speed was measured."""

    def speed(columns: Columns) -> Columns:
        if "speed_rad_s" in columns:
            return columns
        return columns | {"speed_rad_s": np.gradient(columns["angle_rad"], columns["time_s"])}

    def answer(runs: Runs, holdout: Runs) -> Answer:
        given = ({run: speed(columns) for run, columns in some.items()} for some in (runs, holdout))
        return method(*given)

    return answer


METHODS: Mapping[str, Callable[[Runs, Runs], Answer]] = {
    "pmdc": ours,
    "stepwise": _with_speed(stepwise),
    "sparse": _with_speed(sparse),
}
