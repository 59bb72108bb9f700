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

# A mean over two samples must be this much likelier than the speed itself, by the logarithm, the smaller one where the
# speed moves by steps, as counts of an encoder do; and what it does be of the size of one to within this
LIKELIER, IF_COUNTED = 30.0, 1.0
NEAR = 0.2


def without_averaging(given: Prepared, fit: Polished) -> tuple[Prepared, Polished]:
    """The runs with the speed itself where a mean over two samples was recorded, and the fit to them.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if nothing was found.
    """
    size, error = _size(given, fit)
    likelier = (2 * size - 1) / (2 * error**2)
    enough = IF_COUNTED if _is_counted(given) else LIKELIER
    if likelier < enough or abs(size - 1) > NEAR + 3 * error:
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


def _size(given: Prepared, fit: Polished) -> tuple[float, float]:
    """How much of what a mean over two samples does is in the residuals, and its standard error.

    By regression of every run's white residuals on it, beside the motor's parameters and what belongs to the run.
    """
    tape = given.problem.tape
    jacobian = np.asarray(fit.evaluation.jacobian) * fit.noise[:, None, None]
    weight = information = 0.0
    for run, residual in zip(training_runs(given), residuals_of(given, fit), strict=True):
        if 1 not in residual.kind[1]:
            continue
        seen = series_of(tape, run, np.asarray(fit.evaluation.seen)).values
        rounded = np.zeros_like(seen)
        rounded[1:-1, -1] = np.diff(seen[:, -1], 2) / 6
        moved = series_of(tape, run, jacobian).values
        columns = np.concatenate([residual.values[..., None], rounded[..., None], moved], -1)
        white = whitener([residual])(0, Series(columns, residual.known, residual.kind))
        left = white[:, :2] - white[:, 2:] @ np.linalg.lstsq(white[:, 2:], white[:, :2])[0]
        information += left[:, 1] @ left[:, 1]
        weight += left[:, 1] @ left[:, 0]
    if not information > 0:
        return 0.0, 1.0
    return float(weight / information), float(1 / np.sqrt(information))
