"""Recordings as a least-squares problem: the unknowns, and the residuals with their derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..runtime.compiled import compiled, quickly_compiled
from ..runtime.threads import CORES, map_in_threads
from ..simulate import UNKNOWNS_PER_RUN, RunUnknowns, Tape, sensitivities
from .noise.whitening import Whitening
from .parameters import Parameters

# Derivative of an output by an unknown, in noise standard deviations, from which a simulation counts as failed: it is
# so sensitive that rounding errors make its derivatives meaningless
MAX_DERIVATIVE = 1e12


class Unknowns(NamedTuple):
    """The unknowns of a fit: the search coordinates, and what each run has of its own."""

    coordinates: Float[Array, " parameters"]
    runs: RunUnknowns


class Nuisance(eqx.Module):
    """Unknowns of each run that only need to be allowed for: what their responses can explain is projected out of the
    residuals."""

    responses: Float[Array, "blocks 2 samples nuisances"]  # of the outputs, A and rad/s
    # standard deviations of current A and speed rad/s, by which the two are weighed against each other
    noise: Float[Array | np.ndarray, "2"]


class Shift(eqx.Module):
    """How outputs at the samples of an uneven clock depend on the unknowns, beside those at the even samples to which
    they were shifted."""

    slope: Float[Array, "blocks 2 samples columns"]  # A and rad/s
    at: Unknowns  # where they were shifted


class Problem(eqx.Module):
    """A least-squares problem: runs on tape, the noise to scale by, the free coordinates and the runs to fit.

    Hold-out runs are simulated too, and their own unknowns can be fitted.
    """

    parameters: Parameters
    tape: Tape
    noise: Float[Array, "2"]  # standard deviations of current A and speed rad/s
    free: Bool[Array, " parameters"]
    fitted_runs: Bool[Array, " runs"]
    begins_warm: Bool[Array, " runs"]  # which runs may begin with a warm winding
    whitening: Whitening | None = None  # in place of the noise, where residuals are correlated
    nuisance: Nuisance | None = None
    shift: Shift | None = None

    @property
    def fitted_blocks(self) -> Bool[np.ndarray, " blocks"]:
        """Which blocks belong to training runs."""
        return np.asarray(self.fitted_runs)[np.asarray(self.tape.run)]

    @property
    def samples(self) -> Float[np.ndarray, "2"]:
        """Number of measured samples of each output in the training runs."""
        return np.asarray(self.tape.weight)[self.fitted_blocks].sum((0, 2))

    @property
    def most_samples(self) -> float:
        """Number of measured samples of the output that has more of them, at least one."""
        return max(float(self.samples.max()), 1.0)

    @property
    def perfect_fitness(self) -> float:
        """The fitness of a model that leaves nothing but noise: 2, or 1 with a single output."""
        return float(self.samples.sum()) / self.most_samples

    @property
    def measured_rms(self) -> Float[np.ndarray, "2"]:
        """Root mean square of each output as measured in the training runs; zero where it was not measured."""
        known = np.asarray(self.tape.measured) * np.asarray(self.tape.weight)
        squares = np.square(known[self.fitted_blocks]).sum((0, 2))
        return np.sqrt(squares / np.maximum(self.samples, 1.0))

    @property
    def depends_on_angle(self) -> bool:
        """Whether a torque depends on the rotor's angle."""
        return any("angle" in effect.states for effect in self.parameters.effects)

    @property
    def states(self) -> int:
        """Number of states of the motor."""
        return 2 + len({name for effect in self.parameters.effects for name in effect.states})

    @property
    def has_spring(self) -> bool:
        """Whether an effect has a spring, which may be wound up at the start of a run."""
        return any(effect.spring_state for effect in self.parameters.effects)

    @property
    def has_temperature(self) -> bool:
        """Whether an effect has a temperature, which may be higher at the start of a run."""
        return any(effect.thermal_state for effect in self.parameters.effects)

    @property
    def angle_unknown(self) -> Bool[Array, " runs"]:
        """Which runs have an unknown initial rotor angle."""
        tape, known = self.tape, jnp.asarray(self.tape.angle_known)
        # if no angle is known, that of the first run is the reference for the phases
        zero = ~jnp.any(known) & (jnp.arange(tape.runs) == 0)
        measured = jax.ops.segment_sum(jnp.sum(tape.weight, (1, 2)), tape.run, tape.runs) > 0
        return measured & ~known & ~zero

    def determinable(self) -> Bool[Array, "runs columns"]:
        """Which coordinates and which of its own unknowns each run can determine."""
        tape = self.tape
        first = jnp.argmax(jnp.asarray(tape.run)[None, :] == jnp.arange(tape.runs)[:, None], axis=1)
        drive = jax.tree.map(lambda share: share[first] > 0, tape.block_drive)
        angle = self.angle_unknown & self.depends_on_angle
        load = jnp.asarray(tape.load_unknown)
        twist = self.has_spring & drive.free
        rise = self.has_temperature & self.begins_warm & drive.voltage
        own = jnp.stack([drive.voltage, drive.free, load, angle, twist, rise], 1)
        return jnp.concatenate([self.free[None, :] & self.fitted_runs[:, None], own], 1)


