"""Refinement by Levenberg-Marquardt on forward sensitivities."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..simulate import LOCAL, Tape, sensitivities
from .noise import FLOOR
from .parameters import Parameters
from .whitening import Whitening

STEPS = 60


class Unknowns(NamedTuple):
    """What a refinement moves: search coordinates, and what each run does not tell."""

    coordinates: Float[Array, " parameters"]
    # initial current A and speed rad/s, load offset N m, initial angle rad and twist rad
    local: Float[Array, "runs 5"]


def apart(local: Float[Array, "runs 5"]) -> tuple[Array, Array, Array, Array]:
    """The runs' own unknowns as a simulation takes them."""
    return local[:, :2], local[:, 2], local[:, 3], local[:, 4]


class Refined(NamedTuple):
    """Where a refinement ended."""

    unknowns: Unknowns
    fitness: float  # sum over both outputs of the mean square residual over the noise variance
    at_bound: tuple[int, ...]  # which coordinates were held at a bound
    converged: bool  # by the gradient, not by the solver's word


class Problem(eqx.Module):
    """A least-squares problem: runs on tape, the noise to scale by, what may move and which runs count.

    Runs that do not count (hold-outs) are simulated all the same, and their own unknowns can be fitted.
    """

    parameters: Parameters
    tape: Tape
    noise: Float[Array, "2"]  # standard deviations of current A and speed rad/s
    free: Bool[Array, " parameters"]
    counts: Bool[Array, " runs"]
    whitening: Whitening | None = None  # in place of the noise, where residuals are correlated

    @property
    def outputs(self) -> int:
        """How many outputs the runs that count have measured."""
        return int(np.count_nonzero(np.asarray(self.tape.weight)[self.counted].any((0, 2))))

    @property
    def counted(self) -> Bool[np.ndarray, " blocks"]:
        """Which blocks are of runs that count."""
        return np.asarray(self.counts)[np.asarray(self.tape.run)]

    @property
    def samples(self) -> Float[np.ndarray, "2"]:
        """How many samples of each output count."""
        return np.asarray(self.tape.weight)[self.counted].sum((0, 2))

    @property
    def sizes(self) -> Float[np.ndarray, "2"]:
        """Root mean square of each output as measured in the runs that count; zero where it was not."""
        squares = np.square(np.asarray(self.tape.measured)[self.counted]).sum((0, 2))
        return np.sqrt(squares / np.maximum(self.samples, 1.0))

    @property
    def angular(self) -> bool:
        """Whether a torque depends on the rotor's angle."""
        return any("angle" in effect.states for effect in self.parameters.effects)

    @property
    def winds(self) -> bool:
        """Whether a spring may be wound up as a run begins."""
        return any(effect.winds for effect in self.parameters.effects)

    @property
    def turnable(self) -> Bool[Array, " runs"]:
        """Which runs may begin at any angle."""
        known = jnp.asarray(self.tape.angle_known)
        # where nobody knows an angle, that of the first run is the zero from which phases count
        zero = ~jnp.any(known) & (jnp.arange(self.tape.runs) == 0)
        return ~known & ~zero

    def moves(self) -> Bool[Array, "runs columns"]:
        """Which coordinates and which of its own unknowns each run may tell of."""
        tape = self.tape
        first = jnp.argmax(jnp.asarray(tape.run)[None, :] == jnp.arange(tape.runs)[:, None], axis=1)
        drive = jax.tree.map(lambda share: jnp.asarray(share)[tape.grid][first] > 0, tape.drive)
        angle = self.turnable & self.angular
        load = jnp.asarray(tape.load_unknown)
        twist = self.winds & drive.free
        own = jnp.stack([drive.voltage, drive.free, load, angle, twist], 1)
        return jnp.concatenate([self.free[None, :] & self.counts[:, None], own], 1)


class Evaluation(NamedTuple):
    """A free run, its residuals over the noise, and their derivatives.

    Columns: the coordinates, then the run's own unknowns.
    """

    seen: Float[Array, "blocks 2 samples"]
    residuals: Float[Array, "blocks 2 samples"]
    jacobian: Float[Array, "blocks 2 samples columns"]


def evaluate(problem: Problem, unknowns: Unknowns) -> Evaluation:
    """Simulate every run of the problem and compare."""
    # Levenberg-Marquardt traces under an empty mesh; under no mesh at all everything would be traced once more
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        # whitened apart, for the simulation takes long to compile
        plain = _evaluate(replace(problem, whitening=None), unknowns)
        return plain if problem.whitening is None else _whitened(problem, plain)


