"""Evidence for what is missing: one regression of whitened residuals on everything that might be.

Any question asked of the evidence afterwards (a single effect, a pair, a curve) is algebra on one small matrix of inner
products for each run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Directions with a smaller eigenvalue, of unit columns, are dropped. First-order responses are accurate to a thousandth
# (1e-6 in squares): a smaller difference between a column and what the motor's parameters can do is only that error.
MIN_EIGENVALUE = 1e-6


class Block(NamedTuple):
    """Columns that are regressed on together; with `per_run`, every run has its own coefficients."""

    columns: tuple[int, ...]
    per_run: bool = False


def consecutive_blocks(widths: Iterable[tuple[int, bool]], first: int) -> list[Block]:
    """Blocks from pairs of a number of columns and `per_run`, one after another from the `first` column on."""
    blocks = []
    for width, per_run in widths:
        blocks.append(Block(tuple(range(first, first + width)), per_run))
        first += width
    return blocks


class Regression(NamedTuple):
    """A least-squares fit by the motor's own parameters, the late readings and some blocks."""

    squares: float  # sum of the squared white residuals that are left
    parameter_changes: Float[np.ndarray, " parameters"]  # of the motor's search coordinates
    late_readings: Float[np.ndarray, " outputs"]  # by how many samples each output is read late
    coefficients: list[Float[np.ndarray, "*runs columns"]]  # of every block
    errors: list[Float[np.ndarray, "*runs columns"]]  # their standard errors


class _Solution(NamedTuple):
    """Least squares of several targets: coefficients that all runs share, and those that each run has of its own."""

    squares: Float[np.ndarray, " targets"]  # left of each target
    shared: Float[np.ndarray, "shared targets"]
    shared_errors: Float[np.ndarray, " shared"]
    per_run: Float[np.ndarray, "runs columns targets"]
    per_run_errors: Float[np.ndarray, "runs columns"]


class Evidence(NamedTuple):
    """Inner products of the white rows of every run: the motor's parameters first, late readings, then the columns of
    what may be missing, those of rounding errors, and the residual last.

    The run's own unknowns (its initial state, its load) are nuisance parameters: they are projected out, and columns
    that can hardly be told from them are set to zero.
    """

    products: Float[np.ndarray, "runs columns columns"]
    parameters: int  # number of columns that are the motor's
    late_readings: int  # number of columns that are those
    rounding_columns: tuple[int, ...] = ()  # of the rounding errors of coarse converters

    @property
    def first_column(self) -> int:
        """The first column of what may be missing."""
        return self.parameters + self.late_readings

    def regress(self, blocks: Sequence[Block] = (), min_eigenvalue: float = MIN_EIGENVALUE) -> Regression:
        """Least squares of the residual on the motor's parameters, the late readings and some blocks.

        Directions whose eigenvalue, with columns scaled to unit length, is below `min_eigenvalue` are not moved.
        """
        solution = self._solve(blocks, [-1], min_eigenvalue)
        first_shared, first_per_run = self.first_column, 0
        coefficients, errors = [], []
        for block in blocks:
            width = len(block.columns)
            if block.per_run:
                part = slice(first_per_run, first_per_run + width)
                first_per_run += width
                coefficients.append(solution.per_run[:, part, 0])
                errors.append(solution.per_run_errors[:, part])
            else:
                part = slice(first_shared, first_shared + width)
                first_shared += width
                coefficients.append(solution.shared[part, 0])
                errors.append(solution.shared_errors[part])
        changes, late = np.split(solution.shared[: self.first_column, 0], [self.parameters])
        return Regression(float(solution.squares[0]), changes, late, coefficients, errors)

    def _solve(self, blocks: Sequence[Block], targets: Sequence[int], min_eigenvalue: float) -> _Solution:
        """Least squares of the `targets`, which are columns, on what `regress` has."""
        per_run = np.array([c for b in blocks if b.per_run for c in b.columns], int)
        shared = [*range(self.first_column), *(c for b in blocks if not b.per_run for c in b.columns)]
        kept, n = np.array([*shared, *targets]), len(shared)
        total = self.products[:, kept[:, None], kept].sum(0)
        cross = self.products[:, per_run[:, None], kept]
        per_run_inverse = _inverse(self.products[:, per_run[:, None], per_run], min_eigenvalue)
        total -= (cross.swapaxes(1, 2) @ per_run_inverse @ cross).sum(0)
        inverse = _inverse(total[:n, :n], min_eigenvalue)
        coefficients = inverse @ total[:n, n:]
        return _Solution(
            squares=np.diag(total[n:, n:]) - np.sum(total[:n, n:] * coefficients, 0),
            shared=coefficients,
            shared_errors=_errors(inverse),
            per_run=per_run_inverse @ (cross[..., n:] - cross[..., :n] @ coefficients),
            per_run_errors=_errors(per_run_inverse),
        )

    def rounding_dispersion(self, block: Block) -> float:
        """The mean gain per degree of freedom of a block on the rounding errors of coarse converters; at least one."""
        if not self.rounding_columns:
            return 1.0
        before, after = (self._solve(blocks, self.rounding_columns, MIN_EIGENVALUE).squares for blocks in ([], [block]))
        return float(max(np.mean(before - after) / self.degrees_of_freedom(block), 1.0))

    def degrees_of_freedom(self, block: Block) -> int:
        """The degrees of freedom of a block: its coefficients in all runs."""
        return len(block.columns) * (len(self.products) if block.per_run else 1)


