"""When what drives the motor acts: from its sample to the next, as recordings are taken, or otherwise.

An amplifier that follows a signal, and most simulations that others make (`lsim`, interpolated tables), go through the
recorded voltages on straight lines; a loop that applies a voltage, waits and then records everything writes it a
sample late; a command that a controller computes often acts a sample after it was recorded. Taken for held at once,
such a voltage is up to a sample late or early, for which the inductance makes up, and then the resistance and the
friction.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import attrs
import jax
import jax.numpy as jnp
import numpy as np

from ...recording import Recording
from ...simulate import Tape, uniform
from ..likelihood import LIKELIER, negative_log_likelihood
from ..polish import Fit, polish
from ..prepare import Prepared
from ..problem import normal_matrix
from .speed_averaging import as_sampled, seems_averaged, with_averaging, without_ends
from .uneven_sampling import on_clock

# Another timing is not even asked where the misfit shows less than this share of half a sample
SHOWS = 0.3


class Timing(NamedTuple):
    """When the voltages of a recording act, otherwise than held from their sample to the next."""

    what: str
    ahead: int  # by how many samples they were recorded late
    straight: bool  # from sample to sample, instead of held
    load: bool = False  # whether the recorded loads act likewise


OTHERWISE = (
    Timing("goes straight from sample to sample instead of being held", 0, True),
    Timing("was recorded a sample late, when it had been held instead of before", 1, False),
    Timing("acts a sample later than it was recorded", -1, False),
)


def likelier_timings(given: Prepared, fit: Fit) -> list[Timing]:
    """How the voltages of the runs may act: each way that is clearly likelier than the one that they are taken for.

    **Arguments**: `given`, the runs less what their sensors put into them; `fit`, to these.
    """
    if not all(given.problem.samples > 0) or not any(r.drive == "voltage" for r in given.runs):
        return []  # without a current, or without a speed, only a delay would show
    early = _early(given, fit)
    # a speed that is a mean over the last sample comes half a sample late, too, and may hide it
    hidden = given.averaging is None and seems_averaged(given)
    if abs(early) < SHOWS and not hidden:
        return []

    @cache
    def unlikely_with(timing: Timing) -> float:
        other = as_sampled(with_timing(given, timing))
        nearer = polish(other.problem, fit.optimum)
        # what is a mean over the last sample, and what is late, only a fit in time can tell
        return negative_log_likelihood_within(*with_averaging(*on_clock(other, nearer)))

    enough = negative_log_likelihood_within(given, fit) - LIKELIER
    asked = [t for t in OTHERWISE if hidden or (t.ahead < 0) == (early < 0)]
    clearly = [timing for timing in asked if unlikely_with(timing) < enough]
    if all(run.load is None for run in given.training):
        return clearly
    return [min(t, t._replace(load=True), key=unlikely_with) for t in clearly]


def negative_log_likelihood_within(given: Prepared, fit: Fit) -> float:
    """How unlikely a fit makes the runs, but for their ends: nobody can foretell a beginning where a voltage acts
    later."""
    return negative_log_likelihood(without_ends(given), fit)


def _early(given: Prepared, fit: Fit) -> float:
    """By how many halves of a sample the voltages seem to act before they are taken to: by regression of the misfit on
    what half a sample does, less what the parameters could do of it.

    Straight ones are held at their means for this, which needs no code but what is compiled.
    """
    means = with_timing(given, OTHERWISE[0]).problem
    means = replace(means, tape=replace(means.tape, rise=None))
    sooner, evaluation = polish(means, fit.optimum, steps=0).evaluation.seen, fit.evaluation
    scale = given.problem.tape.weight / fit.noise[:, None]
    change = (sooner - evaluation.seen) * scale * given.problem.fitted_blocks[:, None, None]
    matrix = np.asarray(
        normal_matrix(evaluation._replace(residuals=change), means.tape, means.fitted_runs)
    )
    hessian, slope = matrix[:-1, :-1], matrix[:-1, -1]
    own = matrix[-1, -1] - slope @ np.linalg.pinv(hessian, hermitian=True) @ slope
    shared = -float(jnp.sum(evaluation.residuals * change))
    return shared / own if own > 0 else 0.0


def with_timing(given: Prepared, timing: Timing) -> Prepared:
    """The runs with voltages that act so."""
    tape = given.problem.tape
    runs = [uniform(_acting(run, k, tape, timing)) for k, run in enumerate(given.runs)]
    driven = Tape.from_recordings(runs, straight=timing.straight)
    value, load, rise = jax.tree.map(jnp.asarray, (driven.value, driven.load, driven.rise))
    tape = replace(tape, value=value, load=load, rise=rise)
    problem = replace(given.problem, tape=tape)
    acting = given._replace(runs=runs, problem=problem, timing=timing)
    # how each is at its second sample is then its own
    return without_ends(acting) if timing.ahead < 0 else acting


def _acting(run: Recording, k: int, tape: Tape, timing: Timing) -> Recording:
    """The record of a run with the voltages, and perhaps the loads, of those samples at which they act.

    Those of an even clock as the tape has them, for noise may have been taken out there.
    """
    if run.drive != "voltage":
        return run.recorded
    even = run.uneven is None
    voltage = tape.samples_of(k, tape.value, len(run)) if even else run.recorded.voltage
    run, last = run.recorded, len(run.recorded) - 1
    rows = np.clip(np.arange(len(run)) + timing.ahead, 0, last)
    run = attrs.evolve(run, voltage=np.asarray(voltage)[rows])
    if not timing.load or run.load is None:
        return run
    # a straight load is held at its means: it is slow enough
    ahead = np.minimum(rows + 1, last) if timing.straight else rows
    return attrs.evolve(run, load=(run.load[rows] + run.load[ahead]) / 2)