class Evaluation(NamedTuple):
    """A free run; its residuals, simulated minus measured, over the noise of the problem (in a `Fit`, over that of the
    fit), less what the problem's nuisance parameters explain and whitened, if it has such; and their derivatives.

    Columns: the coordinates, then the run's own unknowns.
    """

    simulated: Float[Array, "blocks 2 samples"]
    residuals: Float[Array, "blocks 2 samples"]
    jacobian: Float[Array, "blocks 2 samples columns"]
    starts: Float[Array, "blocks states"]  # of the blocks of samples that are simulated in parallel
    d_starts: Float[Array, "blocks states columns"]


def scaled(evaluation: Evaluation, stretch: Float[Array | np.ndarray, "2"]) -> Evaluation:
    """Residuals and derivatives multiplied by a factor for each output."""
    return evaluation._replace(
        residuals=evaluation.residuals * stretch[:, None], jacobian=evaluation.jacobian * stretch[:, None, None]
    )


def select_blocks(blocks: Bool[Array, " blocks"], one: Evaluation, other: Evaluation) -> Evaluation:
    """`one` in the chosen blocks, `other` in the rest."""
    chosen = Evaluation(*len(Evaluation._fields) * [blocks])
    return jax.tree.map(jax.vmap(jnp.where), *(chosen, one, other))


def evaluate(
    problem: Problem, unknowns: Unknowns, starts: Float[np.ndarray, "blocks states"] | None = None
) -> Evaluation:
    """Simulate every run of the problem and compare it with the measurement.

    **Arguments**: `starts`, as from `predicted_starts`, where an evaluation nearby is known; they make it quicker.
    """
    # without all that is allowed for afterwards, so that the simulation, slow to compile, is compiled only once
    bare = replace(problem, whitening=None, nuisance=None, shift=None)
    if bare.parameters.effects:
        simulated = _evaluate_in_threads(bare, unknowns, starts)
    else:
        simulated = _evaluate_linear(bare, unknowns)
    return whitened(problem, _without_nuisance(problem, _at_shifted_samples(problem, unknowns, simulated)))


def predicted_starts(
    problem: Problem, evaluation: Evaluation, change: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, "blocks states"]:
    """Where the blocks start, to first order, after a change of the unknowns at which an evaluation was made."""
    return np.asarray(evaluation.starts) + np.einsum(
        "bsp,bp->bs", np.asarray(evaluation.d_starts), _by_blocks(problem, change)
    )


def _by_blocks(problem: Problem, flat: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, "blocks columns"]:
    """The coordinates, and the own unknowns of its run, for each block."""
    shared, own = np.split(flat, [len(problem.free)])
    of_run = own.reshape(problem.tape.runs, UNKNOWNS_PER_RUN)[np.asarray(problem.tape.run)]
    return np.concatenate([np.broadcast_to(shared, (len(of_run), len(shared))), of_run], 1)


