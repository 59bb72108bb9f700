"""Single readings far from a fit and from the readings beside them, such as those of garbled telegrams, are treated as
missing.

The check of the recordings finds only spikes that stand out from the signal itself: beside a fit much smaller ones do,
and they need not be as large as what the motor does.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import attrs
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...recordings.recording import SIMULATED_OUTPUTS
from ...recordings.resolution import quantum
from ..fit.fitted_runs import FittedRuns

# Least residual of an outlier over the noise of its run, and largest one of the readings beside it
MIN_OUTLIER, MAX_BESIDE = 8.0, 4.0
# Least residual of an outlier over what a reading a sample sooner or later would change
MIN_OVER_CHANGE = 1.5
# If more than this share of all readings look like outliers, they are no errors of single readings
MAX_SHARE = 0.01
# The noise is this quantile of the magnitudes, over the same of a normal distribution
QUANTILE, NORMAL_QUANTILE = 0.95, 1.96


class _Found(NamedTuple):
    """The outliers of one output of a run."""

    run: int
    output: int
    lost: Bool[np.ndarray, " samples"]
    largest: float  # distance from the fit, A or rad/s


def without_outliers(fitted: FittedRuns) -> FittedRuns:
    """The runs without outliers, and the fit to them; both unchanged if there are none.

    Again and again, because outliers spoil the fit that shows them.
    """
    while found := list(_found(fitted)):
        fitted = _without(fitted, found)
    return fitted


def _without(fitted: FittedRuns, found: Iterable[_Found]) -> FittedRuns:
    prepared, fit = fitted
    runs, weight, outliers = list(prepared.runs), np.array(prepared.problem.tape.weight), dict(prepared.outliers)
    for k, output, lost, largest in found:
        run, name = runs[k], SIMULATED_OUTPUTS[output]
        runs[k] = attrs.evolve(run, **{name: np.where(lost, np.nan, getattr(run, name))})
        block, at = np.divmod(np.flatnonzero(lost), weight.shape[2])
        weight[int(np.argmax(prepared.problem.tape.blocks_of(k))) + block, output, at] = 0.0
        count, before = outliers.get((run.name, name), (0, 0.0))
        outliers[run.name, name] = count + int(lost.sum()), max(before, largest)
    cleaned = prepared._replace(runs=runs, outliers=outliers).with_tape(weight=jnp.asarray(weight))
    return FittedRuns.polished(cleaned, fit.optimum)


def _found(fitted: FittedRuns) -> Iterator[_Found]:
    """The outliers of each output of each run that has some."""
    tape, simulated = fitted.problem.tape, np.asarray(fitted.fit.evaluation.simulated)
    for k, run in enumerate(fitted.prepared.runs):
        if not run.has_even_clock:
            continue  # interpolated readings are not single ones
        expected = tape.samples_of(k, simulated, len(run))
        for output, residual in enumerate(fitted.residuals(k).T):
            lost = _are_outliers(residual, expected[:, output])
            if 0 < lost.sum() <= MAX_SHARE * len(run):
                yield _Found(k, output, lost, float(np.abs(residual[lost]).max()))


def _are_outliers(
    residual: Float[np.ndarray, " samples"], simulated: Float[np.ndarray, " samples"]
) -> Bool[np.ndarray, " samples"]:
    """Which readings alone are far from the simulation; NaN residuals are none."""
    size = np.abs(residual)
    known = size[~np.isnan(size)]
    if not len(known):
        return np.zeros(len(residual), bool)
    noise = max(float(np.quantile(known, QUANTILE)) / NORMAL_QUANTILE, quantum(np.diff(residual + simulated)))
    beside = np.fmax(np.append(0.0, size[:-1]), np.append(size[1:], 0.0))
    change = np.abs(np.diff(simulated, prepend=simulated[:1], append=simulated[-1:]))
    by_timing = np.maximum(change[:-1], change[1:])
    with np.errstate(invalid="ignore"):
        far = (size > MIN_OUTLIER * noise) & (size > MIN_OVER_CHANGE * by_timing)
        return far & ~(beside > MAX_BESIDE * noise)
