"""Final Gauss-Newton iterations of a fit, each output weighted by the standard deviation of its own residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..simulate import UNKNOWNS_PER_RUN, RunUnknowns
from ..threads import map_in_threads
from .noise import MIN_RELATIVE_NOISE
from .parameters import Parameters
from .problem import (
    Evaluation,
    Problem,
    Unknowns,
    evaluate,
    flatten,
    normal_matrix,
    scaled,
    unflatten,
    whitened,
)
from .refine import Optimum

# The polish stops if the cost fell by less than MIN_COST_DECREASE over the last PATIENCE steps: dry elements leave
# kinks, at which the linearised model predicts a larger reduction than there is
PATIENCE, MIN_COST_DECREASE = 5, 1e-5
# Gauss-Newton steps at most, and the predicted reduction of the sum of squares, in noise variances, below which no
# step is taken: the square of 0.045 standard errors
MAX_STEPS = 20
TOLERANCE = 2e-3
# Initial twists tried for a run, as shares of the gear's backlash, from where the load presses the teeth
BACKLASH_STARTS = np.linspace(-1.0, 1.0, 9)
# Initial rotor angles tried per period of an angle-dependent torque (the shortest one), and at most
ANGLES_PER_PERIOD, MAX_ANGLES = 8, 32
# Curvature added to every coordinate in a step, as a prior that knows each to within a factor of e, and to the initial
# state, as one that knows it to within what was measured: negligible for what the data determine, while what they do
# not determine, such as a current that has settled before it is read, stays where it is
RIDGE = 1.0


class Fit(NamedTuple):
    """A motor fitted to the runs: the optimum, the simulation there, and the noise estimated from the residuals."""

    optimum: Optimum
    evaluation: Evaluation
    noise: Float[np.ndarray, "2"]  # standard deviations of current A and speed rad/s
    cost: float  # what the polish minimises (see `_WeightedPoint`)

    @property
    def unknowns(self) -> Unknowns:
        """The unknowns at the optimum."""
        return self.optimum.unknowns

    @property
    def coordinates(self) -> Float[Array, " parameters"]:
        """The search coordinates at the optimum."""
        return self.optimum.unknowns.coordinates

    @property
    def fitness(self) -> float:
        """Mean square of the residuals in noise variances; infinite where the simulation fails."""
        return self.optimum.fitness

    @property
    def at_bound(self) -> tuple[int, ...]:
        """The coordinates that are held at a bound."""
        return self.optimum.at_bound


def polish(
    problem: Problem,
    start: Optimum,
    steps: int = MAX_STEPS,
    tolerance: float = TOLERANCE,
    known: Evaluation | None = None,
) -> Fit:
    """Gauss-Newton iterations in which each output is weighted by the standard deviation of its own residuals.

    It ends where no step within the bounds is predicted to lower the sum of squares by more than `tolerance`, in noise
    variances, or none is found that lowers it. A coordinate held at a bound is released where the gradient points back
    inside. `known` is the evaluation at the start, if there is one already.
    """
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    ridge = ridge_of(problem)
    held = set(start.at_bound)
    best = trial = _evaluate_weighted(problem, start.unknowns, known)
    step, share, gain = np.zeros(len(flatten(start.unknowns))), 1.0, np.inf
    costs = [best.cost]
    for _ in range(steps):
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] < MIN_COST_DECREASE:
            break
        if not np.isfinite(best.cost):
            break  # a failed simulation has no gradient
        if trial.cost <= best.cost + 1e-9:
            best, share = trial, 1.0
            coordinates = np.asarray(best.unknowns.coordinates)
            held = {k for k in held if (best.matrix[k, -1] > 0) == (coordinates[k] <= low[k])}
            step, gain = gauss_newton_step(best.matrix, held, ridge)
            if gain <= tolerance * _residual_variance(problem, best):
                break
        elif share > 1e-3:
            share /= 4  # the last step was too long
        else:
            break
        moved = np.asarray(flatten(best.unknowns)) + _damped_log_step(
            problem.parameters, share * step
        )
        inside = np.clip(moved[: len(low)], low, high)
        held |= set(np.flatnonzero(inside != moved[: len(low)]).tolist())
        moved[: len(low)] = inside
        trial = _evaluate_weighted(problem, unflatten(problem, jnp.asarray(moved)))
        costs.append(min(trial.cost, best.cost))
    distance = float(np.sqrt(gain / _residual_variance(problem, best)))
    optimum = Optimum(best.unknowns, best.fitness, tuple(sorted(held)), distance)
    return Fit(optimum, best.evaluation, best.noise, best.cost)


def _damped_log_step(parameters: Parameters, step: np.ndarray) -> np.ndarray:
    """A step s in which a positive parameter grows linearly, p (1 + s), instead of by exp(s): one that is nearly zero,
    such as friction hidden by another effect, would otherwise grow without limit."""
    rises = np.zeros(len(step), bool)
    rises[: len(parameters.names)] = parameters.logarithmic
    return np.where(rises & (step > 0), np.log1p(np.maximum(step, 0.0)), step)


class _WeightedPoint(NamedTuple):
    """An evaluated point, each output weighted by its own residuals."""

    unknowns: Unknowns
    evaluation: Evaluation
    noise: np.ndarray
    matrix: np.ndarray
    # what maximum likelihood minimises: the sum of the logarithms of the outputs' noise; for whitened residuals, the
    # logarithm of their sum of squares
    cost: float
    fitness: float


def _residual_variance(problem: Problem, best: _WeightedPoint) -> float:
    """Mean square of the weighted residuals. Unless they are whitened it is at least 1, the noise they are weighted by:
    fitted to a simulation without noise they are next to nothing."""
    mean = best.matrix[-1, -1] / max(float(np.sum(problem.samples)), 1.0)
    return max(mean, 1e-300 if problem.whitening is not None else 1.0)


def reweighted(problem: Problem, fit: Fit) -> Evaluation:
    """The evaluation at a fit to plain residuals, weighted as in a problem with another noise."""
    return whitened(problem, scaled(fit.evaluation, fit.noise / np.asarray(problem.noise)))


def _evaluate_weighted(
    problem: Problem, unknowns: Unknowns, known: Evaluation | None = None
) -> _WeightedPoint:
    evaluation = evaluate(problem, unknowns) if known is None else known
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        squares = squares_of_outputs(problem, evaluation)
        noise, stretch = residual_noise(problem, squares)
        weighted = scaled(evaluation, stretch)
        matrix = np.array(normal_matrix(weighted, problem.tape, problem.fitted_runs))
        if problem.whitening is not None:
            cost = float(np.log(np.maximum(squares.sum(), 1e-300)))
        else:
            over = squares * stretch**2 / np.maximum(problem.samples, 1.0)
            cost = float(np.log(np.maximum(noise, 1e-300)).sum() + over.sum() / 2)
    fitness = float(squares.sum()) / problem.most_samples
    # a failed simulation is infinitely bad
    cost, fitness = (x if np.isfinite(x) else np.inf for x in (cost, fitness))
    return _WeightedPoint(unknowns, weighted, noise, matrix, cost, fitness)


def best_backlash_start(problem: Problem, unknowns: Unknowns, start: RunUnknowns) -> Unknowns:
    """Each run's own unknowns as they are, or `start` with the teeth of its gear elsewhere within the backlash,
    whichever fits the run best.

    No gradient leads there: the moment at which the teeth first meet changes all that follows, and a run that begins
    at rest may be fitted as well as possible by an initial speed that it never had.
    """
    motor = problem.parameters(unknowns.coordinates)
    play = sum(float(effect.play()) for effect in motor.effects)
    middle = jnp.zeros_like(start.twist)
    trials = [start._replace(twist=middle + share * play) for share in BACKLASH_STARTS if play]
    return _best_run_unknowns(problem, unknowns, trials)


def best_initial_angle(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Each hold-out run's own unknowns as they are, or with another initial angle of the rotor, whichever fits best.

    With several angle-dependent torques, angles within the longest period are tried first, then shifts by whole
    periods of each. From half a period away the gradient leads to another optimum, or nowhere.
    """
    waves = [e.repeats_after() for e in problem.parameters(unknowns.coordinates).effects]
    periods = [float(wave["angle"]) for wave in waves if "angle" in wave]
    turnable = np.asarray(problem.angle_unknown & ~jnp.asarray(problem.fitted_runs))
    if not periods or not turnable.any():
        return unknowns
    count = min(round(ANGLES_PER_PERIOD * max(periods) / min(periods)), MAX_ANGLES)
    turns = [np.arange(1, count) / count * max(periods)]
    if len(periods) > 1:
        turns += [np.arange(1, round(2 * np.pi / period)) * period for period in periods]
    for some in turns:
        own = unknowns.runs
        trials = [own._replace(angle=own.angle + turn * turnable) for turn in some]
        unknowns = _best_run_unknowns(problem, unknowns, trials)
    return unknowns