def _inverse(
    matrix: Float[np.ndarray, "*runs n n"], min_eigenvalue: float = MIN_EIGENVALUE
) -> Float[np.ndarray, "*runs n n"]:
    """Pseudo-inverse of a Gram matrix without the directions whose eigenvalue is below `min_eigenvalue`."""
    if not matrix.size:
        return matrix
    lengths = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 0.0))
    lengths = np.where(lengths > 0, lengths, 1.0)
    units = lengths[..., :, None] * lengths[..., None, :]
    values, vectors = np.linalg.eigh(matrix / units)
    kept = values > min_eigenvalue
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    return (vectors * inverse[..., None, :]) @ vectors.swapaxes(-2, -1) / units


def _errors(inverse: Float[np.ndarray, "*runs n n"]) -> Float[np.ndarray, "*runs n"]:
    """Standard errors of the coefficients, from the inverse of their Gram matrix."""
    return np.sqrt(np.maximum(np.diagonal(inverse, axis1=-2, axis2=-1), 0.0))


def gather_evidence(
    runs: Iterable[Iterable[Float[np.ndarray, "_ _"]]],
    parameters: int,
    run_unknowns: int,
    timing_errors: Sequence[float] = (),
    rounding_errors: int = 0,
    slow: int = 0,
) -> Evidence:
    """Gather the evidence from filtered rows, those of each run in several pieces.

    **Arguments**: `runs`, the pieces of each run, with columns for the motor's `parameters`, the late readings, what
    may be missing, the simulated `rounding_errors` of coarse converters, the residual, the `run_unknowns`, and last
    those that `slow` noise has with random coefficients of unit variance; the numbers are how many columns each has.
    `timing_errors`, the standard deviations to within which it is known beforehand that each output is not read late.
    """
    products = []
    for pieces in runs:
        total = np.zeros(())
        for piece in pieces:
            total = total + piece.T @ piece
        total[np.diag_indices(len(total))] += np.append(np.zeros(len(total) - slow), np.ones(slow))
        kept, nuisance = slice(0, -run_unknowns - slow), slice(-run_unknowns - slow, None)
        cross = total[nuisance, kept]
        projected = total[kept, kept] - cross.T @ _inverse(total[nuisance, nuisance]) @ cross
        distinct = np.diag(projected) > MIN_EIGENVALUE * np.diag(total)[kept]
        products.append(projected * distinct * distinct[:, None])
    gram, residual = np.array(products), products[0].shape[0] - 1
    late = parameters + np.arange(len(timing_errors))
    gram[0, late, late] += 1 / np.square(timing_errors)
    rounding = (k for k in range(residual - rounding_errors, residual) if gram[:, k, k].any())
    return Evidence(gram, parameters, len(late), tuple(rounding))