@eqx.filter_jit
def _evaluate(problem: Problem, unknowns: Unknowns) -> Evaluation:
    tape, local = problem.tape, unknowns.local
    seen, jacobian = sensitivities(problem.parameters, unknowns.coordinates, tape, *apart(local))
    scale = tape.weight / problem.noise[:, None]
    jacobian = jacobian * scale[..., None] * problem.moves()[tape.run][:, None, None, :]
    return Evaluation(seen, (seen - tape.measured) * scale, jacobian)


@eqx.filter_jit
def _whitened(problem: Problem, plain: Evaluation) -> Evaluation:
    both = jnp.concatenate([plain.jacobian, plain.residuals[..., None]], -1)
    assert problem.whitening is not None
    both = problem.whitening(both * problem.noise[:, None, None], problem.tape.run)
    return Evaluation(plain.seen, both[..., -1], both[..., :-1])


@eqx.filter_jit
def normal_matrix(
    evaluation: Evaluation, tape: Tape, counts: Bool[Array, " runs"] | np.ndarray
) -> Float[Array, "unknowns unknowns"]:
    """[J r]' [J r] over all unknowns: coordinates, then the locals run by run, then the residual."""
    _, r, jacobian = evaluation
    both = jnp.concatenate([jacobian, r[..., None]], -1)
    of_block = jnp.einsum("bcsi,bcsj->bij", both, both)
    of_run = jax.ops.segment_sum(of_block, tape.run, tape.runs) * counts[:, None, None]
    index = _columns(jacobian.shape[-1] - LOCAL, tape.runs)
    size = index.max() + 1
    return jnp.zeros((size, size)).at[index[:, :, None], index[:, None, :]].add(of_run)


def _columns(count: int, runs: int) -> np.ndarray:
    """Where each run's columns lie among all unknowns and the residual."""
    own = count + LOCAL * np.arange(runs)[:, None] + np.arange(LOCAL)
    shared = np.broadcast_to(np.arange(count), (runs, count))
    return np.concatenate([shared, own, np.full((runs, 1), count + LOCAL * runs)], 1)


# Levenberg-Marquardt needs of the residuals r and their Jacobian J no more than J'J, J'r and r'r. So it is given
# the smallest residual vector with the same ones, as long as there are unknowns instead of samples.
@eqx.filter_custom_jvp
def compressed(flat: Float[Array, " columns"], args) -> Float[Array, " columns+1"]:
    return _factor(flat, args)[:, -1]


@compressed.def_jvp
def _compressed_jvp(primals, tangents):
    flat, args = primals
    factor = _factor(flat, args)
    direction = tangents[0]
    change = jnp.zeros_like(factor[:, -1]) if direction is None else factor[:, :-1] @ direction
    return factor[:, -1], change


def _factor(flat: Float[Array, " columns"], args) -> Float[Array, "columns+1 columns+1"]:
    problem, begun, scale, size = args
    # optimistix promotes strictly; with the usual promotion what was traced before is found again
    with jax.numpy_dtype_promotion("standard"):
        evaluation = evaluate(problem, _unscaled(problem, flat, begun, scale))
        matrix = normal_matrix(evaluation, problem.tape, problem.counts)
    stretch = jnp.append(scale, 1.0)
    matrix = matrix * stretch[:, None] * stretch / size
    # a failed simulation must look bad, not equal to nothing
    bad = ~jnp.all(jnp.isfinite(matrix))
    matrix = jnp.where(bad, jnp.zeros_like(matrix).at[-1, -1].set(1e12), matrix)
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.sqrt(jnp.maximum(values, 0.0))[:, None] * vectors.T


def _unflatten(problem: Problem, flat: Float[Array, " columns"]) -> Unknowns:
    count = len(problem.free)
    return Unknowns(flat[:count], flat[count:].reshape(problem.tape.runs, LOCAL))


def _unscaled(problem: Problem, flat, begun, scale) -> Unknowns:
    """Unknowns of which those without a scale stay where they began: rounding errors would carry them away."""
    return _unflatten(problem, jnp.where(scale > 0, flat * scale, begun))


def _flatten(unknowns: Unknowns) -> Float[Array, " columns"]:
    return jnp.concatenate([unknowns.coordinates, unknowns.local.reshape(-1)])


