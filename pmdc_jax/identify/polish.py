"""Gauss-Newton to the bottom of an optimum, each output weighed by what its own residuals turn out to be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..simulate import RunUnknowns
from ..threads import side_by_side
from .noise import FLOOR
from .parameters import Parameters
from .problem import (
    Evaluation,
    Problem,
    Unknowns,
    evaluate,
    flatten,
    normal_matrix,
    unflatten,
    weighed,
)
from .refine import Optimum

# Steps after which a fall of the cost by no more than so much ends the polish: dry elements leave kinks where a
# straight line foretells more than there is to gain
PATIENCE, IDLE = 5, 1e-5
# Gauss-Newton steps of the polish, and the fall of the sum of squares, in noise variances, below which a step is
# not worth it: the square of 0.03 standard errors.
POLISH = 20
WORTH = 1e-3
# ... and that a step may foretell where none is found that lowers it, at the kinks of dry elements: of 0.3 errors
AT_KINK = 0.1
# By which shares of the play of its teeth a run is tried to begin twisted, from where its load presses them to
BACKLASH_STARTS = np.linspace(-1.0, 1.0, 9)
# At how many angles of the period of a torque a rotor is tried to begin, and at most
ANGLES, MOST_ANGLES = 8, 32
# Curvature added to every coordinate in a step, as if each were known to within a factor of e beforehand:
# nothing to one that the data see, and it keeps one that they do not see where it is.
RIDGE = 1.0


class Fit(NamedTuple):
    """A motor fitted to the runs: where that ended, what is simulated there, and the noise as the residuals show it."""

    optimum: Optimum
    evaluation: Evaluation
    noise: Float[np.ndarray, "2"]  # standard deviations of current A and speed rad/s

    @property
    def unknowns(self) -> Unknowns:
        """Where it ended."""
        return self.optimum.unknowns

    @property
    def coordinates(self) -> Float[Array, " parameters"]:
        """The search coordinates where it ended."""
        return self.optimum.unknowns.coordinates

    @property
    def fitness(self) -> float:
        """What it leaves, in noise variances; infinite where nothing can be simulated."""
        return self.optimum.fitness

    @property
    def at_bound(self) -> tuple[int, ...]:
        """The coordinates that are held at a bound."""
        return self.optimum.at_bound


def polish(
    problem: Problem,
    end: Optimum,
    steps: int = POLISH,
    worth: float = WORTH,
    known: Evaluation | None = None,
) -> Fit:
    """Gauss-Newton to the bottom, while each output is weighed by what its own residuals turn out to be.

    The claim of convergence is the gradient's: no step within the bounds would lower the sum of squares by
    more than what a step is `worth`, in noise variances (`AT_KINK`, where no step is found that does). A coordinate
    held at a bound is let go where the gradient points back inside. The evaluation at the start may be `known`.
    """
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    trial, held, share = end.unknowns, set(end.at_bound), 1.0
    best, converged = _weighed(problem, trial, known), False
    reached, step, gain = best, np.zeros(len(flatten(trial))), np.inf
    costs = [best.cost]
    for _ in range(steps):
        if len(costs) > PATIENCE and costs[-1 - PATIENCE] - costs[-1] < IDLE:
            break
        if not np.isfinite(best.cost):
            break  # what cannot be simulated has no slope to follow
        if reached.cost > best.cost + 1e-9 and share > 1e-3:
            share /= 4  # the last step was too long
        elif reached.cost <= best.cost + 1e-9:
            best, share = reached, 1.0
            start = np.asarray(best.unknowns.coordinates)
            held = {k for k in held if (best.matrix[k, -1] > 0) == (start[k] <= low[k])}
            step, gain = gauss_newton_step(best.matrix, held, len(low))
            if converged := gain <= worth * _variance(problem, best):
                break
        else:
            break
        moved = np.asarray(flatten(best.unknowns)) + _damped_log_step(
            problem.parameters, share * step
        )
        inside = np.clip(moved[: len(low)], low, high)
        held |= set(np.flatnonzero(inside != moved[: len(low)]).tolist())
        moved[: len(low)] = inside
        reached = _weighed(problem, unflatten(problem, jnp.asarray(moved)))
        costs.append(min(reached.cost, best.cost))
    converged = converged or gain <= AT_KINK * _variance(problem, best)
    optimum = Optimum(best.unknowns, best.fitness, tuple(sorted(held)), bool(converged))
    return Fit(optimum, best.evaluation, best.noise)


def _damped_log_step(parameters: Parameters, step: np.ndarray) -> np.ndarray:
    """A step along which a positive parameter rises on a straight line, and not as an exponential: what is nearly zero,
    as friction that something else hid, would rise to infinity."""
    rises = np.zeros(len(step), bool)
    rises[: len(parameters.names)] = parameters.logarithmic
    return np.where(rises & (step > 0), np.log1p(np.maximum(step, 0.0)), step)


class _Weighed(NamedTuple):
    """A point, evaluated, each output weighed by its own residuals."""

    unknowns: Unknowns
    evaluation: Evaluation
    noise: np.ndarray
    matrix: np.ndarray
    # sum of the logarithms of the noise, which the maximum of the likelihood makes least; of white residuals that of
    # their squares
    cost: float
    fitness: float


def _variance(problem: Problem, best: _Weighed) -> float:
    """Mean square of the weighed residuals; at least the noise that they are weighed by, of which a simulation without
    any leaves next to nothing."""
    mean = best.matrix[-1, -1] / problem.most_samples
    return mean if problem.whitening is not None else max(mean, 1.0)


def reweighted(problem: Problem, fit: Fit) -> Evaluation:
    """The evaluation at a fit to plain residuals, as a problem with another noise weighs it."""
    return weighed(problem, _scaled(fit.evaluation, fit.noise / np.asarray(problem.noise)))


def _weighed(problem: Problem, unknowns: Unknowns, known: Evaluation | None = None) -> _Weighed:
    evaluation = evaluate(problem, unknowns) if known is None else known
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        squares = np.square(np.asarray(evaluation.residuals)[problem.fitted_blocks]).sum((0, 2))
        noise, stretch = _own_noise(problem, squares)
        scaled = _scaled(evaluation, stretch)
        matrix = np.array(normal_matrix(scaled, problem.tape, problem.fitted_runs))
        if problem.whitening is not None:
            cost = float(np.log(np.maximum(squares.sum(), 1e-300)))
        else:
            over = squares * stretch**2 / np.maximum(problem.samples, 1.0)
            cost = float(np.log(np.maximum(noise, 1e-300)).sum() + over.sum() / 2)
    fitness = float(squares.sum()) / problem.most_samples
    # what cannot be simulated is infinitely bad
    cost, fitness = (x if np.isfinite(x) else np.inf for x in (cost, fitness))
    return _Weighed(unknowns, scaled, noise, matrix, cost, fitness)


def best_backlash_start(problem: Problem, unknowns: Unknowns, begun: RunUnknowns) -> Unknowns:
    """Every run's own unknowns as they are, or as they had `begun` with the teeth of its gear elsewhere in their play,
    whichever fits best.

    No slope leads there: when teeth first meet changes all that follows, and a run that begins at rest may be fitted as
    well as it goes by a speed that it never had.
    """
    motor = problem.parameters(unknowns.coordinates)
    play = sum(float(effect.play()) for effect in motor.effects)
    middle = jnp.zeros_like(begun.twist)
    trials = [begun._replace(twist=middle + share * play) for share in BACKLASH_STARTS if play]
    return _whichever_fits(problem, unknowns, trials)


def best_initial_angle(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """The own unknowns of runs that do not count as they are, or with the rotor at another angle as they began,
    whichever fits best; of several waves, first within the longest period, then by whole periods of each.

    From half a period away slopes lead to another optimum, or nowhere.
    """
    waves = [e.repeats_after() for e in problem.parameters(unknowns.coordinates).effects]
    periods = [float(wave["angle"]) for wave in waves if "angle" in wave]
    turnable = np.asarray(problem.turnable & ~jnp.asarray(problem.fitted_runs))
    if not periods or not turnable.any():
        return unknowns
    count = min(round(ANGLES * max(periods) / min(periods)), MOST_ANGLES)
    turns = [np.arange(1, count) / count * max(periods)]
    if len(periods) > 1:
        turns += [np.arange(1, round(2 * np.pi / period)) * period for period in periods]
    for some in turns:
        begun = unknowns.runs
        trials = [begun._replace(angle=begun.angle + turn * turnable) for turn in some]
        unknowns = _whichever_fits(problem, unknowns, trials)
    return unknowns


def _whichever_fits(
    problem: Problem, unknowns: Unknowns, trials: Sequence[RunUnknowns]
) -> Unknowns:
    """Every run's own unknowns as they are, or those of the trial that fits it best."""
    if not trials:
        return unknowns
    tried = [unknowns.runs, *trials]

    def squares(runs: RunUnknowns) -> Float[np.ndarray, " runs"]:
        return _squares_of_runs(problem, evaluate(problem, unknowns._replace(runs=runs)))

    best, each = np.argmin(side_by_side(squares, tried), axis=0), np.arange(problem.tape.runs)
    runs = jax.tree.map(lambda *values: jnp.stack(values)[best, each], *tried)
    return unknowns._replace(runs=runs)


