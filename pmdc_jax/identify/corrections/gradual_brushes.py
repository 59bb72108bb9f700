"""A brush drop that sets in gradually with the current, where the runs show that it does.

Taken for constant, a drop whose onset is a considerable part of the currents biases R, and with it the rest.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ...effects import BrushVoltageDrop, GradualBrushDrop
from ...runtime.threads import map_in_threads
from ..fit.fitted_runs import FittedRuns
from ..fit.gauss_newton import TRIAL_TOLERANCE
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, leaves_only_noise, negative_log_likelihood
from ..fit.polish import fit_at, polish, reweighted
from ..fit.refine import Optimum
from ..prepare import Prepared

# Currents of the onset that are tried, over the root mean square of those measured
ONSETS = (0.02, 0.06, 0.2)
# Fastest rate of a gradual drop, times the shortest sample time, from which a fit starts, and where it may end: a
# steeper one is hardly different from a constant one, and would need too many steps in a sample
MAX_RATE, MAX_FITTED_RATE = 30.0, 60.0
# Gauss-Newton steps, slow where the onset is steep, after which a gradual drop must fit better than a constant one
FIRST_STEPS = 4
ONSET = f"{GradualBrushDrop.name}.onset_A"


def with_gradual_brushes(fitted: FittedRuns) -> FittedRuns:
    """The runs with a brush drop that sets in gradually, and the fit to them; both unchanged unless that is clearly
    likelier than a drop that is constant from zero current on, or where that leaves nothing but noise."""
    prepared, problem = fitted.prepared, fitted.problem
    if BrushVoltageDrop not in problem.parameters.effects or not problem.samples[0] > 0 or leaves_only_noise(fitted):
        return fitted
    onsets = float(problem.measured_rms[0]) * np.array(ONSETS)
    kinds = [GradualBrushDrop if kind is BrushVoltageDrop else kind for kind in problem.parameters.effects]
    gradual = prepared.with_effects(kinds)
    starts = [_start(gradual, fitted, onset) for onset in onsets if _rate(fitted, onset) < MAX_RATE]
    if not starts:
        return fitted
    at_starts = map_in_threads(lambda start: fit_at(gradual.problem, start), starts)
    nearest = min(at_starts, key=lambda fit: fit.cost)
    begun = polish(gradual.problem, nearest.optimum, FIRST_STEPS, TRIAL_TOLERANCE, reweighted(gradual.problem, nearest))
    if begun.cost >= fitted.fit.cost:  # a local optimum: a steep onset is as good as a constant drop
        return fitted
    best = FittedRuns.polished(gradual, begun.optimum)
    if _rate(best, best.problem.parameters.value(ONSET, np.asarray(best.fit.coordinates))) > MAX_FITTED_RATE:
        return fitted
    gain = negative_log_likelihood(fitted) - negative_log_likelihood(best)
    return best if gain > MIN_LOG_LIKELIHOOD_GAIN else fitted


def _rate(fitted: FittedRuns, onset: float) -> float:
    """The fastest rate of a drop as fitted, with its onset in A, times the shortest sample time."""
    motor, tape = fitted.problem.parameters(fitted.fit.coordinates), fitted.problem.tape
    drop = motor.effect_named(BrushVoltageDrop.name)
    assert isinstance(drop, BrushVoltageDrop | GradualBrushDrop)
    rate = GradualBrushDrop(drop.voltage_V, jnp.asarray(onset)).fastest_rate(motor, jnp.zeros(()))
    return float(rate * np.min(np.asarray(tape.sample_time)))


def _start(gradual: Prepared, fitted: FittedRuns, onset: float) -> Optimum:
    """Where a fit with a gradual drop starts: at the fit with a constant one, with an onset in A."""
    names = fitted.problem.parameters.names
    values = dict(zip(names, np.asarray(fitted.fit.coordinates), strict=True)) | {ONSET: np.log(onset)}
    coordinates = jnp.asarray([values[name] for name in gradual.problem.parameters.names])
    at_constant = fitted.fit.optimum
    return at_constant._replace(unknowns=at_constant.unknowns._replace(coordinates=coordinates), at_bound=())