def _evaluate_in_threads(
    problem: Problem, unknowns: Unknowns, starts: Float[np.ndarray, "blocks states"] | None
) -> Evaluation:
    """The evaluation with the runs divided among threads, because XLA simulates all of them on one core."""
    parts = problem.tape.parts(CORES if jax.default_backend() == "cpu" else 1)
    begins = np.cumsum([0, *(blocks for _, blocks in parts)])

    def of_part(k: int) -> list[np.ndarray]:
        tape, blocks = parts[k]
        guess = np.full((tape.value.shape[0], problem.states), np.nan)
        if starts is not None:
            guess[:blocks] = starts[begins[k] : begins[k + 1]]
        evaluation = _evaluate(replace(problem, tape=tape), unknowns, guess)
        return [np.asarray(values)[:blocks] for values in evaluation]

    by_signal = zip(*map_in_threads(of_part, range(len(parts))), strict=True)
    return Evaluation(*(jnp.asarray(np.concatenate(values)) for values in by_signal))


def whitened(problem: Problem, plain: Evaluation) -> Evaluation:
    """The evaluation with whitened residuals and derivatives, if the problem has a whitening filter."""
    if problem.whitening is None:
        return plain
    residuals, jacobian = _apply_whitening(
        problem.whitening, problem.noise, problem.tape.run, plain.residuals, plain.jacobian
    )
    return plain._replace(residuals=residuals, jacobian=jacobian)


def _evaluated(
    problem: Problem, unknowns: Unknowns, starts: Float[Array | np.ndarray, "blocks states"] | None = None
) -> Evaluation:
    tape = problem.tape
    simulated, jacobian, starts, d_starts = sensitivities(
        problem.parameters, unknowns.coordinates, tape, unknowns.runs, starts
    )
    scale = tape.weight / problem.noise[:, None]
    jacobian = jacobian * scale[..., None] * problem.determinable()[tape.run][:, None, None, :]
    residuals = (simulated - tape.measured) * scale
    wild = ~jnp.all(jnp.abs(jacobian) < MAX_DERIVATIVE, (1, 2, 3)) & problem.fitted_runs[tape.run]
    residuals = jnp.where(wild[:, None, None], jnp.inf, residuals)
    return Evaluation(simulated, residuals, jacobian, starts, d_starts)


# `quickly_compiled` programs are as fast as others without effects, and up to a third slower with them
_evaluate, _evaluate_linear = compiled(_evaluated), quickly_compiled(_evaluated)


def _at_shifted_samples(problem: Problem, unknowns: Unknowns, plain: Evaluation) -> Evaluation:
    """The evaluation with outputs and derivatives as at the samples of an uneven clock, if some were shifted."""
    if problem.shift is None:
        return plain
    change = np.asarray(flatten(unknowns)) - np.asarray(flatten(problem.shift.at))
    scale = problem.tape.weight / problem.noise[:, None]
    determinable = problem.determinable()[problem.tape.run]
    return _add_shift(plain, problem.shift.slope, _by_blocks(problem, change), scale, determinable)


@compiled
def _add_shift(
    plain: Evaluation,
    slope: Float[Array, "blocks 2 samples columns"],
    change: Float[Array | np.ndarray, "blocks columns"],
    scale: Float[Array | np.ndarray, "blocks 2 samples"],
    determinable: Bool[Array, "blocks columns"],
) -> Evaluation:
    moved = jnp.einsum("bcsp,bp->bcs", slope, change)
    return plain._replace(
        simulated=plain.simulated + moved,
        residuals=plain.residuals + scale * moved,
        jacobian=plain.jacobian + scale[..., None] * slope * determinable[:, None, None, :],
    )


def _without_nuisance(problem: Problem, plain: Evaluation) -> Evaluation:
    """The evaluation with residuals and derivatives orthogonal to the responses to the nuisance parameters, if any."""
    if problem.nuisance is None:
        return plain
    weight = problem.noise / problem.nuisance.noise
    return scaled(_orthogonal(problem.tape, problem.nuisance, scaled(plain, weight)), 1 / weight)


