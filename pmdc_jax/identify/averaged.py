"""A speed that is a difference of angles over two samples, and so a mean: taken for what it is.

Where the motor speeds up or slows down within some samples such a mean rounds its motion, as a soft shaft might. What
it does, (w(k-1) - 2 w(k) + w(k+1)) / 6 to third order, is recognised by its size and undone: the derivative of a cubic
spline through the same angles is the speed that has this mean.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_banded

from .colour import Series, whitener
from .noise import quantum
from .prepare import Prepared
from .refine import Polished, polish
from .sharpen import residuals_of, series_of, training_runs

# What a sensor that makes w + a h w' + b h^2 w'' / 6 of the speed w, sampled every h, has for a and b: a mean from the
# sample before to the one after; the speed itself, and a mean over the last sample, which is late by half of it
MEAN, OTHERS = np.array([0.0, 1.0]), np.array([[0.0, 0.0], [-0.5, 1.0]])
# A mean over two samples must be this much likelier than those, by the logarithm, the smaller one where the speed moves
# by steps, as counts of an encoder do; and be as likely as this itself
LIKELIER, IF_COUNTED, LIKELY = 30.0, 1.0, 12.0


def without_averaging(given: Prepared, fit: Polished) -> tuple[Prepared, Polished]:
    """The runs with the speed itself where a mean over two samples was recorded, and the fit to them.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if nothing was found.
    """
    found, information = _regressed(given, fit)
    unlikely, *of_others = (
        float((found - x) @ information @ (found - x)) / 2 for x in (MEAN, *OTHERS)
    )
    enough = IF_COUNTED if _is_counted(given) else LIKELIER
    if unlikely > LIKELY or min(of_others) - unlikely < enough:
        return given, fit
    tape = given.problem.tape
    measured = np.array(tape.measured)
    for run in range(tape.runs):
        mine = np.asarray(tape.run) == run
        known = np.asarray(tape.weight)[mine, 1].ravel() > 0
        if known.any():
            speed = measured[mine, 1].ravel()
            speed[known] = undone(speed[known])
            measured[mine, 1] = speed.reshape(-1, measured.shape[2])
    problem = replace(given.problem, tape=replace(tape, measured=jnp.asarray(measured)))
    return given._replace(problem=problem, averaged=True), polish(problem, fit.refined)


def _is_counted(given: Prepared) -> bool:
    """Whether all speeds move by steps."""
    speeds = [run.speed for run in given.training if run.speed is not None]
    return all(quantum(np.diff(speed[~np.isnan(speed)])) > 0 for speed in speeds)


def undone(mean: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """The signal of which (s(k-1) + 4 s(k) + s(k+1)) / 6 is given; its ends are as given."""
    bands = np.repeat([[1 / 6], [4 / 6], [1 / 6]], len(mean), axis=1)
    bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
    return solve_banded((1, 1), bands, mean)


def _regressed(
    given: Prepared, fit: Polished
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """How much of what makes a speed late, and of what a mean over two samples does, is in the residuals; and the
    inverse of the covariance of both.

    By regression of every run's white residuals on them, beside the motor's parameters and what belongs to the run.
    """
    tape = given.problem.tape
    jacobian = np.asarray(fit.evaluation.jacobian) * fit.noise[:, None, None]
    gradient, information = np.zeros(2), np.zeros((2, 2))
    for run, residual in zip(training_runs(given), residuals_of(given, fit), strict=True):
        if 1 not in residual.kind[1]:
            continue
        speed = series_of(tape, run, np.asarray(fit.evaluation.seen)).values[:, -1]
        sensed = np.zeros((*residual.values.shape, 2))
        sensed[:, -1, 0] = np.gradient(speed)
        sensed[1:-1, -1, 1] = np.diff(speed, 2) / 6
        moved = series_of(tape, run, jacobian).values
        columns = np.concatenate([residual.values[..., None], sensed, moved], -1)
        white = whitener([residual])(0, Series(columns, residual.known, residual.kind))
        left = white[:, :3] - white[:, 3:] @ np.linalg.lstsq(white[:, 3:], white[:, :3])[0]
        gradient += left[:, 1:].T @ left[:, 0]
        information += left[:, 1:].T @ left[:, 1:]
    return np.linalg.lstsq(information, gradient)[0], information
