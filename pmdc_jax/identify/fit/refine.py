"""Refinement by Levenberg-Marquardt on forward sensitivities."""

from __future__ import annotations

from collections.abc import Container
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ...runtime.compiled import quickly_compiled, strongly_typed
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

    def moved(self, parameters: Parameters, step: Float[Array | np.ndarray, " parameters"]) -> Optimum:
        """A start whose coordinates are a step further on, within their bounds."""
        further = jnp.clip(self.unknowns.coordinates + step, parameters.lower, parameters.upper)
        return self._replace(unknowns=self.unknowns._replace(coordinates=further))


Columns = Float[Array | np.ndarray, " columns"]
Factor = Float[Array | np.ndarray, "rows rows"]

# With the Jacobian as an array, which one program can pass on to the next
SOLVER_OPTIONS = {"jac": "bwd"}


class _Step(NamedTuple):
    """Where Levenberg-Marquardt is."""

    best: Columns  # of the unknowns tried so far
    squares: Float[Array, ""]  # there
    asked: Columns  # the unknowns to be tried next
    ended: Bool[Array, ""]
    state: tuple[Array, ...]  # leaves of optimistix's


def _levenberg_marquardt(
    problem: Problem, start: Unknowns, scale: np.ndarray, size: float, tolerance: float
) -> tuple[Unknowns, float]:
    """The unknowns with the least squares, and these.

    **Arguments**: `scale` of the unknowns, and `size` of the squares, by which the solver's are divided.
    """
    flat_start, moves = np.asarray(flatten(start)), scale > 0

    def in_units(scaled: Columns) -> Unknowns:
        # those without a scale stay at their start, from which rounding would move them
        flat = np.where(moves, np.asarray(scaled) * scale, flat_start)
        return unflatten(problem, jnp.asarray(flat))

    step = _begin(jnp.asarray(np.where(moves, flat_start / np.where(moves, scale, 1.0), 0.0)))
    starts = None
    for _ in range(MAX_STEPS):
        evaluation = evaluate(problem, in_units(step.asked), starts)
        starts = np.asarray(evaluation.starts)  # about where those of the next simulation are
        matrix = np.asarray(normal_matrix(evaluation, problem.tape, problem.fitted_runs))
        step = _next(step, _factor(matrix, scale, size), jnp.asarray(tolerance))
        if step.ended:
            break
    return in_units(step.best), float(step.squares) * size


# The simulation is no part of these two programs: one compilation serves all models with as many unknowns.
@quickly_compiled
def _begin(start: Columns) -> _Step:
    leaves = tuple(jax.tree.leaves(_first_state(_solver(jnp.asarray(0.0)), start)))
    step = _Step(start, jnp.asarray(np.inf), start, jnp.asarray(False), leaves)
    return strongly_typed(step)


@quickly_compiled
def _next(step: _Step, factor: Factor, tolerance: Float[Array, ""]) -> _Step:
    """The next step, given the `factor` at the unknowns that this one asked for."""
    solver, model = _solver(tolerance), (step.asked, factor)
    like = jax.eval_shape(partial(_first_state, solver), step.asked)
    before = jax.tree.unflatten(jax.tree.structure(like), step.state)
    best, state, _ = solver.step(_linearised, step.best, model, SOLVER_OPTIONS, before, frozenset())
    leaves = tuple(jax.tree.leaves(state))
    return _Step(best, 2 * state.f_info.as_min(), state.y_eval, state.terminate, leaves)


def _solver(tolerance: Float[Array, ""]) -> optx.LevenbergMarquardt:
    return optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)  # pyright: ignore[reportArgumentType]


def _first_state(solver: optx.LevenbergMarquardt, start: Columns) -> Any:
    rows = len(start) + 1
    model = (start, jnp.zeros((rows, rows)))
    residuals, _ = jax.eval_shape(_linearised, start, model)
    return solver.init(_linearised, start, model, SOLVER_OPTIONS, residuals, None, frozenset())


def _linearised(unknowns: Columns, model: tuple[Columns, Factor]) -> tuple[Float[Array | np.ndarray, " rows"], None]:
    """The residuals, linearised about the only unknowns at which the solver asks for them and for their Jacobian."""
    point, factor = model
    return factor[:, -1] + factor[:, :-1] @ (unknowns - point), None


def _factor(matrix: np.ndarray, scale: np.ndarray, size: float) -> np.ndarray:
    """The shortest matrix [J r] of scaled unknowns with the right products [J r]' [J r], on which alone
    Levenberg-Marquardt depends: it has as many rows as unknowns and one more, instead of one for each sample."""
    stretch = np.append(scale, 1.0)
    if np.all(np.isfinite(matrix)):
        matrix = matrix * stretch[:, None] * stretch / size
    else:  # a failed simulation must have a large sum of squares: NaN cannot be compared
        matrix = np.zeros_like(matrix)
        matrix[-1, -1] = 1e12
    values, vectors = np.linalg.eigh(matrix)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


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
        unknowns, squares = _levenberg_marquardt(now, unknowns, scale, size, tolerance)
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