@eqx.filter_jit
def _levenberg_marquardt(problem: Problem, start: Unknowns, scale, size, tolerance):
    begun = _flatten(start)
    solution = optx.least_squares(
        compressed,
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance),
        jnp.where(scale > 0, begun / jnp.where(scale > 0, scale, 1.0), 0.0),
        args=(problem, begun, scale, size),
        max_steps=STEPS,
        throw=False,
    )
    ended = _unscaled(problem, solution.value, begun, scale)
    return ended, 2 * solution.state.f_info.as_min() * size


def refine(problem: Problem, start: Unknowns, tolerance: float = 1e-3) -> Refined:
    """Levenberg-Marquardt from a start, within the bounds.

    optimistix has no bounds, so they are an active set: a coordinate that ends beyond its bound is held there
    and the others are refined again.
    """
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    matrix = np.asarray(normal_matrix(evaluate(problem, start), problem.tape, problem.counts))
    size = max(matrix[-1, -1], 1e-30)
    # each run's own unknowns are measured in what changes the residual as much as e-fold in a parameter might
    lengths = np.sqrt(np.diag(matrix)[:-1] / size)
    scale = np.where(lengths > 0, 1 / np.where(lengths > 0, lengths, 1.0), 0.0)
    scale[: len(low)] = 1.0
    held, unknowns, squares = {}, start, size
    for _ in range(len(low) + 1):
        now = eqx.tree_at(lambda p: p.free, problem, _without(problem.free, held))
        unknowns, squares = _levenberg_marquardt(
            now, unknowns, jnp.asarray(scale), jnp.asarray(size), jnp.asarray(tolerance)
        )
        coordinates = np.array(unknowns.coordinates)
        beyond = {int(k): low[k] for k in np.flatnonzero(coordinates < low)}
        beyond |= {int(k): high[k] for k in np.flatnonzero(coordinates > high)}
        held |= beyond
        coordinates[list(held)] = list(held.values())
        unknowns = unknowns._replace(coordinates=jnp.asarray(coordinates))
        if not beyond:
            break
    return Refined(unknowns, float(squares) / _samples(problem), tuple(sorted(held)), False)


class Polished(NamedTuple):
    """The end of the line: where, what is simulated there, and the noise as the residuals show it."""

    refined: Refined
    evaluation: Evaluation
    noise: np.ndarray


# Steps after which a fall of the cost by no more than so much ends the polish: dry elements leave kinks where a
# straight line foretells more than there is to gain
PATIENCE, IDLE = 5, 1e-5
# Gauss-Newton steps of the polish, and the fall of the sum of squares, in noise variances, below which a step is
# not worth it: the square of 0.03 standard errors.
POLISH = 20
WORTH = 1e-3
# ... and that a step may foretell where none is found that lowers it, at the kinks of dry elements: of 0.3 errors
AT_KINK = 0.1


def polish(problem: Problem, end: Refined, steps: int = POLISH) -> Polished:
    """Gauss-Newton to the bottom, while each output is weighed by what its own residuals turn out to be.

    The claim of convergence is the gradient's: no step within the bounds would lower the sum of squares by
    more than `WORTH` noise variances (`AT_KINK`, where no step is found that does). A coordinate held at a bound is
    let go where the gradient points back inside.
    """
    low, high = np.asarray(problem.parameters.lower), np.asarray(problem.parameters.upper)
    trial, held, share = end.unknowns, set(end.at_bound), 1.0
    best, converged = _weighed(problem, trial), False
    reached, step, gain = best, np.zeros(len(_flatten(trial))), np.inf
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
            step, gain = gauss_newton(best.matrix, held, len(low))
            if converged := gain <= WORTH * best.matrix[-1, -1] / _samples(problem):
                break
        else:
            break
        moved = np.asarray(_flatten(best.unknowns)) + _straight(problem.parameters, share * step)
        inside = np.clip(moved[: len(low)], low, high)
        held |= set(np.flatnonzero(inside != moved[: len(low)]).tolist())
        moved[: len(low)] = inside
        reached = _weighed(problem, _unflatten(problem, jnp.asarray(moved)))
        costs.append(min(reached.cost, best.cost))
    converged = converged or gain <= AT_KINK * best.matrix[-1, -1] / _samples(problem)
    refined = Refined(best.unknowns, best.fitness, tuple(sorted(held)), bool(converged))
    return Polished(refined, best.evaluation, best.noise)


def _straight(parameters: Parameters, step: np.ndarray) -> np.ndarray:
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


