"""Samples of an uneven clock, as the time stamps of a computer or the steps of a simulation: each taken when it came.

The solver's samples are even. To interpolate what was measured between its own would lose the peaks and colour the
noise; each recorded sample is moved instead, by what the fitted motor does between it and the even sample next to it.
"""

from __future__ import annotations

import attrs
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...clock import GAP
from ...recording import Recording
from ...simulate import Tape
from ...simulate.uneven import seen_at_record
from ..polish import Fit, polish
from ..prepare import Prepared

# Refits at most
PASSES = 12
# ... until samples move by so little that, taken together, they could move no estimate by more than the root of this in
# standard errors
AT_REST = 0.01
# Steps that shrink at this rate at most are followed to their end
SHRINKING = 0.9


def on_clock(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with every sample of an uneven clock moved to the even sample next to it, as the fitted motor moves, and
    the fit to them; both as they are where all clocks are even."""
    uneven = any(run.uneven is not None for run in given.runs)
    last = None
    for _ in range(PASSES if uneven else 0):
        before, given = given, _moved(given, fit)
        fit, start = polish(given.problem, fit.optimum), fit
        if _squares_between(before, given, fit) < AT_REST:
            break
        step = np.asarray(fit.coordinates - start.coordinates)
        rate = step @ last / (last @ last) if last is not None else 0.0
        last = step
        if 0 < rate < SHRINKING:
            # where the current decays within a sample, what was moved by a wrong inductance asks for most of it again
            fit, last = _ahead(given, fit, rate / (1 - rate) * step), None
    return given, fit


def _ahead(given: Prepared, fit: Fit, step: Float[np.ndarray, " parameters"]) -> Fit:
    """The fit at parameters further on, within their bounds (Irons and Tuck, doi:10.1002/nme.1620010306)."""
    parameters, unknowns = given.problem.parameters, fit.unknowns
    further = jnp.clip(unknowns.coordinates + step, parameters.lower, parameters.upper)
    optimum = fit.optimum._replace(unknowns=unknowns._replace(coordinates=further))
    return polish(given.problem, optimum, steps=0)


def _squares_between(before: Prepared, after: Prepared, fit: Fit) -> float:
    """By how much the samples that count were moved, in variances of the noise."""
    one, other = before.problem.tape, after.problem.tape
    moved = (np.asarray(other.measured) - np.asarray(one.measured)) * np.asarray(other.weight)
    return float(np.square(moved / fit.noise[:, None])[after.problem.fitted_blocks].sum())


def _moved(given: Prepared, fit: Fit) -> Prepared:
    """The runs with their samples moved as this fit moves."""
    tape, seen = given.problem.tape, fit.evaluation.seen
    motor = given.problem.parameters(fit.coordinates)
    runs = []
    for k, run in enumerate(given.runs):
        if run.uneven is not None:
            now = np.stack([tape.samples_of(k, seen[:, c], len(run)) for c in range(2)], 1)
            then = seen_at_record(motor, tape.drive_of(k), run, now, given.straight)
            run = _next_to(run, now, then)
        runs.append(run)
    laid, begins = Tape.from_recordings(runs), np.asarray(tape.begins)
    # a first sample is measured when the even clock begins, and counts if it did
    laid.weight[begins, :, 0] = np.asarray(tape.weight)[begins, :, 0]
    moved = given._replace(runs=runs)
    return moved.with_tape(measured=jnp.asarray(laid.measured), weight=jnp.asarray(laid.weight))


def _next_to(run: Recording, now: np.ndarray, then: np.ndarray) -> Recording:
    """A run on an even clock with the outputs that were recorded next to each of its samples, and none inside gaps.

    **Arguments**: what is simulated `now`, at the even samples, and `then`, at those recorded.
    """
    record = run.recorded
    nearest = np.rint(np.interp(run.time, record.time, np.arange(len(record)))).astype(int)
    near = np.abs(record.time[nearest] - run.time) <= GAP / 2 * run.sample_time
    outputs = {
        name: np.where(near, signal[nearest] + now[:, c] - then[nearest, c], np.nan)
        for c, name in enumerate(("current", "speed"))
        if getattr(run, name) is not None and (signal := getattr(record, name)) is not None
    }
    return attrs.evolve(run, **outputs)
