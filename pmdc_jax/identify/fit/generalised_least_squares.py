"""The last fit: generalised least squares, with whitened residuals, where those of plain least squares are coloured.

Where a torque fluctuates, plain least squares gives too much weight to the slow part of the residuals, which is mostly
noise: with a torque noise of 20 ms correlation time, this fit has 1/7 of its scatter in R, 1/3 in L, 0.6 in Kt and J.

**Source**: Aitken, Proceedings of the Royal Society of Edinburgh 55 (1936), with a filter estimated from the residuals
of plain least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ...recordings.readings import reading_interval
from ...simulate import Tape
from ..noise.noise_model import Series, Whitener
from ..noise.sensor_noise import MIN_RELATIVE_NOISE
from ..noise.whitening import CHUNK, Whitening
from ..prepare import Prepared
from .fitted_runs import FittedRuns
from .gauss_newton import TOLERANCE
from .polish import Fit, fit_at, polish, reweighted

# Gauss-Newton steps at most from a plain fit to one with whitened residuals
MAX_STEPS = 8
# Largest sum of plain squared residuals of the whitened fit, over that of plain least squares
MAX_FITNESS_RATIO = 1.1


def last_fit(plain: FittedRuns, start: Fit, white: Whitener) -> FittedRuns:
    """The fit with whitened residuals, from a `start` near it; the plain fit if its residuals are white already.

    The plain fit is also kept where the other one reproduces the runs clearly worse, because the motor has an effect
    that the model lacks or a formula is only approximate: the filter then takes what is missing for noise. So it is
    with a sensor slower than the log: the other one would use nothing but its readings.
    """
    if white.is_white or _is_exact(plain) or is_sparse(plain.prepared):
        return plain
    whitened = fit_whitened(plain.prepared, start, white)
    fitness = fit_at(plain.problem, whitened.fit.optimum).fitness  # without whitening
    return whitened if fitness < MAX_FITNESS_RATIO * plain.fit.fitness else plain


def _is_exact(fitted: FittedRuns) -> bool:
    """Whether the residuals are only rounding errors, as in a fit to a simulation without noise."""
    measured = fitted.problem.samples > 0
    least = MIN_RELATIVE_NOISE * fitted.problem.measured_rms
    return bool(np.all(fitted.fit.noise[measured] < 2 * least[measured]))


def is_sparse(prepared: Prepared) -> bool:
    """Whether a training run has a sensor slower than the log."""
    tape = prepared.problem.tape
    return any(reading_interval(_known(tape, run)) > 1 for run in prepared.training_indices)


def fit_whitened(
    prepared: Prepared, start: Fit, white: Whitener, tolerance: float = TOLERANCE, give_up_above: float = np.inf
) -> FittedRuns:
    """The problem with whitened residuals, and its solution started from a plain fit nearby.

    **Arguments**: `tolerance` and `give_up_above` as of `polish`.
    """
    prepared = with_whitening(prepared, white)
    at_start = reweighted(prepared.problem, start)
    fit = polish(prepared.problem, start.optimum, MAX_STEPS, tolerance, at_start, give_up_above)
    return FittedRuns(prepared, fit)


def with_whitening(prepared: Prepared, white: Whitener) -> Prepared:
    """The problem with whitened residuals."""
    tape, noise = prepared.problem.tape, np.asarray(prepared.problem.noise)
    filters = [np.zeros((0, 2, 2))] * tape.runs
    # hold-out runs have no filter, only the scale of the noise
    scales = [np.diag(1 / noise)] * tape.runs
    for run, A, S in zip(prepared.training_indices, white.filters, white.scales, strict=True):
        both = np.ix_(*2 * [_measured_outputs(tape, run)])
        # from one reading to the next of a sensor slower than the log
        interval = reading_interval(_known(tape, run))
        filters[run], scales[run] = np.zeros((len(A) * interval, 2, 2)), np.zeros((2, 2))
        filters[run][interval - 1 :: interval, *both], scales[run][both] = A, S
    slow = None if white.slow is None else _on_tape(prepared, white.slow)
    whitening = Whitening.of([A[:CHUNK] for A in filters], scales, tape.weight, tape.run, slow)
    return prepared.with_problem(whitening=whitening)


def _on_tape(
    prepared: Prepared, of_runs: Sequence[Float[np.ndarray, "_ _ waves"]]
) -> Float[np.ndarray, "blocks 2 samples waves"]:
    """Signals of the training runs, laid out like the tape."""
    tape = prepared.problem.tape
    signal = np.zeros((*tape.weight.shape, of_runs[0].shape[-1]))
    for run, values in zip(prepared.training_indices, of_runs, strict=True):
        both = np.zeros((len(values), 2, values.shape[-1]))
        both[:, _measured_outputs(tape, run)] = values
        blocks = tape.blocks_of(run)
        signal[blocks] = np.moveaxis(both.reshape(int(blocks.sum()), -1, *both.shape[1:]), 1, 2)
    return signal


def residuals_of(prepared: Prepared, fit: Fit) -> list[Series]:
    """Measured minus simulated outputs, A and rad/s, of each training run in the order of time."""
    signal = -np.asarray(fit.evaluation.residuals) * fit.noise[:, None]
    return [series_of(prepared.problem.tape, run, signal) for run in prepared.training_indices]


def series_of(tape: Tape, run: int, signal: np.ndarray) -> Series:
    """The part of a signal (blocks, 2, samples, ...) of one run, in the order of time, for its measured outputs; with a
    sensor slower than the log only at its readings."""
    part = np.moveaxis(signal[tape.blocks_of(run)], 1, 2)
    return series_of_samples(tape, run, part.reshape(-1, *part.shape[2:]))


def series_of_samples(tape: Tape, run: int, values: Float[np.ndarray, "samples 2 ..."]) -> Series:
    """The same from the values of one run, in the order of time."""
    outputs, known = _measured_outputs(tape, run), _known(tape, run)
    values, interval = values[:, outputs], reading_interval(known)
    if interval > 1:
        values, known = values[known], known[known]
    return Series(values, known, (interval * tape.sample_time_of(run), tuple(int(c) for c in outputs)))


def _known(tape: Tape, run: int) -> Bool[np.ndarray, " samples"]:
    """Which samples of a run have all outputs that it has measured."""
    weight = np.moveaxis(np.asarray(tape.weight)[tape.blocks_of(run)], 1, 2).reshape(-1, 2) > 0
    return np.asarray(weight[:, _measured_outputs(tape, run)].all(1))


def _measured_outputs(tape: Tape, run: int) -> np.ndarray:
    """Indices of the outputs that a run has measured."""
    weight = np.asarray(tape.weight)[tape.blocks_of(run)]
    return np.flatnonzero(weight.any((0, 2)))
