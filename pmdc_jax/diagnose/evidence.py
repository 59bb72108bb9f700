"""Evidence for what is missing: one regression of whitened residuals on everything that might be.

Any question asked of the evidence afterwards (a single effect, a pair, a curve) is algebra on one small matrix of inner
products for each run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Directions with a smaller share of the squares are dropped. First-order responses are accurate to a thousandth (1e-6
# in squares): a smaller difference between a column and what the motor's parameters can do is only that error.
VISIBLE = 1e-6


class Block(NamedTuple):
    """Columns that are regressed on together; with `own`, every run has its own coefficients."""

    columns: tuple[int, ...]
    own: bool = False


def blocks_of(orders: Iterable[tuple[int, bool]], first: int) -> list[Block]:
    """Blocks from pairs of a number of columns and `own`, one after another from the `first` column on."""
    blocks = []
    for order, own in orders:
        blocks.append(Block(tuple(range(first, first + order)), own))
        first += order
    return blocks


class Regression(NamedTuple):
    """A least-squares fit by the motor's own parameters and some blocks."""

    squares: float  # sum of the squared white residuals that are left
    moved: Float[np.ndarray, " parameters"]  # change of the motor's search coordinates
    coefficients: list[Float[np.ndarray, "*runs columns"]]  # of every block
    errors: list[Float[np.ndarray, "*runs columns"]]  # their standard errors


class Evidence(NamedTuple):
    """Inner products of the white rows of every run: the motor's parameters first, then the columns of what may be
    missing, those of rounding errors, and the residual last.

    The run's own unknowns (its initial state, its load) are nuisance parameters: they are projected out, and columns
    that can hardly be told from them are set to zero.
    """

    products: Float[np.ndarray, "runs columns columns"]
    parameters: int  # number of columns that are the motor's
    rows: int  # number of white rows in all runs
    readings: tuple[int, ...] = ()  # columns of the rounding errors of coarse converters

    def regress(self, blocks: Sequence[Block] = (), visible: float = VISIBLE) -> Regression:
        """Least squares of the residual on the motor's parameters and some blocks.

        Directions whose eigenvalue, with columns scaled to unit length, is below `visible` are not moved.
        """
        squares, shared, own = self._regressed(blocks, [-1], visible)
        places, found, spread = [self.parameters, 0], [], []
        for block in blocks:
            n = len(block.columns)
            part = slice(places[block.own], places[block.own] + n)
            coefficients, errors = own if block.own else shared
            found.append(coefficients[..., part, 0])
            spread.append(errors[..., part])
            places[block.own] += n
        moved = shared[0][: self.parameters, 0]
        return Regression(float(squares[0]), moved, found, spread)

    def _regressed(
        self, blocks: Sequence[Block], targets: Sequence[int], visible: float
    ) -> tuple[
        Float[np.ndarray, " targets"],
        tuple[Float[np.ndarray, "shared targets"], Float[np.ndarray, " shared"]],
        tuple[Float[np.ndarray, "runs own targets"], Float[np.ndarray, "runs own"]],
    ]:
        """Least squares of several targets: the squares left, and coefficients with standard errors, shared and own."""
        own = np.array([c for b in blocks if b.own for c in b.columns], int)
        shared = [*range(self.parameters), *(c for b in blocks if not b.own for c in b.columns)]
        kept, n = np.array([*shared, *targets]), len(shared)
        total = self.products[:, kept[:, None], kept].sum(0)
        across = self.products[:, own[:, None], kept]
        of_own = _inverse(self.products[:, own[:, None], own], visible)
        total -= (across.swapaxes(1, 2) @ of_own @ across).sum(0)
        inverse = _inverse(total[:n, :n], visible)
        coefficients = inverse @ total[:n, n:]
        squares = np.diag(total[n:, n:]) - np.sum(total[:n, n:] * coefficients, 0)
        own_coefficients = of_own @ (across[..., n:] - across[..., :n] @ coefficients)
        return squares, (coefficients, _errors(inverse)), (own_coefficients, _errors(of_own))

    def gained_by_rounding(self, block: Block) -> float:
        """The mean gain per degree of freedom of a block on the rounding errors of coarse converters; at least one."""
        if not self.readings:
            return 1.0
        without, with_it = (self._regressed(b, self.readings, VISIBLE)[0] for b in ([], [block]))
        return float(max(np.mean(without - with_it) / self.freedom(block), 1.0))

    def freedom(self, block: Block) -> int:
        """The degrees of freedom of a block: its coefficients in all runs."""
        return len(block.columns) * (len(self.products) if block.own else 1)


def _inverse(
    matrix: Float[np.ndarray, "*runs n n"], visible: float = VISIBLE
) -> Float[np.ndarray, "*runs n n"]:
    """Pseudo-inverse of a Gram matrix on the directions that are `visible`."""
    if not matrix.size:
        return matrix
    lengths = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 0.0))
    lengths = np.where(lengths > 0, lengths, 1.0)
    units = lengths[..., :, None] * lengths[..., None, :]
    values, vectors = np.linalg.eigh(matrix / units)
    seen = values > visible
    inverse = np.where(seen, 1 / np.where(seen, values, 1.0), 0.0)
    return (vectors * inverse[..., None, :]) @ vectors.swapaxes(-2, -1) / units


def _errors(inverse: Float[np.ndarray, "*runs n n"]) -> Float[np.ndarray, "*runs n"]:
    return np.sqrt(np.maximum(np.diagonal(inverse, axis1=-2, axis2=-1), 0.0))


def products(
    runs: Iterable[Iterable[Float[np.ndarray, "rows _"]]],
    parameters: int,
    own: int,
    readings: int = 0,
) -> Evidence:
    """Gather the evidence from white rows, those of each run in several pieces.

    **Arguments**: `runs`, the pieces of each run, with columns for the motor's `parameters`, what may be missing, the
    rounding errors of coarse converters in some `readings`, the residual, and last the run's `own` unknowns; the
    numbers are how many columns each has.
    """
    gathered, rows = [], 0
    for pieces in runs:
        total = np.zeros(())
        for piece in pieces:
            total = total + piece.T @ piece
            rows += len(piece)
        kept, alone = slice(0, -own), slice(-own, None)
        across = total[alone, kept]
        left = total[kept, kept] - across.T @ _inverse(total[alone, alone]) @ across
        seen = np.diag(left) > VISIBLE * np.diag(total)[kept]
        gathered.append(left * seen * seen[:, None])
    found, last = np.array(gathered), gathered[0].shape[0] - 1
    read = (k for k in range(last - readings, last) if found[:, k, k].any())
    return Evidence(found, parameters, rows, tuple(read))
