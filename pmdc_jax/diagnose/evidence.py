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

    def of_readings(self, count: int) -> list[Evidence]:
        """The evidence if the residual were what rounding leaves of the `count` readings, where it matters at all."""
        found = []
        for reading in range(-1 - count, -1):
            order = [*range(self.products.shape[1] - 1), reading]
            if np.any(self.products[:, reading, reading]):
                found.append(self._replace(products=self.products[:, order][:, :, order]))
        return found

    def regress(self, blocks: Sequence[Block] = (), visible: float = VISIBLE) -> Regression:
        """Least squares of the residual on the motor's parameters and some blocks.

        Directions in which the rows say less than `visible`, as a share of the most, stay where they are.
        """
        shared = [*range(self.parameters), *(c for b in blocks if not b.own for c in b.columns)]
        own = [c for b in blocks if b.own for c in b.columns]
        kept = [*shared, -1]
        total, solved = np.zeros((len(kept), len(kept))), []
        for product in self.products:
            across = product[np.ix_(own, kept)]
            inverse = _inverse(product[np.ix_(own, own)], visible)
            total += product[np.ix_(kept, kept)] - across.T @ inverse @ across
            solved.append((inverse, across))
        inverse = _inverse(total[:-1, :-1], visible)
        coefficients = inverse @ total[:-1, -1]
        squares = float(total[-1, -1] - total[:-1, -1] @ coefficients)
        errors = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        of_own = [i @ (a[:, -1] - a[:, :-1] @ coefficients) for i, a in solved]
        own_errors = [np.sqrt(np.maximum(np.diag(i), 0.0)) for i, _ in solved]
        place_shared, place_own = self.parameters, 0
        found, spread = [], []
        for block in blocks:
            n = len(block.columns)
            if block.own:
                part = slice(place_own, place_own + n)
                found.append(np.array([c[part] for c in of_own]))
                spread.append(np.array([e[part] for e in own_errors]))
                place_own += n
            else:
                part = slice(place_shared, place_shared + n)
                found.append(coefficients[part])
                spread.append(errors[part])
                place_shared += n
        return Regression(squares, coefficients[: self.parameters], found, spread)

    def freedom(self, block: Block) -> int:
        """How many coefficients a block has."""
        return len(block.columns) * (len(self.products) if block.own else 1)


def _inverse(
    matrix: Float[np.ndarray, "n n"], visible: float = VISIBLE
) -> Float[np.ndarray, "n n"]:
    """Inverse on what the rows can see of it."""
    if not len(matrix):
        return matrix
    lengths = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    lengths = np.where(lengths > 0, lengths, 1.0)
    values, vectors = np.linalg.eigh(matrix / lengths[:, None] / lengths)
    seen = values > visible
    inverse = np.where(seen, 1 / np.where(seen, values, 1.0), 0.0)
    return (vectors * inverse) @ vectors.T / lengths[:, None] / lengths


def products(
    runs: Iterable[Iterable[Float[np.ndarray, "rows _"]]], parameters: int, own: int
) -> Evidence:
    """Gather the evidence from white rows, of every run some at a time.

    **Arguments**: the rows, whose first columns are those of the motor's `parameters`, then what may be missing, what
    rounding may leave, the residual, and last the run's `own`.
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
    return Evidence(np.array(gathered), parameters, rows)