def _best_run_unknowns(
    problem: Problem, unknowns: Unknowns, trials: Sequence[RunUnknowns]
) -> Unknowns:
    """Each run's own unknowns as they are, or those of the trial that fits it best."""
    if not trials:
        return unknowns
    tried = [unknowns.runs, *trials]

    def squares(runs: RunUnknowns) -> Float[np.ndarray, " runs"]:
        return squares_of_runs(problem, evaluate(problem, unknowns._replace(runs=runs)))

    best, each = np.argmin(map_in_threads(squares, tried), axis=0), np.arange(problem.tape.runs)
    runs = jax.tree.map(lambda *values: jnp.stack(values)[best, each], *tried)
    return unknowns._replace(runs=runs)


def squares_of_runs(problem: Problem, evaluation: Evaluation) -> Float[np.ndarray, " runs"]:
    """Sum of squared residuals of each run; infinite where its simulation fails."""
    with np.errstate(over="ignore", invalid="ignore"):
        of_block = np.square(np.asarray(evaluation.residuals)).sum((1, 2))
    sound = np.nan_to_num(of_block, nan=np.inf)
    return np.bincount(np.asarray(problem.tape.run), sound, problem.tape.runs)


def squares_of_outputs(problem: Problem, evaluation: Evaluation) -> Float[np.ndarray, "2"]:
    """Sum of squared residuals of each output in the training runs."""
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        return np.square(np.asarray(evaluation.residuals)[problem.fitted_blocks]).sum((0, 2))


