"""The last fit: to residuals that a filter makes white, where those of plain least squares are not.

Where a torque fluctuates, plain least squares lets the slow part of the residuals, most of which is noise, outvote
the rest: in torque noise of 20 ms this fit has a seventh of its scatter in R, a third in L, six tenths in Kt and J.

**Source**: Aitken, Proceedings of the Royal Society of Edinburgh 55 (1936), with a filter estimated from the residuals
of plain least squares.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..simulate import Tape
from .noise import FLOOR
from .noise_model import Series, Whitener
from .polish import WORTH, Fit, polish, reweighted
from .prepare import Prepared
from .whitening import Whitening

# Gauss-Newton steps from one fit to white residuals to another
STEPS = 8
# A fit to white residuals may leave so many times the plain squares of the fit that leaves least of them
NEAR = 1.1


def last_fit(given: Prepared, plainly: Fit, near: Fit, white: Whitener) -> tuple[Prepared, Fit]:
    """The fit to residuals that a filter makes white, found from a fit `near` it, if plain least squares asks for it.

    Not where it is far from reproducing the runs as they are, as where the motor has an effect that the model lacks
    or a formula is not quite nature's: the filter then takes what is missing for noise.
    """
    if white.is_white or _is_exact(given, plainly):
        return given, plainly
    sharp = sharpened(given, near, white)
    as_it_is = polish(given.problem, sharp[1].optimum, steps=0).fitness
    return sharp if as_it_is < NEAR * plainly.fitness else (given, plainly)


def _is_exact(given: Prepared, fit: Fit) -> bool:
    """Whether nothing is left but rounding errors, as of a simulation without noise."""
    there = given.problem.samples > 0
    return bool(np.all(fit.noise[there] < 2 * FLOOR * given.problem.sizes[there]))


def sharpened(
    given: Prepared, near: Fit, white: Whitener, worth: float = WORTH
) -> tuple[Prepared, Fit]:
    """The problem of fitting to residuals that a filter makes white, and its solution from a plain fit nearby."""
    given = whitened(given, white)
    known = reweighted(given.problem, near)
    return given, polish(given.problem, near.optimum, STEPS, worth, known)


def squares_of(given: Prepared, polished: Fit) -> float:
    """The sum of squares that a fit leaves of the training runs."""
    residuals = np.asarray(polished.evaluation.residuals)
    return float(np.square(residuals[given.problem.fitted_blocks]).sum())


def whitened(given: Prepared, white: Whitener) -> Prepared:
    """The problem of fitting to residuals that a filter makes white."""
    tape, noise = given.problem.tape, np.asarray(given.problem.noise)
    filters = [np.zeros((0, 2, 2))] * tape.runs
    # hold-outs are nothing to learn a filter from
    scales = [np.diag(1 / noise)] * tape.runs
    for run, A, S in zip(training_runs(given), white.filters, white.scales, strict=True):
        both = np.ix_(*2 * [_outputs(tape, run)])
        filters[run], scales[run] = np.zeros((len(A), 2, 2)), np.zeros((2, 2))
        filters[run][:, *both], scales[run][both] = A, S
    whitening = Whitening.of(filters, scales, tape.weight, tape.run)
    return given._replace(problem=replace(given.problem, whitening=whitening))


def training_runs(given: Prepared) -> list[int]:
    """The runs that count."""
    return [run for run, role in enumerate(given.roles) if role == "train"]


def residuals_of(given: Prepared, fit: Fit) -> list[Series]:
    """What is measured less what is simulated, A and rad/s, of every training run in the order of time."""
    signal = -np.asarray(fit.evaluation.residuals) * fit.noise[:, None]
    return [series_of(given.problem.tape, run, signal) for run in training_runs(given)]


def series_of(tape: Tape, run: int, signal: np.ndarray) -> Series:
    """A signal (blocks, 2, samples, ...) of one run in the order of time, of the outputs that it has."""
    mine = tape.blocks_of(run)
    part = np.moveaxis(signal[mine], 1, 2)
    values = part.reshape(-1, *part.shape[2:])
    weight = np.moveaxis(np.asarray(tape.weight)[mine], 1, 2).reshape(-1, 2) > 0
    outputs = tuple(int(c) for c in _outputs(tape, run))
    kind = (tape.sample_time_of(run), outputs)
    return Series(values[:, list(outputs)], np.asarray(weight[:, list(outputs)].all(1)), kind)


def _outputs(tape: Tape, run: int) -> np.ndarray:
    """The outputs that a run has."""
    weight = np.asarray(tape.weight)[tape.blocks_of(run)]
    return np.flatnonzero(weight.any((0, 2)))
