"""Evidence for what is missing: one regression of whitened residuals on everything that might be.

Whatever is asked of the evidence afterwards (a single effect, a pair, a curve) is algebra on one small matrix of
inner products for every run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# A direction with less than this share of the squares is none: responses to first order are good to a thousandth,
# and what tells one from what the motor's parameters do as well is no more than that error.
VISIBLE = 1e-6


class Block(NamedTuple):
    """Columns that stand or fall together; with `own`, every run has its own coefficients."""

    columns: tuple[int, ...]
    own: bool = False


def blocks_of(orders: Iterable[tuple[int, bool]], first: int) -> list[Block]:
    """Blocks of so many columns each, of every run's own or not, one after another from the `first` column on."""
    blocks = []
    for order, own in orders:
        blocks.append(Block(tuple(range(first, first + order)), own))
        first += order
    return blocks


class Regression(NamedTuple):
    """A fit by some blocks on top of the motor's own parameters."""

    squares: float  # sum of the squared white residuals that are left
    moved: Float[np.ndarray, " parameters"]  # by how much the motor's parameters move
    coefficients: list[Float[np.ndarray, "*runs columns"]]  # of every block
    errors: list[Float[np.ndarray, "*runs columns"]]  # their standard errors


class Evidence(NamedTuple):
    """Inner products of the white rows of every run: motor parameters first, then columns, what rounding may leave, and
    the residual last.

    What belongs to a run alone (its initial state, its load) is projected out, with what can hardly be told from it.
    """

    products: Float[np.ndarray, "runs columns columns"]
    parameters: int  # how many columns are the motor's
    rows: int
    readings: tuple[int, ...] = ()  # columns of what coarse converters leave

    def regress(self, blocks: Sequence[Block] = (), visible: float = VISIBLE) -> Regression:
        """Least squares of the residual on the motor's parameters and some blocks.

        Directions in which the rows say less than `visible`, as a share of the most, stay where they are.
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
        """Least squares of some columns at once: the squares left of each, and the coefficients with their standard
        errors, those that all runs have in common and those of each run."""
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
        """How much more than by chance a block gains, in the mean, of what coarse converters leave; at least one."""
        if not self.readings:
            return 1.0
        without, with_it = (self._regressed(b, self.readings, VISIBLE)[0] for b in ([], [block]))
        return float(max(np.mean(without - with_it) / self.freedom(block), 1.0))

    def freedom(self, block: Block) -> int:
        """How many coefficients a block has."""
        return len(block.columns) * (len(self.products) if block.own else 1)


def _inverse(
    matrix: Float[np.ndarray, "*runs n n"], visible: float = VISIBLE
) -> Float[np.ndarray, "*runs n n"]:
    """Inverse on what the rows can see of it."""
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
    """Gather the evidence from white rows, of every run some at a time.

    **Arguments**: the rows, whose first columns are those of the motor's `parameters`, then what may be missing, what
    coarse converters leave in some `readings`, the residual, and last the run's `own`.
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