def fit_run_unknowns(
    problem: Problem, unknowns: Unknowns, passes: int = 4
) -> tuple[Unknowns, Evaluation]:
    """Fit only what belongs to each run: its initial state, and its load where that is unknown.

    A step that makes a run worse, because the teeth of a gear meet at another time for example, is shortened for that
    run.
    """
    fixed = eqx.tree_at(lambda p: p.free, problem, jnp.zeros_like(problem.free))
    run = np.asarray(problem.tape.run)
    everyone, share = jnp.ones(problem.tape.runs, bool), np.ones(problem.tape.runs)

    unknowns = best_initial_angle(fixed, best_backlash_start(fixed, unknowns, unknowns.runs))
    best, ridge = evaluate(fixed, unknowns), ridge_of(problem)
    for _ in range(passes):
        matrix = np.asarray(normal_matrix(best, fixed.tape, everyone))
        flat, gain = gauss_newton_step(matrix, set(), ridge)
        if gain < TOLERANCE * matrix[-1, -1] / problem.most_samples:
            break
        step = unflatten(problem, jnp.asarray(flat)).runs
        changes = zip(unknowns.runs, step, strict=True)
        trial = RunUnknowns(*(x + share * change for x, change in changes))
        reached = evaluate(fixed, unknowns._replace(runs=trial))
        # false where the trial cannot be simulated
        better = squares_of_runs(problem, reached) <= squares_of_runs(problem, best)
        share = np.where(better, 1.0, share / 4)
        unknowns = unknowns._replace(runs=_select_runs(jnp.asarray(better), trial, unknowns.runs))
        best = select_blocks(jnp.asarray(better[run]), reached, best)
    return unknowns, best


