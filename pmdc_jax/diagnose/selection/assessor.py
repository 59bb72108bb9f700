"""Gathers the evidence against models."""

from __future__ import annotations

from ..evidence.assessment import Assessment, familywise_p_value
from ..evidence.screen import screen
from ..evidence.signals import signals
from ..hypotheses.library import Library
from ..model import MAX_EFFECTS, Model
from .compare import Comparison


class Assessor:
    """Gathers the evidence against a model, and keeps it: each model is assessed once."""

    def __init__(self, base: Model, library: Library, comparison: Comparison) -> None:
        """`base` is the motor without effects."""
        self.base, self.library, self.comparison = base, library, comparison
        self.assessments: dict[Model, Assessment] = {}

    def __call__(self, model: Model) -> Assessment:
        """The evidence against a model."""
        if model not in self.assessments:
            self.assessments[model] = self._assess(model)
        return self.assessments[model]

    def _assess(self, model: Model) -> Assessment:
        evidence = screen(model, self.library)
        candidate_signals, curve_signals = signals(evidence)
        count = len(evidence.candidates) + len(evidence.curves)
        count *= MAX_EFFECTS if model.effects else 1
        p_value = 1.0 if model.is_exact else familywise_p_value(candidate_signals, curve_signals, count)
        explained = 0.0
        if model.effects:
            base, fitted = (self.comparison.fitted(m, evidence.white) for m in (self.base, model))
            explained = base.squares - fitted.squares
        explained_unfiltered = self.base.fit.fitness - model.fit.fitness
        return Assessment(evidence, candidate_signals, curve_signals, p_value, explained, explained_unfiltered)
