"""Refinement by Levenberg-Marquardt on forward sensitivities."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ...runtime.compiled import quickly_compiled
from ..identification import CONVERGED_DISTANCE
from ..parameters import Parameters
from ..problem import Problem, Unknowns, evaluate, flatten, normal_matrix, unflatten

MAX_STEPS = 60


class Optimum(NamedTuple):
    """Where a refinement ended."""

    unknowns: Unknowns
    fitness: float  # squared residuals over the noise variances, over the samples of the output that has most
    at_bound: tuple[int, ...]  # which coordinates were held at a bound
    # predicted from the gradient: how far the minimum is, in standard errors; infinite where it was not computed
    distance: float = np.inf
    # there, of the blocks of samples that are simulated in parallel (see `evaluate`); None where they are not known
    starts: Float[np.ndarray, "blocks states"] | None = None

    @property
    def converged(self) -> bool:
        """Whether the minimum is near, by the gradient and not by a solver's own criterion."""
        return self.distance <= CONVERGED_DISTANCE

    def moved(
        self, parameters: Parameters, step: Float[Array | np.ndarray, " parameters"]
    ) -> Optimum:
        """A start whose coordinates are a step further on, within their bounds."""
        further = jnp.clip(self.unknowns.coordinates + step, parameters.lower, parameters.upper)
        return self._replace(unknowns=self.unknowns._replace(coordinates=further))


Columns = Float[Array, " columns"]
# The problem, the start and the scales of its unknowns, and the sum of squares that normalises the residuals
Arguments = tuple[Problem, Columns, Columns, Float[Array, ""]]


# Levenberg-Marquardt depends on the residuals r and their Jacobian J only through J'J, J'r and r'r. It is therefore
# given the shortest residual vector with the same products: its length is the number of unknowns plus one, instead of
# the number of samples.
@eqx.filter_custom_jvp
def compressed(flat: Columns, args: Arguments) -> Float[Array, " columns+1"]:
    return _factor(flat, args)[:, -1]


@compressed.def_jvp
def _compressed_jvp(
    primals: tuple[Columns, Arguments], tangents: tuple[Columns | None, Any]
) -> tuple[Float[Array, " columns+1"], Float[Array, " columns+1"]]:
    flat, args = primals
    factor = _factor(flat, args)
    direction = tangents[0]
    change = jnp.zeros_like(factor[:, -1]) if direction is None else factor[:, :-1] @ direction
    return factor[:, -1], change


def _factor(flat: Columns, args: Arguments) -> Float[Array, "columns+1 columns+1"]:
    problem, flat_start, scale, size = args
    # optimistix promotes dtypes strictly; under standard promotion earlier traces are reused
    with jax.numpy_dtype_promotion("standard"):
        evaluation = evaluate(problem, _unscaled(problem, flat, flat_start, scale))
        matrix = normal_matrix(evaluation, problem.tape, problem.fitted_runs)
    stretch = jnp.append(scale, 1.0)
    matrix = matrix * stretch[:, None] * stretch / size
    # a failed simulation must have a large sum of squares: NaN cannot be compared
    bad = ~jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(bad, jnp.zeros_like(matrix).at[-1, -1].set(1e12), matrix)
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.sqrt(jnp.maximum(values, 0.0))[:, None] * vectors.T


def _unscaled(problem: Problem, flat: Columns, flat_start: Columns, scale: Columns) -> Unknowns:
    """The unknowns in their units; those without a scale stay at their start, from which rounding would move them."""
    return unflatten(problem, jnp.where(scale > 0, flat * scale, flat_start))


@quickly_compiled
def _levenberg_marquardt(
    problem: Problem,
    start: Unknowns,
    scale: Columns,
    size: Float[Array, ""],
    tolerance: Float[Array, ""],
) -> tuple[Unknowns, Float[Array, ""]]:
    flat_start = flatten(start)
    solution = optx.least_squares(
        compressed,
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance),  # pyright: ignore[reportArgumentType]
        jnp.where(scale > 0, flat_start / jnp.where(scale > 0, scale, 1.0), 0.0),
        args=(problem, flat_start, scale, size),
        max_steps=MAX_STEPS,
        throw=False,
    )
    ended = _unscaled(problem, solution.value, flat_start, scale)
    return ended, 2 * solution.state.f_info.as_min() * size


def refine(problem: Problem, start: Unknowns, tolerance: float = 1e-3) -> Optimum:
    """Levenberg-Marquardt from a start, within the bounds.

    optimistix has no bounds, so an active set is used: a coordinate that ends beyond its bound is held there and the
    others are refined again.

    **Arguments**: `tolerance`, relative and absolute, of the solver.
    """
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    matrix = np.asarray(normal_matrix(evaluate(problem, start), problem.tape, problem.fitted_runs))
    size = max(matrix[-1, -1], 1e-30)
    # parameters are scaled to factors of e, a run's own unknowns to changes that equal the norm of the residuals
    lengths = np.sqrt(np.diag(matrix)[:-1] / size)
    scale = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1.0), 0.0)
    scale[: len(low)] = 1.0
    fixed, unknowns, squares = {}, start, size
    for _ in range(len(low) + 1):
        now = eqx.tree_at(lambda p: p.free, problem, _without(problem.free, fixed))
        unknowns, squares = _levenberg_marquardt(
            now, unknowns, jnp.asarray(scale), jnp.asarray(size), jnp.asarray(tolerance)
        )
        coordinates = np.array(unknowns.coordinates)
        beyond = {int(k): low[k] for k in np.flatnonzero(coordinates < low)}
        beyond |= {int(k): high[k] for k in np.flatnonzero(coordinates > high)}
        fixed |= beyond
        coordinates[list(fixed)] = list(fixed.values())
        unknowns = unknowns._replace(coordinates=jnp.asarray(coordinates))
        if not beyond:
            break
    return Optimum(unknowns, float(squares) / problem.most_samples, tuple(sorted(fixed)))


def _without(free: Bool[Array, " parameters"], fixed: Container[int]) -> Bool[Array, " parameters"]:
    return jnp.asarray([bool(f) and k not in fixed for k, f in enumerate(np.asarray(free))])