def _squares_of_runs(problem: Problem, evaluation: Evaluation) -> Float[np.ndarray, " runs"]:
    """What each run leaves; infinitely much where it cannot be simulated."""
    with np.errstate(over="ignore", invalid="ignore"):
        of_block = np.square(np.asarray(evaluation.residuals)).sum((1, 2))
    sound = np.nan_to_num(of_block, nan=np.inf)
    return np.bincount(np.asarray(problem.tape.run), sound, problem.tape.runs)


def fit_run_unknowns(
    problem: Problem, unknowns: Unknowns, passes: int = 4
) -> tuple[Unknowns, Evaluation]:
    """Fit only what belongs to each run: its initial state, and its load where nobody knows it.

    A step that makes a run worse, as where teeth of a gear meet at another time, is taken shorter for that run.
    """
    still = eqx.tree_at(lambda p: p.free, problem, jnp.zeros_like(problem.free))
    run = np.asarray(problem.tape.run)
    everyone, share = jnp.ones(problem.tape.runs, bool), np.ones(problem.tape.runs)

    unknowns = best_initial_angle(still, best_backlash_start(still, unknowns, unknowns.runs))
    best = evaluate(still, unknowns)
    for _ in range(passes):
        matrix = np.asarray(normal_matrix(best, still.tape, everyone))
        flat, gain = gauss_newton_step(matrix, set(), 0)
        if gain < WORTH * matrix[-1, -1] / problem.most_samples:
            break
        step = unflatten(problem, jnp.asarray(flat)).runs
        changes = zip(unknowns.runs, step, strict=True)
        trial = RunUnknowns(*(x + share * change for x, change in changes))
        reached = evaluate(still, unknowns._replace(runs=trial))
        # not where it cannot be simulated
        better = _squares_of_runs(problem, reached) <= _squares_of_runs(problem, best)
        share = np.where(better, 1.0, share / 4)
        unknowns = unknowns._replace(runs=_select_runs(jnp.asarray(better), trial, unknowns.runs))
        best = _select_blocks(jnp.asarray(better[run]), reached, best)
    return unknowns, best


