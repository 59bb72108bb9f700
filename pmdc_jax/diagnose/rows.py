"""The rows of the regression: in every training run what the motor's parameters, and whatever may be missing, change.

The columns are kept in single precision, and made white and multiplied some rows at a time in double: a log of a
million samples has to fit into memory.
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

# Samples that are made white at once
STRETCH = 2048


class Rows(NamedTuple):
    """Of one training run its fit, what every candidate and curve changes, and what rounding may leave; A and rad/s."""

    fit: RunSeries
    columns: Float[np.ndarray, "samples outputs columns"]
    rounding: Float[np.ndarray, "samples outputs readings"]

    def white(self, run: int, whiten: Whitener) -> Iterator[Float[np.ndarray, "rows _"]]:
        """Rows made white, some at a time: of the motor's parameters, the columns, what rounding may leave,
        the residual, and the run's own."""
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
    """The rows of every training run, of `count` columns; `bare`, the motor without effects, carries changes on."""
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
    # a setting that cannot be simulated says nothing
    sound = jnp.all(jnp.isfinite(response), (0, 1, 2))
    return jnp.where(sound, response, 0.0).astype(jnp.float32)


def _side_by_side(changes: Iterable[Change], most: int) -> Iterator[tuple[Change, int]]:
    """The changes in parts of one width, for which the response is compiled once; how many columns each is of."""
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
