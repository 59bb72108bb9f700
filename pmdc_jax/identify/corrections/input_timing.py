"""When a recorded voltage acts: held from its sample to the next, which is the default, or otherwise.

An amplifier that follows a signal, and most simulation tools (`lsim`, interpolated tables), connect the recorded
voltages by straight lines; a loop that applies a voltage, waits and then records everything writes it a sample late; a
command computed by a controller often acts a sample after it was recorded. Treated as held from its sample on, such a
voltage is up to a sample late or early, and the inductance, then the resistance and the friction, compensate for it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from ...recording import Recording
from ...simulate import Tape, uniform
from ..likelihood import MIN_LOG_LIKELIHOOD_GAIN, negative_log_likelihood
from ..polish import Fit, polish
from ..prepare import Prepared
from ..problem import normal_matrix
from .reading_time import MARGIN, samples_ahead
from .speed_averaging import seems_averaged, with_averaging, without_averaging, without_ends
from .uneven_sampling import with_even_clock

# Accuracy, in samples, with which a lead is searched
LEAD_TOLERANCE = 3e-3
# Least distance from a sample, in samples, of a voltage that acts between two
MIN_DISTANCE = 0.02
# No other timing is tried where the residuals show a shift of less than this share of half a sample
MIN_LEAD = 0.3


class Timing(NamedTuple):
    """When the voltages of a recording act, if they are not held from their sample to the next."""

    lead: float  # by how many samples they act before the sample beside which they were recorded, at least -1
    straight: bool = False  # linear from sample to sample instead of held
    load: bool = False  # whether the recorded loads have the same timing

    @property
    def ahead(self) -> int:
        """By how many whole samples they act earlier."""
        return int(np.floor(self.lead))

    @property
    def reading(self) -> float | None:
        """The share of a sample between the instant at which a voltage begins to act and the reading of the outputs, if
        not zero."""
        return self.lead - self.ahead or None

    @property
    def what(self) -> str:
        """What the voltages do, in words."""
        if self.straight:
            return "is linear between samples instead of held"
        if self.reading is not None:
            sooner = "earlier" if self.lead > 0 else "later"
            return f"acts {abs(self.lead):.2g} of a sample {sooner} than it was recorded"
        if self.lead > 0:
            return "was recorded one sample late, after it had been held instead of before"
        return "acts one sample later than it was recorded"


STRAIGHT, LATE, EARLY = Timing(0, straight=True), Timing(1), Timing(-1)


def likelier_timings(given: Prepared, fit: Fit) -> list[Timing]:
    """The timings of the voltages that are clearly likelier than the assumed one.

    **Arguments**: `given`, the runs with the effects of their sensors corrected; `fit`, to these.
    """
    if not all(given.problem.samples > 0) or not any(r.drive == "voltage" for r in given.runs):
        return []  # without a current, or without a speed, only a delay would show
    lead = _apparent_lead(given, fit)
    # a speed that is a mean over the last sample is half a sample late, too, and may hide the shift
    hidden = given.averaging is None and seems_averaged(given)
    plausible = []
    if abs(lead) > MIN_LEAD or hidden:
        plausible = [t for t in (STRAIGHT, LATE, EARLY) if hidden or (t.ahead < 0) == (lead < 0)]
    plausible += _between_samples(given, fit)

    @cache
    def unlikelihood(timing: Timing) -> float:
        other = without_averaging(with_timing(given, timing))
        nearer = polish(other.problem, fit.optimum)
        # only a fit with the right timing can tell a mean over the last sample from a delay
        return negative_log_likelihood_within(*with_averaging(*with_even_clock(other, nearer)))

    limit = negative_log_likelihood_within(given, fit) - MIN_LOG_LIKELIHOOD_GAIN
    likelier = [timing for timing in plausible if unlikelihood(timing) < limit]
    if all(run.load is None for run in given.training):
        return likelier
    return [t if t.reading else min(t, t._replace(load=True), key=unlikelihood) for t in likelier]


def _between_samples(given: Prepared, fit: Fit) -> list[Timing]:
    """The timing between two samples that fits best, if the voltages act there."""
    ahead = samples_ahead(given, fit)
    if ahead is None:
        return []

    def misfit(reading: float) -> float:
        return polish(with_timing(given, Timing(ahead + reading)).problem, fit.optimum).fitness

    tolerance = {"xatol": LEAD_TOLERANCE}
    best = minimize_scalar(misfit, bounds=(MARGIN, 1 - MARGIN), method="bounded", options=tolerance)
    reading = float(best.x)
    return [Timing(ahead + reading)] if MIN_DISTANCE < reading < 1 - MIN_DISTANCE else []


def negative_log_likelihood_within(given: Prepared, fit: Fit) -> float:
    """Negative log-likelihood of the runs without their first and last samples: where a voltage acts later, the
    beginning of a run cannot be predicted."""
    return negative_log_likelihood(without_ends(given), fit)


def _apparent_lead(given: Prepared, fit: Fit) -> float:
    """How much earlier than assumed the voltages seem to act, in half samples: regression of the residuals on the
    change that half a sample makes in the outputs, less the part that the parameters could explain.

    Half a sample earlier is a held mean of the voltages at a sample and the next, which reuses compiled programs.
    """
    means = with_timing(given, STRAIGHT).problem
    means = replace(means, tape=replace(means.tape, rise=None))
    sooner, evaluation = polish(means, fit.optimum, steps=0).evaluation.seen, fit.evaluation
    scale = given.problem.tape.weight / fit.noise[:, None]
    change = (sooner - evaluation.seen) * scale * given.problem.fitted_blocks[:, None, None]
    matrix = np.asarray(
        normal_matrix(evaluation._replace(residuals=change), means.tape, means.fitted_runs)
    )
    hessian, slope = matrix[:-1, :-1], matrix[:-1, -1]
    own = matrix[-1, -1] - slope @ np.linalg.pinv(hessian, hermitian=True) @ slope
    along = -float(jnp.sum(evaluation.residuals * change))
    return along / own if own > 0 else 0.0


def with_timing(given: Prepared, timing: Timing) -> Prepared:
    """The runs with voltages of this timing."""
    tape = given.problem.tape
    runs = [uniform(_retimed(run, k, tape, timing)) for k, run in enumerate(given.runs)]
    driven = Tape.from_recordings(runs, straight=timing.straight, reading=timing.reading)
    names = ("value", "load", "rise", "reading")
    tape = replace(tape, **jax.tree.map(jnp.asarray, {n: getattr(driven, n) for n in names}))
    problem = replace(given.problem, tape=tape)
    acting = given._replace(runs=runs, problem=problem, timing=timing)
    # what acts during the first sample was not recorded: without outputs there, the initial state makes up for it
    return without_ends(acting) if timing.ahead < 0 else acting


def _retimed(run: Recording, k: int, tape: Tape, timing: Timing) -> Recording:
    """The record of a run with its voltages, and its loads if the timing says so, moved to the samples where they act.

    Voltages of an even clock are taken from the tape, where their noise may have been removed.
    """
    if run.drive != "voltage":
        return run.recorded
    even = run.resampled_from is None
    voltage = tape.samples_of(k, tape.value, len(run)) if even else run.recorded.voltage
    run, last = run.recorded, len(run.recorded) - 1
    rows = np.clip(np.arange(len(run)) + timing.ahead, 0, last)
    run = attrs.evolve(run, voltage=np.asarray(voltage)[rows])
    if not timing.load or run.load is None:
        return run
    # a load varies slowly enough to be held at its means instead of going straight
    ahead = np.minimum(rows + 1, last) if timing.straight else rows
    return attrs.evolve(run, load=(run.load[rows] + run.load[ahead]) / 2)