@compiled
def _orthogonal(tape: Tape, allowed: Nuisance, plain: Evaluation) -> Evaluation:
    nuisance = allowed.responses * (tape.weight / allowed.noise[:, None])[..., None]
    both = jnp.concatenate([nuisance, plain.jacobian, plain.residuals[..., None]], -1)
    products = jax.ops.segment_sum(jnp.einsum("bcsi,bcsj->bij", nuisance, both), tape.run, tape.runs)
    count = nuisance.shape[-1]
    gram, along = products[..., :count], products[..., count:]
    # runs with fewer nuisance parameters have columns of zeros
    gram = gram + jnp.eye(count) * jnp.where(jnp.diagonal(gram, axis1=1, axis2=2) > 0, 0, 1)[:, None]
    share = jnp.linalg.solve(gram, along)
    projected = both[..., count:] - jnp.einsum("bcsi,bij->bcsj", nuisance, share[tape.run])
    return plain._replace(residuals=projected[..., -1], jacobian=projected[..., :-1])


# Only what is needed is passed to these two, so that one program serves the models of different effects
@compiled
def _apply_whitening(
    whitening: Whitening,
    noise: Float[Array | np.ndarray, "2"],
    run: Int[Array | np.ndarray, " blocks"],
    residuals: Float[Array, "blocks 2 samples"],
    jacobian: Float[Array, "blocks 2 samples columns"],
) -> tuple[Float[Array, "blocks 2 samples"], Float[Array, "blocks 2 samples columns"]]:
    both = jnp.concatenate([jacobian, residuals[..., None]], -1)
    both = whitening(both * noise[:, None, None], run)
    return both[..., -1], both[..., :-1]


def normal_matrix(
    evaluation: Evaluation, tape: Tape, fitted_runs: Bool[Array | np.ndarray, " runs"]
) -> Float[Array, "unknowns unknowns"]:
    """[J r]' [J r], columns: the coordinates, the own unknowns of run after run, and last the residual."""
    return _normal_matrix(evaluation.residuals, evaluation.jacobian, tape.run, fitted_runs)


@compiled
def _normal_matrix(
    residuals: Float[Array, "blocks 2 samples"],
    jacobian: Float[Array, "blocks 2 samples columns"],
    run: Int[Array | np.ndarray, " blocks"],
    fitted_runs: Bool[Array | np.ndarray, " runs"],
) -> Float[Array, "unknowns unknowns"]:
    runs = fitted_runs.shape[0]
    both = jnp.concatenate([jacobian, residuals[..., None]], -1)
    of_block = jnp.einsum("bcsi,bcsj->bij", both, both)
    of_run = jax.ops.segment_sum(of_block, run, runs) * fitted_runs[:, None, None]
    index = _column_indices(jacobian.shape[-1] - UNKNOWNS_PER_RUN, runs)
    size = index.max() + 1
    return jnp.zeros((size, size)).at[index[:, :, None], index[:, None, :]].add(of_run)


def _column_indices(count: int, runs: int) -> np.ndarray:
    """Indices of each run's columns among all unknowns and the residual."""
    own = count + UNKNOWNS_PER_RUN * np.arange(runs)[:, None] + np.arange(UNKNOWNS_PER_RUN)
    shared = np.broadcast_to(np.arange(count), (runs, count))
    return np.concatenate([shared, own, np.full((runs, 1), count + UNKNOWNS_PER_RUN * runs)], 1)


def unflatten(problem: Problem, flat: Float[Array, " columns"]) -> Unknowns:
    count = len(problem.free)
    return Unknowns(flat[:count], RunUnknowns(*flat[count:].reshape(-1, UNKNOWNS_PER_RUN).T))


def flatten(unknowns: Unknowns) -> Float[Array, " columns"]:
    return jnp.concatenate([unknowns.coordinates, jnp.stack(unknowns.runs, 1).reshape(-1)])
