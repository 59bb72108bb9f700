"""Evidence that rests on few moments: errors that are large now and then are no noise of one size.

A bridge that applies a voltage now sooner and now later, for instance, leaves large errors at its jumps and none
elsewhere. Whatever acts at these moments, too, seems to explain some of them, by more than its p-value allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import numpy as np
from jaxtyping import Float

from ...identify.noise.noise_model import Series, Whitener
from .regression import Block, Evidence, Regression
from .rows import Rows
from .signals import Signal, log_p_value

# Samples whose errors count as one: those of the same few samples, or while a motor answers to them
MOMENTS = (4, 64)
# Least share of a block's gain that counts as that of other moments
MIN_OTHER_SHARE = 0.1
# Logarithm of a p-value from which on evidence is looked at
NOTEWORTHY = np.log(0.01)


def log_p_of_strongest(signals: Sequence[Signal], rows: Sequence[Rows], white: Whitener, evidence: Evidence) -> float:
    """Natural logarithm of the smallest p-value of some signals, each corrected by its `dispersion_by_moments`."""
    strongest = 0.0
    for signal in sorted(signals, key=attrgetter("log_p")):
        if signal.log_p >= strongest:
            break
        log_p = signal.log_p
        if log_p < NOTEWORTHY:
            dispersion = dispersion_by_moments(signal.block, rows, white, evidence)
            log_p = log_p_value(signal.beyond_noise / dispersion, evidence.degrees_of_freedom(signal.block))
        strongest = min(strongest, log_p)
    return strongest


def dispersion_by_moments(block: Block, rows: Sequence[Rows], white: Whitener, evidence: Evidence) -> float:
    """How much larger the errors are where a block acts than elsewhere, as the factor by which that makes its gain
    larger than by chance; at least 1.

    The errors are those that remain with the block, so that one which explains them does not count against itself: as
    they would be if the block were fitted without the moment in question (the jackknife).

    **Source**: MacKinnon, White, "Some heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties", Journal of Econometrics 29 (1985), doi:10.1016/0304-4076(85)90158-7.
    """
    alone, beside = evidence.regress(), evidence.regress([block])
    products = []
    for k, run in enumerate(rows):
        before = _white_rest(run, k, white, evidence, alone, None)
        after = _white_rest(run, k, white, evidence, beside, block)
        explained = before - after
        outputs = run.fit.residual.values.shape[1]
        products.append(np.stack([explained * after, explained**2]).reshape(2, -1, outputs).sum(2))
    return max(1.0, *(_dispersion(products, samples) for samples in MOMENTS))


def _dispersion(products: Sequence[Float[np.ndarray, "2 _"]], samples: int) -> float:
    """The dispersion by moments of so many samples; `products` of each run, of what a block explains with the errors
    and with itself."""
    of_moments = [np.add.reduceat(run, np.arange(0, run.shape[1], samples), axis=1) for run in products]
    score, share = np.concatenate(of_moments, axis=1)
    if not (gain := float(share.sum())):
        return 1.0
    without = np.maximum(1 - share / gain, MIN_OTHER_SHARE)
    return float(np.square(score / without).sum()) / gain


def _white_rest(
    run: Rows, k: int, white: Whitener, evidence: Evidence, fit: Regression, block: Block | None
) -> Float[np.ndarray, " rows"]:
    """The whitened residuals of a run less all that is fitted with a block, or without any."""
    _, own, residual, _ = run.fit
    rest = run.without(k, fit, block, evidence.first_column) - run.late @ fit.late_readings
    together = np.concatenate([rest[..., None], own.values], -1)
    rest, *unknowns = white(k, Series(together, residual.known, residual.kind)).T
    return rest - np.array(unknowns).T @ np.linalg.lstsq(np.array(unknowns).T, rest)[0]