def with_holdout_unknowns(problem: Problem, fit: Fit) -> Fit:
    """A fit in which runs that do not count have found what belongs to each of them, too, where nobody knows a load."""
    if not np.any(~np.asarray(problem.fitted_runs) & np.asarray(problem.tape.load_unknown)):
        return fit
    unknowns, evaluation = fit_run_unknowns(problem, fit.unknowns)
    runs = _select_runs(problem.fitted_runs, fit.unknowns.runs, unknowns.runs)
    optimum = fit.optimum._replace(unknowns=unknowns._replace(runs=runs))
    scaled = _scaled(evaluation, np.asarray(problem.noise) / fit.noise)
    return Fit(
        optimum,
        _select_blocks(jnp.asarray(problem.fitted_blocks), fit.evaluation, scaled),
        fit.noise,
    )


def _scaled(evaluation: Evaluation, stretch: Float[np.ndarray, "2"]) -> Evaluation:
    """Residuals and derivatives over another noise."""
    return evaluation._replace(
        residuals=evaluation.residuals * stretch[:, None],
        jacobian=evaluation.jacobian * stretch[:, None, None],
    )


def _select_runs(chosen: Bool[Array, " runs"], one: RunUnknowns, other: RunUnknowns) -> RunUnknowns:
    """What belongs to some runs from the one, and what belongs to the others from the other."""
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), one, other)


def _select_blocks(
    blocks: Bool[Array, " blocks"], one: Evaluation, other: Evaluation
) -> Evaluation:
    """One evaluation in some blocks, another one in the others."""
    return jax.tree.map(jax.vmap(jnp.where), *(Evaluation(*3 * [blocks]), one, other))


def gauss_newton_step(matrix: np.ndarray, held: set[int], count: int) -> tuple[np.ndarray, float]:
    """The step that lowers the sum of squares most, and by how much.

    **Arguments**: `matrix`, as from `normal_matrix`; `held`, which of the `count` coordinates stay.
    """
    gradient, hessian = matrix[:-1, -1].copy(), matrix[:-1, :-1].copy()
    if not np.all(np.isfinite(matrix)):
        return np.zeros(len(gradient)), np.inf
    for k in held:
        gradient[k] = hessian[k, :] = hessian[:, k] = 0.0
    hessian[np.arange(count), np.arange(count)] += RIDGE
    lengths = np.sqrt(np.diag(hessian))
    moves = lengths > 0
    lengths = np.where(moves, lengths, 1.0)
    values, vectors = np.linalg.eigh(hessian / lengths[:, None] / lengths)
    along = vectors.T @ (gradient / lengths)
    visible = values > 1e-12 * values.max(initial=1e-300)
    along = np.where(visible, along, 0.0)
    shrunk = along / np.where(visible, values, 1.0)
    # rounding errors would carry away what no residual depends on
    return -(vectors @ shrunk) / lengths * moves, float(along @ shrunk)


def _own_noise(
    problem: Problem, squares: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Standard deviation of the residuals of each output, and the old scale over the new; white ones keep theirs.

    At least the share `FLOOR` of what is measured: where there is no noise, the likelihood is greatest if one output
    is met exactly, whatever becomes of the other.
    """
    if problem.whitening is not None:
        return np.asarray(problem.noise), np.ones(2)
    noise = np.asarray(problem.noise)
    ratio = np.sqrt(squares / np.maximum(problem.samples, 1.0))
    ratio = np.maximum(ratio, FLOOR * problem.sizes / noise)
    ratio = np.where(ratio == 0, 1.0, ratio)
    return noise * ratio, 1 / ratio
