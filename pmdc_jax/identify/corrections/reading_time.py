"""Outputs that are read some time after the voltage of their sample was applied, or a voltage that acts some time after
it was recorded: a control loop that applies a voltage, waits, and then reads its sensors, or a recorder that is not
synchronised with the supply. The instant is fitted together with the motor.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..fit.fitted_runs import FittedRuns
from ..fit.likelihood import leaves_only_noise
from ..fit.polish import Fit
from ..prepare import Prepared
from ..problem import Nuisance, Problem, evaluate

# Refits end when the instant of reading moves by less than this, in samples
TOLERANCE = 2e-4
MAX_REFITS = 12
# Change of the instant by which the outputs are differentiated, in samples
DIFFERENCE = 1e-4
# Least distance of the instant from a sample, in samples
MARGIN = 0.005


def with_fitted_reading(fitted: FittedRuns) -> FittedRuns:
    """The runs with the instant of reading fitted, as a nuisance parameter, and the fit to them; both unchanged where
    the outputs are read at the samples.

    Where something else is missing from the motor, the instant stays: it would move to make up for that.
    """
    instant = fitted.prepared.timing.reading
    if instant is None:
        return fitted
    fitted = moved = _with_nuisance(*fitted)
    for _ in range(MAX_REFITS):
        before, instant = instant, _better_instant(moved.problem, moved.fit)
        moved = _with_nuisance(_read_at(moved.prepared, instant), moved.fit)
        if abs(instant - before) < TOLERANCE:
            break
    return moved if leaves_only_noise(moved) else fitted


def _with_nuisance(prepared: Prepared, fit: Fit) -> FittedRuns:
    """The runs with the instant of reading as a nuisance parameter, and the fit to them."""
    nuisance = Nuisance(change_by_reading(prepared.problem, fit)[..., None], fit.noise)
    return FittedRuns.polished(prepared.with_problem(nuisance=nuisance), fit.optimum)


def change_by_reading(problem: Problem, fit: Fit) -> Float[Array, "blocks 2 samples"]:
    """Derivative of the outputs, A and rad/s, by the instant of reading, in samples; zero at the first two samples of a
    run, where the initial state can make up for it."""

    def seen(difference: float) -> Float[Array, "blocks 2 samples"]:
        reading = jnp.asarray(problem.tape.reading) + difference
        read = replace(problem, tape=replace(problem.tape, reading=reading))
        return evaluate(read, fit.unknowns).simulated

    change = (seen(DIFFERENCE) - seen(-DIFFERENCE)) / (2 * DIFFERENCE)
    return change.at[jnp.asarray(problem.tape.begins), :, :2].set(0.0)


def _better_instant(problem: Problem, fit: Fit) -> float:
    """When the residuals of a fit say that the outputs were read. Its parameters do not respond, because their
    derivatives are orthogonal to the `change`."""
    assert problem.nuisance is not None
    tape, change = problem.tape, problem.nuisance.responses[..., 0]
    scale = tape.weight / fit.noise[:, None] * problem.fitted_blocks[:, None, None]
    residual, column = (tape.measured - fit.evaluation.simulated) * scale, change * scale
    later = float(jnp.sum(residual * column) / jnp.sum(column**2))
    return float(np.clip(float(jnp.asarray(tape.reading)) + later, MARGIN, 1 - MARGIN))


def _read_at(prepared: Prepared, reading: float) -> Prepared:
    """The runs with the outputs read after this share of a sample."""
    timing = prepared.timing._replace(lead=prepared.timing.ahead + reading)
    return prepared.with_tape(reading=jnp.asarray(reading))._replace(timing=timing)
