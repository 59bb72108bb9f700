"""Unevenly sampled recordings, such as those with the time stamps of a computer or the steps of a variable-step solver.

The simulation has even samples. Interpolating the measurement at these would lose peaks and colour the noise; instead,
each recorded sample is shifted by what the fitted motor does between its time and the nearest even sample.
"""

from __future__ import annotations

import attrs
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...recordings.clock import GAP
from ...recordings.recording import SIMULATED_OUTPUTS, Recording
from ...simulate import Tape
from ...simulate.uneven import simulated_at_stamps
from ..fit.fitted_runs import FittedRuns
from ..fit.polish import Fit, fit_at
from ..prepare import Prepared
from ..problem import Problem

# Refits at most
MAX_REFITS = 12
# Refits end when the shifts of the samples change by less than this, sum of squares in noise variances: that could move
# no estimate by more than its root, 0.1 standard errors
SHIFT_TOLERANCE = 0.01
# Steps of the parameters that shrink by less than this ratio are extrapolated to their limit
MAX_STEP_RATIO = 0.9


def with_even_clock(fitted: FittedRuns) -> FittedRuns:
    """The runs with every sample of an uneven clock shifted to the nearest even sample along the simulated motion, and
    the fit to them; both unchanged where all clocks are even."""
    uneven = not all(run.has_even_clock for run in fitted.prepared.runs)
    last = None
    for _ in range(MAX_REFITS if uneven else 0):
        before, fitted = fitted, FittedRuns.polished(_shifted(*fitted), fitted.fit.optimum)
        if _squares_between(before.problem, fitted) < SHIFT_TOLERANCE:
            break
        step = np.asarray(fitted.fit.coordinates - before.fit.coordinates)
        rate = step @ last / (last @ last) if last is not None else 0.0
        last = step
        if 0 < rate < MAX_STEP_RATIO:
            # where the current settles within a sample, samples shifted with a wrong inductance reproduce most of its
            # error, and plain iteration would converge slowly
            fitted, last = _extrapolated(fitted, rate / (1 - rate) * step), None
    return fitted


def _extrapolated(fitted: FittedRuns, step: Float[np.ndarray, " parameters"]) -> FittedRuns:
    """The fit evaluated a `step` further on, within the bounds (Irons and Tuck, doi:10.1002/nme.1620010306)."""
    further = fitted.fit.optimum.moved(fitted.problem.parameters, step)
    return fitted._replace(fit=fit_at(fitted.problem, further))


def _squares_between(before: Problem, after: FittedRuns) -> float:
    """Sum of squared differences between the samples of the training runs, in noise variances."""
    one, other = before.tape, after.problem.tape
    moved = (np.asarray(other.measured) - np.asarray(one.measured)) * np.asarray(other.weight)
    return float(np.square(moved / after.fit.noise[:, None])[after.problem.fitted_blocks].sum())


def _shifted(prepared: Prepared, fit: Fit) -> Prepared:
    """The runs with their samples shifted along the simulated motion of this fit."""
    tape, simulated = prepared.problem.tape, fit.evaluation.simulated
    motor = prepared.problem.parameters(fit.coordinates)
    runs = []
    for k, run in enumerate(prepared.runs):
        if not run.has_even_clock:
            now = tape.samples_of(k, simulated, len(run))
            then = simulated_at_stamps(motor, tape.drive_of(k), run, now, prepared.timing.first_order_hold)
            run = _nearest_samples(run, now, then)
        runs.append(run)
    laid, begins = Tape.from_recordings(runs), np.asarray(tape.begins)
    # the first sample of a run is the first of the even clock: it counts if it did before
    laid.weight[begins, :, 0] = np.asarray(tape.weight)[begins, :, 0]
    moved = prepared._replace(runs=runs)
    return moved.with_tape(measured=jnp.asarray(laid.measured), weight=jnp.asarray(laid.weight))


def _nearest_samples(run: Recording, now: np.ndarray, then: np.ndarray) -> Recording:
    """A run on an even clock with the output recorded nearest to each of its samples, and NaN inside gaps.

    **Arguments**: `now` and `then`, the simulated outputs at the even samples and at the recorded ones.
    """
    record = run.recorded
    nearest = np.rint(np.interp(run.time, record.time, np.arange(len(record)))).astype(int)
    near = np.abs(record.time[nearest] - run.time) <= GAP / 2 * run.sample_time
    outputs = {
        name: np.where(near, signal[nearest] + now[:, c] - then[nearest, c], np.nan)
        for c, name in enumerate(SIMULATED_OUTPUTS)
        if getattr(run, name) is not None and (signal := getattr(record, name)) is not None
    }
    return attrs.evolve(run, **outputs)
