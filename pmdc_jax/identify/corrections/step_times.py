"""Steps of a voltage that come between two samples, as of a switch that no clock ties to the recorder.

The record shows the new voltage at the next sample only, and the current is then further on than it could be. When
each step came is sought with the motor; of a step that is hardly felt nothing is lost, of the others its time is one
more unknown, and what it does to the outputs tells nothing of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import expm

from ...recording import Averaging, Recording
from ...simulate.tape import BLOCK
from ..likelihood import LIKELIER, negative_log_likelihood
from ..polish import Fit, polish
from ..prepare import Prepared
from ..problem import Problem

# A step is so many times what the voltage does from sample to sample around it, and this share of its range
STANDS_OUT, LARGE = 10.0, 0.05
# Fewer steps tell nothing of whether all come alike; more a run than one in so many samples are no switch's
FEWEST, SAMPLES = 4, 20
# What steps do to the outputs takes at most so many numbers
NUMBERS = 2e7
# Steps without a clock come anywhere in a sample: their shares of it spread so much, and hardly leave it
SPREAD, OUTSIDE = 0.15, 0.2
# Each of them must make the runs so much likelier
EACH = 5.0
PASSES = 5
# Squares by which a step shows, as a share of those of the one that shows most, below which it does not
HARDLY = 1e-8


class Steps(NamedTuple):
    """The steps of a run."""

    at: Int[np.ndarray, " steps"]  # the first samples after them
    height: Float[np.ndarray, " steps"]  # V
    share: Float[np.ndarray, " steps"]  # of the sample before, for how long they had come


def with_step_times(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with the steps of their voltages where the motor felt them, and the fit to them; both as they are if
    these steps come with the samples, or all as late."""
    problem = given.problem
    steps = [steps_of(run) for run in given.runs]
    if given.straight:  # what goes straight rises in the middle
        steps = [s._replace(share=s.share + 0.5) for s in steps]
    count, most = sum(len(s.at) for s in steps), max(len(s.at) for s in steps)
    too_many = 2 * problem.tape.value.size * most > NUMBERS
    if not all(problem.samples > 0) or count < FEWEST or too_many:
        return given, fit
    enough = LIKELIER + EACH * count
    steps, promised = _moved(problem, fit, steps)
    if promised < enough or not _come_anywhere(steps):
        return given, fit
    placed, better = given, fit
    for again in range(PASSES):
        if again:
            steps, _ = _moved(placed.problem, better, steps)
        placed = _placed(given, better, steps)
        better = polish(placed.problem, better.optimum)
    gained = negative_log_likelihood(given, fit) - negative_log_likelihood(given, better)
    return (placed, better) if gained > enough else (given, fit)


def steps_of(run: Recording) -> Steps:
    """The steps of the voltage of a run that stand out, as if they came with the samples."""
    at, height = np.zeros(0, int), np.zeros(0)
    if run.drive == "voltage" and run.voltage is not None and run.uneven is None and len(run) > 3:
        rise = np.diff(run.voltage)
        size = np.abs(rise)
        around = np.pad(size, 1)
        around = np.maximum(around[:-2], around[2:])
        enough = np.maximum(STANDS_OUT * around, LARGE * np.ptp(run.voltage))
        found = np.flatnonzero(size > enough)
        if len(found) <= len(run) / SAMPLES:
            at, height = found + 1, rise[found]
    return Steps(at, height, np.zeros(len(at)))


def _come_anywhere(steps: Sequence[Steps]) -> bool:
    """Whether steps come at all times within a sample, and neither all alike nor before or after it."""
    share = np.concatenate([s.share for s in steps])
    inside = (share > -OUTSIDE) & (share < 1 + OUTSIDE)
    return bool(np.mean(inside) > 1 - OUTSIDE and np.std(np.clip(share, 0, 1)) > SPREAD)


def _moved(problem: Problem, fit: Fit, steps: Sequence[Steps]) -> tuple[list[Steps], float]:
    """The steps at the times that make the misfit of a fit least, and by how much that is likelier in white noise."""
    tape = problem.tape
    scale = np.asarray(tape.weight) / fit.noise[:, None]
    left = (np.asarray(tape.measured) - np.asarray(fit.evaluation.seen)) * scale
    moved, squares = [], 0.0
    for run, s in enumerate(steps):
        mine = tape.blocks_of(run)
        columns = _responses(problem, fit, run, s) * scale[mine][..., None]
        rows, rest = columns.reshape(left[mine].size, len(s.at)), left[mine].ravel()
        along = rows.T @ rest
        # a step that is hardly felt stays where it is
        by = np.linalg.pinv(rows.T @ rows, hermitian=True, rcond=HARDLY) @ along
        moved.append(s._replace(share=s.share + by))
        squares += float(along @ by)
    return moved, squares / 2


def _placed(given: Prepared, fit: Fit, steps: Sequence[Steps]) -> Prepared:
    """The runs with steps at their times, and these as unknowns."""
    problem, tape = given.problem, given.problem.tape
    value = np.array(tape.value)
    rise = np.zeros_like(value) if tape.rise is None else np.array(tape.rise)
    most = max(len(s.at) for s in steps)
    nuisance = np.zeros((*np.shape(tape.measured), most))
    for run, s in enumerate(steps):
        mine = np.flatnonzero(tape.blocks_of(run))
        nuisance[mine, ..., : len(s.at)] = _responses(problem, fit, run, s)
        share = np.clip(s.share, 0.0, 1.0)
        block, sample = np.divmod(s.at - 1, BLOCK)
        before = given.runs[run].voltage
        assert before is not None or not len(s.at), "only voltages step"
        if before is not None:
            # a straight line with the mean and the first moment of the step
            value[mine[block], sample] = before[s.at - 1] + share * s.height
            rise[mine[block], sample] = 6 * share * (1 - share) * s.height
    tape = replace(tape, value=jnp.asarray(value), rise=jnp.asarray(rise))
    problem = replace(problem, tape=tape, nuisance=jnp.asarray(nuisance))
    return given._replace(problem=problem, stepped=True)


def _responses(
    problem: Problem, fit: Fit, run: int, steps: Steps
) -> Float[np.ndarray, "blocks 2 samples steps"]:
    """What the outputs of a run gain, in A and rad/s, as each of its steps comes a sample earlier: as fast as at the
    time where it is."""
    tape, step = problem.tape, problem.tape.sample_time_of(run)
    motor = problem.parameters(fit.coordinates)
    A, B = map(np.asarray, motor.state_space(tape.drive_of(run)))
    length = int(tape.blocks_of(run).sum()) * BLOCK
    after = _powers(expm(A * step), length)
    responses = np.zeros((length, 2, len(steps.at)))
    for k, (at, height, share) in enumerate(zip(*steps, strict=True)):
        begun = expm(A * step * np.clip(share, 0.0, 1.0)) @ B[:, 0] * step * height
        responses[at:, :, k] = after[: length - at] @ begun
    if tape.averaging is not None:
        responses[:, 1] = Averaging(*np.asarray(tape.averaging)[run]).of(responses[:, 1])
    return np.moveaxis(responses.reshape(length // BLOCK, BLOCK, 2, len(steps.at)), 1, 2)


def _powers(A: Float[np.ndarray, "2 2"], count: int) -> Float[np.ndarray, "count 2 2"]:
    """The powers of a matrix from the zeroth on."""
    powers = np.eye(2)[None]
    while len(powers) < count:
        powers = np.concatenate([powers, powers @ np.linalg.matrix_power(A, len(powers))])
    return powers[:count]
