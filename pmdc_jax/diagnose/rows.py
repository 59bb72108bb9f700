"""The rows of the regression: in every training run, derivatives by the motor's parameters and all that may be missing.

The columns are kept in single precision, and whitened and multiplied in double, some rows at a time: a log of a million
samples has to fit into memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from ..compiled import compiled
from ..identify.generalised_least_squares import series_of
from ..identify.noise_model import Series, Whitener
from ..motor import Motor
from ..simulate import Tape
from .library import Change, side_by_side_on
from .model import Model, RunSeries, rows_of
from .quantisation import readings
from .response import Path, respond

# Samples that are whitened at once, to limit the memory
STRETCH = 2048


class Rows(NamedTuple):
    """One training run's fit, responses to every candidate and curve, and possible rounding errors; A and rad/s."""

    fit: RunSeries
    columns: Float[np.ndarray, "samples outputs columns"]
    rounding: Float[np.ndarray, "samples outputs readings"]

    def white(self, run: int, whiten: Whitener) -> Iterator[Float[np.ndarray, "rows _"]]:
        """Whitened rows, `STRETCH` samples at a time; columns in the order that `evidence.products` expects."""
        shared, own, residual, _ = self.fit
        back = len(whiten.filters[run])
        for first in range(back, len(residual.values), STRETCH):
            part = slice(first - back, first + STRETCH)
            everything = (
                shared.values[part],
                self.columns[part],
                self.rounding[part],
                residual.values[part, :, None],
                own.values[part],
            )
            values = np.concatenate(everything, axis=-1)
            yield whiten(run, Series(values, residual.known[part], residual.kind))


def gathered(
    model: Model, bare: Motor, path: Path, changes: Iterable[Change], count: int
) -> list[Rows]:
    """The rows of every training run, from `changes` with `count` columns in all, which the motor without effects,
    `bare`, propagates."""
    tape, fits = model.given.problem.tape, rows_of(model)
    rows = [
        Rows(f, np.empty((*f.residual.values.shape, count), np.float32), readings(f, k))
        for k, f in enumerate(fits)
    ]
    first = 0
    for change, width in _side_by_side(changes, side_by_side_on(tape)):
        response = np.asarray(_response(bare, tape, path, change))[..., :width]
        for run, of_run in zip(model.training, rows, strict=True):
            signal = response.transpose(2, 1, 0, 3)
            of_run.columns[..., first : first + width] = series_of(tape, run, signal).values
        first += width
    return rows


@compiled
def _response(bare: Motor, tape: Tape, path: Path, change: Change) -> Float32[Array, "..."]:
    response = respond(bare, tape, path, change.kicks) + change.seen
    # a setting that cannot be simulated gets a column of zeros
    sound = jnp.all(jnp.isfinite(response), (0, 1, 2))
    return jnp.where(sound, response, 0.0).astype(jnp.float32)


def _side_by_side(changes: Iterable[Change], most: int) -> Iterator[tuple[Change, int]]:
    """The changes regrouped into parts of `most` columns, so that the response is compiled once, each with the number
    of its columns that count; the last part is filled up with zeros."""
    waiting: list[Change] = []
    count = 0
    for change in changes:
        waiting.append(change)
        count += change.kicks.shape[-1]
        while count >= most:
            together = _joined(waiting)
            yield Change(*(x[..., :most] for x in together)), most
            waiting = [Change(*(x[..., most:] for x in together))]
            count -= most
    if count:
        nothing = [(0, 0)] * 3 + [(0, most - count)]
        yield Change(*(np.pad(x, nothing) for x in _joined(waiting))), count


def _joined(changes: Sequence[Change]) -> Change:
    return Change(*(np.concatenate(parts, -1) for parts in zip(*changes, strict=True)))
