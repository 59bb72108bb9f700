"""Models fitted to the same runs, compared by the squares of their residuals, whitened by one common filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...identify.fit.gauss_newton import TRIAL_TOLERANCE, squares_of_outputs
from ...identify.fit.generalised_least_squares import fit_whitened
from ...identify.fit.slow_torque import whitener_of
from ...identify.noise.noise_model import Whitener
from ...identify.prepare import Prepared
from ..hypotheses.effect_relations import is_simpler_form
from ..model import Model

# Models whose criteria (BIC, in noise variances) differ by less are equivalent
BIC_MARGIN = 8.0
# A model is not fitted to the end if its squares will exceed those with which it might compete by this, in noise
# variances: a probability below 1e-20
HOPELESS_EXCESS = 100.0
# A model that leaves so many times the unfiltered squares of another one is worse, whatever its filtered squares are
DECISIVE_RATIO = 3.0


class Fitted(NamedTuple):
    """A model among others fitted to the same runs, and how well it does by a common whitening filter."""

    model: Model
    squares: float  # sum of its squared white residuals
    # BIC: squares + (number of parameters) ln(number of measured values); less is better
    criterion: float


class Comparison:
    """Fits models by common whitening filters, each model once by each filter, and keeps the results."""

    def __init__(self) -> None:
        self._filters: dict[Model, Whitener] = {}
        self._fitted: dict[tuple[Model, Whitener], Fitted] = {}

    def ranked(self, models: Sequence[Model], white: Whitener, margin: float = BIC_MARGIN) -> list[Fitted]:
        """Models by their criteria when fitted to residuals whitened by one filter, the best first.

        One that leaves far more unfiltered squares than another is ruled out (infinite criterion): a whitening filter
        suppresses whatever changes slowly. Where the criterion will exceed the least by more than `margin`, and
        `HOPELESS_EXCESS`, the fit is given up.
        """
        fitted, least = [], np.inf
        by_fitness = sorted(models, key=lambda m: m.fit.fitness)
        for model in by_fitness:
            if is_decisively_better(by_fitness[0], model):
                fitted.append(Fitted(model, np.inf, np.inf))
                continue
            largest = _largest_squares(model.prepared, least, margin)
            fitted.append(self.fitted(model, white, largest))
            least = min(least, fitted[-1].criterion)
        return sorted(fitted, key=lambda f: f.criterion)

    def fitted(self, model: Model, white: Whitener, give_up_above: float = np.inf) -> Fitted:
        """A model fitted to its residuals whitened by a filter; `give_up_above`, a sum of squares, as of `polish`."""
        key = model, white
        if key in self._fitted:
            return self._fitted[key]
        prepared, polished = fit_whitened(model.prepared, model.fit, white, TRIAL_TOLERANCE, give_up_above)
        squares = float(squares_of_outputs(prepared.problem, polished.evaluation).sum())
        fitted = Fitted(model, squares, squares + _penalty(prepared))
        if squares <= give_up_above:
            self._fitted[key] = fitted
        return fitted

    def largest_squares(self, smaller: Prepared, model: Model, white: Whitener) -> float:
        """The largest sum of squares with which a smaller model may still compete with a model."""
        return _largest_squares(smaller, self.fitted(model, white).criterion, BIC_MARGIN)

    def filter_of(self, model: Model) -> Whitener:
        """The filter that whitens the residuals of a model."""
        if model not in self._filters:
            self._filters[model] = whitener_of(model.prepared, model.fit)
        return self._filters[model]


def _penalty(prepared: Prepared) -> float:
    """What the criterion adds to the squares for the number of parameters."""
    samples = prepared.problem.samples.sum()
    return float(len(prepared.problem.parameters.names) * np.log(samples))


def _largest_squares(prepared: Prepared, least: float, margin: float) -> float:
    """The largest sum of squares with which a fit may still compete with the least criterion, within a margin."""
    return least + margin + HOPELESS_EXCESS - _penalty(prepared)


def is_decisively_better(better: Model, worse: Model) -> bool:
    """Whether a model leaves so much less unfiltered squares than another that no filter need compare them."""
    return better.fit.fitness < worse.fit.fitness / DECISIVE_RATIO


def simplest_equivalent(ranked: Sequence[Fitted]) -> Model:
    """The best model, or one with an effect in a simpler form whose criterion is within `BIC_MARGIN` of the best."""
    best = ranked[0]
    for other in ranked[1:]:
        is_simpler = is_simpler_form(set(other.model.effects), set(best.model.effects))
        if is_simpler and other.criterion < best.criterion + BIC_MARGIN:
            return other.model
    return best.model