def with_holdout_unknowns(problem: Problem, fit: Fit) -> Fit:
    """The fit with the own unknowns of the hold-out runs fitted too, if the load of any of them is unknown."""
    if not np.any(~np.asarray(problem.fitted_runs) & np.asarray(problem.tape.load_unknown)):
        return fit
    unknowns, evaluation = fit_run_unknowns(problem, fit.unknowns)
    runs = _select_runs(problem.fitted_runs, fit.unknowns.runs, unknowns.runs)
    optimum = fit.optimum._replace(unknowns=unknowns._replace(runs=runs))
    weighted = scaled(evaluation, np.asarray(problem.noise) / fit.noise)
    fitted = jnp.asarray(problem.fitted_blocks)
    return fit._replace(optimum=optimum, evaluation=select_blocks(fitted, fit.evaluation, weighted))


def _select_runs(chosen: Bool[Array, " runs"], one: RunUnknowns, other: RunUnknowns) -> RunUnknowns:
    """The unknowns of `one` for the chosen runs, those of `other` for the rest."""
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), one, other)


def select_blocks(blocks: Bool[Array, " blocks"], one: Evaluation, other: Evaluation) -> Evaluation:
    """`one` in the chosen blocks, `other` in the rest."""
    return jax.tree.map(jax.vmap(jnp.where), *(Evaluation(*3 * [blocks]), one, other))


def ridge_of(problem: Problem) -> Float[np.ndarray, " unknowns"]:
    """The curvature added to each unknown in a step: the coordinates, then the own unknowns of run after run."""
    rms = problem.measured_rms
    own = np.zeros((problem.tape.runs, UNKNOWNS_PER_RUN))
    own[:, :2] = np.where(rms > 0, 1 / np.where(rms > 0, rms, 1.0) ** 2, 0.0)
    return np.concatenate([np.full(len(problem.free), RIDGE), own.ravel()])


def gauss_newton_step(
    matrix: np.ndarray, held: set[int], ridge: Float[np.ndarray, " unknowns"]
) -> tuple[np.ndarray, float]:
    """The Gauss-Newton step, and the reduction of the sum of squares that it predicts.

    **Arguments**: `matrix`, as from `normal_matrix`; `held`, which unknowns stay fixed; `ridge`, as from `ridge_of`.
    """
    gradient, hessian = matrix[:-1, -1].copy(), matrix[:-1, :-1].copy()
    if not np.all(np.isfinite(matrix)):
        return np.zeros(len(gradient)), np.inf
    for k in held:
        gradient[k] = hessian[k, :] = hessian[:, k] = 0.0
    hessian[np.diag_indices_from(hessian)] += ridge
    lengths = np.sqrt(np.diag(hessian))
    moves = lengths > 0
    lengths = np.where(moves, lengths, 1.0)
    values, vectors = np.linalg.eigh(hessian / lengths[:, None] / lengths)
    along = vectors.T @ (gradient / lengths)
    visible = values > 1e-12 * values.max(initial=1e-300)
    along = np.where(visible, along, 0.0)
    shrunk = along / np.where(visible, values, 1.0)
    # an unknown that no residual depends on must not drift by rounding errors
    return -(vectors @ shrunk) / lengths * moves, float(along @ shrunk)


def residual_noise(
    problem: Problem, squares: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Standard deviation of the residuals of each output, and the old scale over the new; whitened ones keep theirs.

    It is at least `MIN_RELATIVE_NOISE` times the root mean square of the measurement: without noise, the likelihood is
    greatest where one output is met exactly, whatever becomes of the other.
    """
    if problem.whitening is not None:
        return np.asarray(problem.noise), np.ones(2)
    noise = np.asarray(problem.noise)
    ratio = np.sqrt(squares / np.maximum(problem.samples, 1.0))
    ratio = np.maximum(ratio, MIN_RELATIVE_NOISE * problem.measured_rms / noise)
    ratio = np.where(ratio == 0, 1.0, ratio)
    return noise * ratio, 1 / ratio
