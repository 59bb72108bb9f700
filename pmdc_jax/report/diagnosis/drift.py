"""How the parameters of the motor changed when effects were added."""

from __future__ import annotations

from typing import NamedTuple

from ...diagnose.diagnosis import Diagnosis
from ...identify.identification import Estimate
from ...words import enumerate_words
from ..notation import percent

# a parameter whose change in % is smaller is not mentioned
MIN_DRIFT = 1.0


class Drift(NamedTuple):
    """A parameter of the plain motor before and after the effects were added."""

    name: str
    before: Estimate
    after: Estimate

    @property
    def is_known(self) -> bool:
        """Whether the recordings determined it in both fits: a change from a limit of the search means nothing."""
        return {self.before.status, self.after.status} <= {"identified", "tied"}

    @property
    def percent(self) -> float | None:
        """The change in %, if it is known."""
        if not self.is_known or not self.before.value or self.after.value is None:
            return None
        return 100 * (self.after.value / self.before.value - 1)


def drifts(diagnosis: Diagnosis) -> list[Drift]:
    """Every parameter of the motor without effects, before and after these were added."""
    after = diagnosis.final.parameters
    return [Drift(name, estimate, after[name]) for name, estimate in diagnosis.base.parameters.items() if name in after]


def drift_words(one: Drift) -> str:
    """The change in per cent with its sign."""
    sign = "+" if (one.percent or 0.0) > 0 else ""
    return sign + percent(one.percent)


def drift_sentence(diagnosis: Diagnosis) -> str:
    """Which parameters the added effects changed most."""
    far = [one for one in drifts(diagnosis) if abs(one.percent or 0.0) > MIN_DRIFT]
    far = sorted(far, key=lambda one: -abs(one.percent or 0.0))[:3]
    if not far:
        return f"No parameter determined by both fits changed by more than {MIN_DRIFT:g} %."
    drifted = enumerate_words([f"{one.name} by {drift_words(one)}" for one in far])
    added = "it" if len(diagnosis.effects) == 1 else "them"
    return f"Adding {added} changed {drifted}."
