"""Voltage steps between two samples, as from a switch that is not synchronised with the recorder.

The record shows the new voltage only at the next sample, when the current has already responded to it. The time of each
step is fitted together with the motor, as a nuisance parameter: the part of the outputs that depends on it then carries
no information on the motor, which costs nothing for a step that is hardly felt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import expm

from ...recordings.recording import Averaging, Recording, jumps_of
from ...simulate import FIRST_ORDER_HOLD, SMOOTH
from ...simulate.between_samples import rise_like_step
from ...simulate.tape import BLOCK
from ..fit.fitted_runs import FittedRuns
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, negative_log_likelihood
from ..fit.polish import Fit
from ..prepare import Prepared
from ..problem import Nuisance, Problem
from .retiming import electrical_rate, with_timing

# Height of a step over the change of the voltage in the samples beside it, at least
MIN_STEP_RATIO = 10.0
# Height of a step over the range of the voltage, at least
MIN_STEP_SHARE = 0.05
# With fewer steps in all it cannot be told whether they share one delay
MIN_STEPS = 4
# A run with more than one step in this many samples is not switched
MIN_SAMPLES_PER_STEP = 20
# Most numbers in the array of step responses
MAX_ELEMENTS = 2e7
# Steps without a clock come anywhere within a sample: least standard deviation of their places in it, in samples
MIN_SPREAD = 0.15
# How far outside its sample an estimate of such a place may lie, in samples
MARGIN = 0.2
# Share of the estimates that may lie farther outside
MAX_OUTLIERS = 0.2
# Gain in log-likelihood that each step must bring
MIN_GAIN_PER_STEP = 5.0
# Refits end when no step moves by more than this within its sample, in samples
TOLERANCE = 5e-4
MAX_REFITS = 30
# A combination of steps with less than this share of the largest eigenvalue of the normal matrix is not felt
RANK_TOLERANCE = 1e-8


class VoltageSteps(NamedTuple):
    """The voltage steps of a run."""

    at: Int[np.ndarray, " steps"]  # the first samples after them
    height: Float[np.ndarray, " steps"]  # V
    # of the interval before that sample, for how long the new voltage already acts
    share: Float[np.ndarray, " steps"]


def with_step_times(fitted: FittedRuns) -> FittedRuns:
    """The runs with the steps of their voltages at the times when the motor felt them, and the fit to them; both
    unchanged if the steps coincide with samples or all have the same delay, which is a matter of `reading_time`."""
    prepared, problem = fitted.prepared, fitted.problem
    steps = [_as_laid_out(prepared, run) for run in range(len(prepared.runs))]
    count, most = sum(len(s.at) for s in steps), max(len(s.at) for s in steps)
    too_many = 2 * problem.tape.value.size * most > MAX_ELEMENTS
    if prepared.timing.reading or not all(problem.samples > 0) or count < MIN_STEPS or too_many:
        return fitted
    min_gain = MIN_LOG_LIKELIHOOD_GAIN + MIN_GAIN_PER_STEP * count
    steps, predicted_gain = _fit_times(problem, fitted.fit, steps)
    if predicted_gain < min_gain or not _are_unsynchronised(steps):
        return fitted
    placed = _refitted(prepared, fitted.fit, steps)
    # smooth voltages look like that too, beside steps anywhere in a sample
    if prepared.timing == FIRST_ORDER_HOLD:
        smooth = _refitted_smooth(prepared, placed)
        placed = min(placed, smooth, key=lambda p: negative_log_likelihood(p.fitted))
    gain = negative_log_likelihood(fitted) - negative_log_likelihood(placed.fitted)
    return placed.fitted if gain > min_gain else fitted


class _Placed(NamedTuple):
    """Runs with their steps at the times that fit best, and the fit to them."""

    fitted: FittedRuns
    steps: Sequence[VoltageSteps]


def _refitted(prepared: Prepared, fit: Fit, steps: Sequence[VoltageSteps]) -> _Placed:
    """The steps at the times that fit best, from the times and the fit given."""
    placed = _placed(prepared, fit, steps)
    for _ in range(MAX_REFITS):
        steps, _ = _fit_times(placed.fitted.problem, placed.fitted.fit, placed.steps)
        moved = np.clip(_shares(steps), 0, 1) - np.clip(_shares(placed.steps), 0, 1)
        if np.max(np.abs(moved)) < TOLERANCE:
            break
        placed = _placed(prepared, placed.fitted.fit, steps)
    return placed


def _placed(prepared: Prepared, fit: Fit, steps: Sequence[VoltageSteps]) -> _Placed:
    """The steps at these times, and the fit to the runs with them, from another fit."""
    return _Placed(FittedRuns.polished(_with_steps(prepared, fit, steps), fit.optimum), steps)


def _refitted_smooth(prepared: Prepared, first_order: _Placed) -> _Placed:
    """The steps at the times that fit best if the voltages are on smooth curves between them, from the fit for straight
    voltages."""
    straight = first_order.fitted.fit
    rate = electrical_rate(prepared.problem, straight)
    smooth = with_timing(prepared, SMOOTH._replace(smooth=rate))
    steps = [_as_laid_out(smooth, run)._replace(share=s.share) for run, s in enumerate(first_order.steps)]
    return _refitted(smooth, straight, steps)


def steps_of(run: Recording) -> VoltageSteps:
    """The voltage steps of a run that stand out, placed at samples."""
    at, height = np.zeros(0, int), np.zeros(0)
    if run.drive == "voltage" and run.voltage is not None and run.has_even_clock and len(run) > 3:
        jumps = jumps_of(run.voltage, MIN_STEP_RATIO, MIN_STEP_SHARE)
        if len(jumps) <= len(run) / MIN_SAMPLES_PER_STEP:
            at, height = jumps, np.diff(run.voltage)[jumps - 1]
    return VoltageSteps(at, height, np.zeros(len(at)))


def _as_laid_out(prepared: Prepared, k: int) -> VoltageSteps:
    """The steps of a run as they are on its tape."""
    steps, timing, tape = steps_of(prepared.runs[k]), prepared.timing, prepared.problem.tape
    if timing.smooth is not None:  # the curve before a step goes on until it
        run = prepared.runs[k]
        before = tape.samples_of(k, tape.drive_at(1.0), len(run))[steps.at - 1]
        return steps._replace(height=np.asarray(run.voltage)[steps.at] - before)
    if timing.first_order_hold:  # a straight rise between two samples is a step in their middle
        return steps._replace(share=steps.share + 0.5)
    return steps


def _are_unsynchronised(steps: Sequence[VoltageSteps]) -> bool:
    """Whether the steps are spread over a sample interval, instead of all at the same place in it or outside."""
    share = _shares(steps)
    inside = (share > -MARGIN) & (share < 1 + MARGIN)
    spread = np.std(np.clip(share, 0, 1))
    return bool(np.mean(inside) > 1 - MAX_OUTLIERS and spread > MIN_SPREAD)


def _shares(steps: Sequence[VoltageSteps]) -> Float[np.ndarray, " steps"]:
    """The shares of the steps of all runs."""
    return np.concatenate([s.share for s in steps])


def _fit_times(problem: Problem, fit: Fit, steps: Sequence[VoltageSteps]) -> tuple[list[VoltageSteps], float]:
    """The steps at the times that minimise the residuals of a fit, and the gain in log-likelihood for white noise."""
    tape = problem.tape
    scale = np.asarray(tape.weight) / fit.noise[:, None]
    residual = (np.asarray(tape.measured) - np.asarray(fit.evaluation.simulated)) * scale
    fitted, squares = [], 0.0
    for run, s in enumerate(steps):
        mine = tape.blocks_of(run)
        columns = _responses(problem, fit, run, s) * scale[mine][..., None]
        rows, rest = columns.reshape(residual[mine].size, len(s.at)), residual[mine].ravel()
        along = rows.T @ rest
        # a step that is hardly felt stays where it is
        by = np.linalg.pinv(rows.T @ rows, hermitian=True, rcond=RANK_TOLERANCE) @ along
        fitted.append(s._replace(share=s.share + by))
        squares += float(along @ by)
    return fitted, squares / 2


def _with_steps(prepared: Prepared, fit: Fit, steps: Sequence[VoltageSteps]) -> Prepared:
    """The runs with the steps at their times, which become nuisance parameters of the problem."""
    problem, tape = prepared.problem, prepared.problem.tape
    value = np.array(tape.value)
    rise = np.zeros_like(value) if tape.rise is None else np.array(tape.rise)
    most, rate = max(len(s.at) for s in steps), electrical_rate(problem, fit)
    responses = np.zeros((*np.shape(tape.measured), most))
    for run, s in enumerate(steps):
        mine = np.flatnonzero(tape.blocks_of(run))
        responses[mine, ..., : len(s.at)] = _responses(problem, fit, run, s)
        share = np.clip(s.share, 0.0, 1.0)
        block, sample = np.divmod(s.at - 1, BLOCK)
        at = mine[block], sample
        if prepared.timing.smooth is None:
            value[at] -= rise[at] / 2
            rise[at] = 0.0
        value[at] += share * s.height
        rise[at] += rise_like_step(share, rate * tape.sample_time_of(run)) * s.height
    tape = replace(tape, value=jnp.asarray(value), rise=jnp.asarray(rise))
    nuisance = Nuisance(jnp.asarray(responses), fit.noise)
    return prepared.with_problem(tape=tape, nuisance=nuisance)._replace(stepped=True)


def _responses(
    problem: Problem, fit: Fit, run: int, steps: VoltageSteps
) -> Float[np.ndarray, "blocks 2 samples steps"]:
    """Derivatives of the outputs of a run, A and rad/s, by how much earlier each of its steps comes, in samples; of the
    linear motor, at the present time of the step."""
    tape, step = problem.tape, problem.tape.sample_time_of(run)
    motor = problem.parameters(fit.coordinates)
    A, B = map(np.asarray, motor.state_space(tape.drive_of(run)))
    length = int(tape.blocks_of(run).sum()) * BLOCK
    after = _matrix_powers(expm(A * step), length)
    responses = np.zeros((length, 2, len(steps.at)))
    for k, (at, height, share) in enumerate(zip(*steps, strict=True)):
        at_sample = expm(A * step * np.clip(share, 0.0, 1.0)) @ B[:, 0] * step * height
        responses[at:, :, k] = after[: length - at] @ at_sample
    if tape.averaging is not None:
        last, coming, of_current = np.asarray(tape.averaging)[run]
        responses[:, 0] = Averaging(of_current, 0.0).applied_to(responses[:, 0])
        later = 0.0 if tape.later is None else float(tape.later[tape.grid_of(run)])
        responses[:, 1] = Averaging(last, coming, later).applied_to(responses[:, 1], tape.span_of(run))
    return np.moveaxis(responses.reshape(length // BLOCK, BLOCK, 2, len(steps.at)), 1, 2)


def _matrix_powers(A: Float[np.ndarray, "2 2"], count: int) -> Float[np.ndarray, "count 2 2"]:
    """The powers of a matrix, starting at the zeroth."""
    powers = np.eye(2)[None]
    while len(powers) < count:
        powers = np.concatenate([powers, powers @ np.linalg.matrix_power(A, len(powers))])
    return powers[:count]
