"""Models fitted to the same runs, compared by the squares of what each leaves, made white by one filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..identify.generalised_least_squares import residuals_of, sharpened, squares_of
from ..identify.noise_model import Whitener, whitener
from .effect_relations import is_within
from .model import Model

# Models whose criterion is nearer than this are not told apart
MARGIN = 8.0
# Squares, in noise variances, for which no model is fitted another step
WORTH = 0.1
# A model that leaves so many times the squares of another one is no match for it, whatever a filter makes of either
FAR = 3.0


class Fitted(NamedTuple):
    """A model among others fitted to the same runs, and how well it does by a common filter of the noise."""

    model: Model
    squares: float
    criterion: float  # squares and the price of every parameter; less is better


class Comparison:
    """Models and filters so far; each model is fitted once by each filter."""

    def __init__(self) -> None:
        self._filters: dict[Model, Whitener] = {}
        self._fitted: dict[tuple[Model, Whitener], Fitted] = {}

    def ranked(self, models: Sequence[Model], white: Whitener) -> list[Fitted]:
        """By the squares of what each leaves when fitted to residuals that a filter makes white, the best first.

        One that leaves far more than another of what is measured is out of the question: filters pass none of what
        changes slowly.
        """
        least = min(m.fit.fitness for m in models)
        fitted = [
            self.left(m, white) if m.fit.fitness < FAR * least else Fitted(m, np.inf, np.inf)
            for m in models
        ]
        return sorted(fitted, key=lambda f: f.criterion)

    def left(self, model: Model, white: Whitener) -> Fitted:
        """A model fitted to what a filter makes white of what it leaves."""
        key = model, white
        if key not in self._fitted:
            given, polished = sharpened(model.given, model.fit, white, WORTH)
            squares = squares_of(given, polished)
            samples = np.count_nonzero(given.problem.tape.weight)
            price = len(given.problem.parameters.names) * np.log(samples)
            self._fitted[key] = Fitted(model, squares, squares + price)
        return self._fitted[key]

    def white(self, model: Model) -> Whitener:
        """The filter that makes white what a model leaves."""
        if model not in self._filters:
            self._filters[model] = whitener(residuals_of(model.given, model.fit))
        return self._filters[model]


def plainest(ranked: Sequence[Fitted]) -> Model:
    """The best model, or a simpler one that it contains and that the data do not tell from it."""
    best = ranked[0]
    for other in ranked[1:]:
        within = is_within(set(other.model.effects), set(best.model.effects))
        if within and other.criterion < best.criterion + MARGIN:
            return other.model
    return best.model