def _weighed(problem: Problem, unknowns: Unknowns) -> _Weighed:
    evaluation = evaluate(problem, unknowns)
    with np.errstate(over="ignore", invalid="ignore"):  # a step too far may be infinitely bad
        squares = np.square(np.asarray(evaluation.residuals)[problem.counted]).sum((0, 2))
        noise, stretch = _own_noise(problem, squares)
    scaled = _scaled(evaluation, stretch)
    matrix = np.array(normal_matrix(scaled, problem.tape, problem.counts))
    if problem.whitening is not None:
        cost = float(np.log(np.maximum(squares.sum(), 1e-300)))
    else:
        over = squares * stretch**2 / np.maximum(problem.samples, 1.0)
        cost = float(np.log(np.maximum(noise, 1e-300)).sum() + over.sum() / 2)
    cost = cost if np.isfinite(cost) else np.inf
    return _Weighed(unknowns, scaled, noise, matrix, cost, float(squares.sum()) / _samples(problem))


def fit_own(problem: Problem, unknowns: Unknowns, passes: int = 4) -> tuple[Unknowns, Evaluation]:
    """Fit only what belongs to each run: its initial state, and its load where nobody knows it.

    A step that makes a run worse, as where teeth of a gear meet at another time, is taken shorter for that run.
    """
    still = eqx.tree_at(lambda p: p.free, problem, jnp.zeros_like(problem.free))
    run = np.asarray(problem.tape.run)
    everyone, share = jnp.ones(problem.tape.runs, bool), np.ones(problem.tape.runs)

    def squares_of_runs(evaluation: Evaluation) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            of_block = np.square(np.asarray(evaluation.residuals)).sum((1, 2))
        return np.bincount(run, of_block, problem.tape.runs)

    best = evaluate(still, unknowns)
    for _ in range(passes):
        matrix = np.asarray(normal_matrix(best, still.tape, everyone))
        flat, gain = gauss_newton(matrix, set(), 0)
        if gain < WORTH * matrix[-1, -1] / _samples(problem):
            break
        step = _unflatten(problem, jnp.asarray(flat)).local
        trial = unknowns._replace(local=unknowns.local + share[:, None] * step)
        reached = evaluate(still, trial)
        # not where it cannot be simulated
        better = squares_of_runs(reached) <= squares_of_runs(best)
        share = np.where(better, 1.0, share / 4)
        local = jnp.where(better[:, None], trial.local, unknowns.local)
        unknowns = unknowns._replace(local=local)
        best = _taken(jnp.asarray(better[run]), reached, best)
    return unknowns, best


def with_own(problem: Problem, fit: Polished) -> Polished:
    """A fit in which runs that do not count have found what belongs to each of them, too, where nobody knows a load."""
    if not np.any(~np.asarray(problem.counts) & np.asarray(problem.tape.load_unknown)):
        return fit
    unknowns, evaluation = fit_own(problem, fit.refined.unknowns)
    counts = jnp.asarray(problem.counts)
    local = jnp.where(counts[:, None], fit.refined.unknowns.local, unknowns.local)
    refined = fit.refined._replace(unknowns=unknowns._replace(local=local))
    scaled = _scaled(evaluation, np.asarray(problem.noise) / fit.noise)
    return Polished(
        refined, _taken(jnp.asarray(problem.counted), fit.evaluation, scaled), fit.noise
    )


def _scaled(evaluation: Evaluation, stretch: Float[np.ndarray, "2"]) -> Evaluation:
    """Residuals and derivatives over another noise."""
    return evaluation._replace(
        residuals=evaluation.residuals * stretch[:, None],
        jacobian=evaluation.jacobian * stretch[:, None, None],
    )


def _taken(blocks: Bool[Array, " blocks"], one: Evaluation, other: Evaluation) -> Evaluation:
    """One evaluation in some blocks, another one in the others."""
    return jax.tree.map(jax.vmap(jnp.where), *(Evaluation(*3 * [blocks]), one, other))


# Curvature added to every coordinate in a step, as if each were known to within a factor of e beforehand:
# nothing to one that the data see, and it keeps one that they do not see where it is.
RIDGE = 1.0


def gauss_newton(matrix: np.ndarray, held: set[int], count: int) -> tuple[np.ndarray, float]:
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


def _own_noise(problem: Problem, squares: np.ndarray):
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


def _samples(problem: Problem) -> float:
    return max(float(problem.samples.max()), 1.0)


def _without(free, held) -> Bool[Array, " parameters"]:
    return jnp.asarray([bool(f) and k not in held for k, f in enumerate(np.asarray(free))])
