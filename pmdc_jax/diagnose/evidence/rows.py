"""The rows of the regression: in every training run, derivatives by the motor's parameters and responses to terms that
may be missing; also what late readings and rounding change.

The columns are kept in single precision, and whitened and multiplied in double, some rows at a time, so that a million
samples fit into memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from ...identify.fit.generalised_least_squares import series_of
from ...identify.fit.run_series import RunSeries, series_of_runs
from ...identify.noise.noise_model import Series, Whitener
from ...motor import Motor
from ...runtime.compiled import compiled
from ...simulate import Tape
from ..hypotheses.change import Change, columns_at_once
from ..model import Model
from ..response import Trajectory, respond
from .quantisation import converter_steps, rounding_errors
from .regression import Block, Regression

# Samples that are whitened at once, to limit the memory
CHUNK = 2048
# Standard deviations of how late current and speed are read, in sampling intervals: converters read one channel after
# the other, and simulators go in small steps. Smaller for the current, so that a filtered one remains visible
TIMING_ERRORS = 0.01, 0.03


class Rows(NamedTuple):
    """One training run: its fit, what late readings change, the responses to every candidate and curve, and rounding
    errors; A and rad/s."""

    fit: RunSeries
    late: Float[np.ndarray, "samples outputs 2"]
    columns: Float[np.ndarray, "samples outputs columns"]
    rounding: Float[np.ndarray, "samples outputs draws"]

    def without(
        self, run: int, fit: Regression, block: Block | None, first: int
    ) -> Float[np.ndarray, "samples outputs"]:
        """The residuals less what a regression explains by the parameters and by a block.

        **Arguments**: `first` column of what may be missing.
        """
        shared, _, residual, _ = self.fit
        rest = residual.values - shared.values @ fit.parameter_changes
        if block is None:
            return rest
        coefficients = fit.coefficients[0][run] if block.per_run else fit.coefficients[0]
        return rest - self.columns[..., np.array(block.columns) - first] @ coefficients

    def filtered(self, run: int, whiten: Whitener) -> Iterator[Float[np.ndarray, "rows _"]]:
        """Filtered rows, `CHUNK` samples at a time; columns in the order that `gather_evidence` expects."""
        shared, own, residual, _ = self.fit
        slow = () if whiten.slow is None else (whiten.slow[run],)
        columns = (shared.values, self.late, self.columns, self.rounding, residual.values[..., None], own.values, *slow)
        back = len(whiten.filters[run])
        for first in range(back, len(residual.values), CHUNK):
            part = slice(first - back, first + CHUNK)
            values = np.concatenate([x[part] for x in columns], axis=-1)
            yield whiten.filtered(run, Series(values, residual.known[part], residual.kind))


def gather_rows(model: Model, bare: Motor, trajectory: Trajectory, changes: Iterable[Change], count: int) -> list[Rows]:
    """The rows of every training run, from `changes` with `count` columns in all, which the motor without effects,
    `bare`, propagates."""
    tape, fits = model.problem.tape, series_of_runs(model.prepared, model.fit)
    rows_of_runs = []
    for k, (fit, run) in enumerate(zip(fits, model.prepared.training, strict=True)):
        columns = np.empty((*fit.residual.values.shape, count), np.float32)
        _, outputs = fit.residual.kind
        rounding = rounding_errors(fit, converter_steps(run, outputs), seed=k)
        rows_of_runs.append(Rows(fit, _late_readings(fit), columns, rounding))
    first = 0
    for change, width in _batches(changes, columns_at_once(tape)):
        response = _output_change(bare, tape, trajectory, change)
        for run, rows in zip(model.prepared.training_indices, rows_of_runs, strict=True):
            in_time = series_of(tape, run, response).values
            rows.columns[..., first : first + width] = in_time[..., :width]
        first += width
    return rows_of_runs


def _late_readings(fit: RunSeries) -> Float[np.ndarray, "samples outputs 2"]:
    """What changes where the current, or the speed, is read a sampling interval late."""
    simulated, (_, outputs) = fit.simulated.values, fit.residual.kind
    change = -np.diff(simulated, axis=0, prepend=simulated[:1])
    return change[..., None] * np.eye(2)[list(outputs)]


def _output_change(
    bare: Motor, tape: Tape, trajectory: Trajectory, change: Change
) -> Float32[np.ndarray, "blocks 2 samples columns"]:
    """What a change makes of the recorded outputs of the motor without effects; of a setting that cannot be simulated,
    zero."""
    if change.by_sensor:
        is_finite = np.isfinite(change.values).all((0, 1, 2))
        return np.where(is_finite, change.values, 0).transpose(2, 1, 0, 3)
    return np.asarray(_response(bare, tape, trajectory, change.values))


@compiled
def _response(
    bare: Motor, tape: Tape, trajectory: Trajectory, increments: Float32[Array | np.ndarray, "samples 2 blocks columns"]
) -> Float32[Array, "blocks 2 samples columns"]:
    """The response to state increments of the motor without effects."""
    response = respond(bare, tape, trajectory, increments.astype(jnp.result_type(float)))
    is_finite = jnp.all(jnp.isfinite(response), (0, 1, 2))
    return jnp.where(is_finite, response, 0.0).astype(jnp.float32).transpose(2, 1, 0, 3)


def _batches(changes: Iterable[Change], size: int) -> Iterator[tuple[Change, int]]:
    """The changes of the state in batches of `size` columns, so that the response is compiled once, each with the
    number of its columns that count: the last ones before changes by sensors, which pass as they are, are zeros."""
    waiting: list[np.ndarray] = []
    for change in changes:
        if change.by_sensor:
            yield from _last_batch(waiting, size)
            yield change, change.values.shape[-1]
            waiting = []
            continue
        waiting.append(change.values)
        while sum(values.shape[-1] for values in waiting) >= size:
            together = np.concatenate(waiting, -1)
            yield Change(together[..., :size]), size
            waiting = [together[..., size:]]
    yield from _last_batch(waiting, size)


def _last_batch(waiting: list[np.ndarray], size: int) -> Iterator[tuple[Change, int]]:
    """What is waiting, if anything, padded with zeros to `size` columns."""
    count = sum(values.shape[-1] for values in waiting)
    if count:
        padding = np.zeros((*waiting[0].shape[:-1], size - count), np.float32)
        yield Change(np.concatenate([*waiting, padding], -1)), count
