"""Unevenly sampled recordings, such as those with the time stamps of a computer or the steps of a variable-step solver.

The simulation has even samples. Interpolating the measurement at these would lose peaks and colour the noise; instead,
each recorded sample is shifted by what the fitted motor does between its time and the nearest even sample. How far that
is depends on the motor, too: the `Shift` of the problem adds its derivatives to those of the even samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import attrs
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ...recordings.clock import GAP
from ...recordings.recording import SIMULATED_OUTPUTS, Recording
from ...runtime.threads import map_in_threads
from ...simulate import Tape
from ...simulate.uneven import simulated_at_stamps
from ..fit.fitted_runs import FittedRuns
from ..fit.polish import Fit, fit_at, polish, reweighted
from ..parameters import Parameters
from ..prepare import Prepared
from ..problem import Problem, Shift, evaluate

# Refits at most
MAX_REFITS = 12
# Refits end when shifting the samples anew changes the residuals by less than this, sum of squares in noise variances:
# that could move no estimate by more than its root, 0.1 standard errors
SHIFT_TOLERANCE = 0.01
# Changes of the outputs, in noise standard deviations, over which derivatives of the shift are differenced
DIFFERENCE = 1e-3

# Current A and speed rad/s at the samples of an even clock or at those of the record; their derivatives by unknowns
Outputs = Float[np.ndarray, "samples 2"]
Recorded = Float[np.ndarray, "recorded 2"]
Derivatives = Float[np.ndarray, "samples 2 columns"]


def with_even_clock(fitted: FittedRuns) -> FittedRuns:
    """The runs with every sample of an uneven clock shifted to the nearest even sample along the simulated motion, and
    the fit to them; both unchanged where all clocks are even."""
    if all(run.has_even_clock for run in fitted.prepared.runs):
        return fitted
    for _ in range(MAX_REFITS):
        shifted, before = _shifted(*fitted), fitted.fit
        start = fit_at(shifted.problem, before.optimum)
        at_start = reweighted(shifted.problem, start)
        fitted = FittedRuns(shifted, polish(shifted.problem, before.optimum, at_start=at_start))
        if _squares_between(before, start, shifted.problem) < SHIFT_TOLERANCE:
            break
    return fitted


def _squares_between(one: Fit, other: Fit, problem: Problem) -> float:
    """Sum of squared differences between the residuals of two fits in the training runs, in noise variances."""
    residuals = [np.asarray(fit.evaluation.residuals) * fit.noise[:, None] for fit in (one, other)]
    return float(np.square((residuals[0] - residuals[1]) / other.noise[:, None])[problem.fitted_blocks].sum())


def _shifted(prepared: Prepared, fit: Fit) -> Prepared:
    """The runs with their samples shifted along the simulated motion of this fit."""
    problem, tape = prepared.problem, prepared.problem.tape
    everywhere = replace(tape, weight=jnp.ones_like(tape.weight))
    plain = evaluate(replace(problem, tape=everywhere, whitening=None, nuisance=None, shift=None), fit.unknowns)
    jacobian = np.moveaxis(np.asarray(plain.jacobian) * np.asarray(problem.noise)[:, None, None], 2, -1)
    runs, slope = [], np.zeros_like(jacobian)
    for k, run in enumerate(prepared.runs):
        if not run.has_even_clock:
            now = tape.samples_of(k, plain.simulated, len(run))
            d_now = tape.samples_of(k, jacobian, len(run))
            at_stamps = partial(
                simulated_at_stamps,
                drive=tape.drive_of(k),
                even=run,
                first_order_hold=prepared.timing.first_order_hold,
                mean_speed=run.recorded.averaging is not None,
            )
            then, d_then = _with_derivatives(at_stamps, problem.parameters, fit, now, d_now)
            nearest = _nearest(run)
            # a mean speed is missing at the first sample and has no derivative
            tape.set_samples_of(k, slope, np.nan_to_num(d_then[nearest] - d_now))
            run = _at_even_samples(run, nearest, now - then[nearest])
        runs.append(run)
    laid, begins = Tape.from_recordings(runs), np.asarray(tape.begins)
    # the first sample of a run is the first of the even clock: it counts if it did before
    laid.weight[begins, :, 0] = np.asarray(tape.weight)[begins, :, 0]
    moved = prepared.with_problem(shift=Shift(jnp.asarray(np.moveaxis(slope, -1, 2)), fit.unknowns))._replace(runs=runs)
    return moved.with_tape(measured=jnp.asarray(laid.measured), weight=jnp.asarray(laid.weight))


def _with_derivatives(
    at_stamps: Callable[..., Recorded], parameters: Parameters, fit: Fit, now: Outputs, d_now: Derivatives
) -> tuple[Recorded, Float[np.ndarray, "recorded 2 columns"]]:
    """The outputs at the stamps of a record, and their derivatives by the coordinates and the run's own unknowns, from
    those at the even samples."""
    coordinates = np.asarray(fit.coordinates)

    def outputs(column: int, step: float) -> Recorded:
        along = step * np.eye(d_now.shape[-1])[column, : len(coordinates)]
        return at_stamps(parameters(jnp.asarray(coordinates + along)), simulated=now + step * d_now[..., column])

    def derivative(column: int) -> Recorded:
        size = float(np.max(np.abs(d_now[..., column]) / fit.noise))
        if not size:
            return np.zeros_like(then)
        step = min(DIFFERENCE, DIFFERENCE / size)
        return (outputs(column, step) - then) / step

    then = outputs(0, 0.0)
    return then, np.stack(map_in_threads(derivative, range(d_now.shape[-1])), -1)


def _nearest(run: Recording) -> Int[np.ndarray, " samples"]:
    """The recorded sample nearest to each of a run on an even clock."""
    return np.rint(np.interp(run.time, run.recorded.time, np.arange(len(run.recorded)))).astype(int)


def _at_even_samples(run: Recording, nearest: Int[np.ndarray, " samples"], shift: Outputs) -> Recording:
    """A run on an even clock with the outputs of the nearest recorded samples, shifted, and NaN inside gaps."""
    record = run.recorded
    near = np.abs(record.time[nearest] - run.time) <= GAP / 2 * run.sample_time
    outputs = {
        name: np.where(near, signal[nearest] + shift[:, c], np.nan)
        for c, name in enumerate(SIMULATED_OUTPUTS)
        if getattr(run, name) is not None and (signal := getattr(record, name)) is not None
    }
    return attrs.evolve(run, **outputs)
