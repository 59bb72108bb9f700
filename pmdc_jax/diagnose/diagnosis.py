"""What a diagnosis returns: plain records, read by the command line and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from attrs import frozen

from ..identify.identification import Estimate, Identification, Role

Verdict = Literal["none_detected", "named", "ambiguous", "not_in_library"]


# Sensors' own ways, and formulas that are not quite nature's, leave up to 1.4 times the noise in the electrical
# equation; what is not in the library, such as a mean of many samples of the current, three times and more
MAX_ELECTRICAL = 3.0
# ... or more than a trace, and more than this share of what the motor without effects leaves: those that were added
# are then not what is missing there
TRACE_OF_ELECTRICAL, UNEXPLAINED_ELECTRICAL = 1.5, 0.5
# Hold-outs that are missed by so many times what the fitted runs are show what those do not
BEYOND = 2.5
# ... or the effects that were added make them worse by this factor
WORSE = 1.1


@frozen
class EffectFound:
    """An effect that the data ask for: its parameters, and how sure it is that it is there."""

    name: str
    equation: str
    parameters: Mapping[str, Estimate]
    p_value: float  # of the data if the effect were not there
    also_possible: tuple[str, ...] = ()  # sets such as "coulomb_friction + constant_load"


@frozen
class Region:
    """A stretch of one variable in which one equation of the motor without effects is off."""

    equation: str  # "mechanical" or "electrical"
    variable: str  # "speed", "current", "voltage", "time"
    region: tuple[float, float]  # rad/s, A, V, or share of a run
    z: float  # the misfit there over its standard error, of the largest size in the region


@frozen
class LearnedCurve:
    """A term of one equation as the data draw it, whatever it may be: (knots,) arrays, SI."""

    equation: str
    variable: str
    unit: str  # of `value`: "N m" opposing motion, or "V" at the terminals
    x: np.ndarray
    value: np.ndarray
    stderr: np.ndarray
    p_value: float
    reverses: bool  # turns with the direction of motion, as friction does


@frozen
class Gap:
    """Root mean squares of the noise-scaled residual over both outputs; a perfect model has 1."""

    before: float
    after: float
    floor: float


@frozen
class NextExperiment:
    """A run that would tell the rivals apart, and how likely it is to."""

    why: str
    description: str
    power: float
    time: np.ndarray
    voltage: np.ndarray


@frozen
class Detectable:
    """The smallest amplitude of an effect that these runs would have shown, nine times of ten."""

    effect: str
    parameter: str
    amplitude: float
    unit: str


@frozen
class Diagnosis:
    """Which effects the motor without effects lacked, where that shows, and the completed motor."""

    verdict: Verdict
    effects: tuple[EffectFound, ...]
    where: tuple[Region, ...]
    gap: Mapping[Role, Gap]
    gap_of_run: Mapping[str, Gap]
    closed_fraction: float | None  # of the gap, on hold-outs where there are any
    next_experiment: NextExperiment | None
    curves: tuple[LearnedCurve, ...]  # what is left, where something outside the library is
    detectable: tuple[Detectable, ...]
    base: Identification  # without effects
    final: Identification  # with the effects that were found
    p_nothing: float  # of the data if nothing were missing
    # what the electrical equation leaves over what the sensors' white noise would; see `balance.electrical_misfit`
    electrical_misfit: float
    electrical_misfit_before: float  # the same without effects
    seconds: Mapping[str, float]

    @property
    def breaks_electrical_equation(self) -> bool:
        """Whether what is left can come neither from any torque nor from the effects that were added."""
        return breaks_electrical_equation(self.electrical_misfit_before, self.electrical_misfit)

    @property
    def beyond_fitted(self) -> float | None:
        """By how many times more the hold-outs are missed than the fitted runs, where that is too much to be the same
        motor; else None."""
        return beyond_fitted(self.gap)


def breaks_electrical_equation(before: float, after: float) -> bool:
    """See `Diagnosis.breaks_electrical_equation`; the misfits before and after effects were added."""
    unexplained = after**2 - 1 > UNEXPLAINED_ELECTRICAL * (before**2 - 1)
    return after > MAX_ELECTRICAL or (after > TRACE_OF_ELECTRICAL and unexplained)


def beyond_fitted(gap: Mapping[Role, Gap]) -> float | None:
    """See `Diagnosis.beyond_fitted`."""
    if "holdout" not in gap:
        return None
    # fitted runs of a simulation are missed by next to nothing, and less than the noise says nothing
    ratio = gap["holdout"].after / max(gap["train"].after, 1.0)
    return ratio if ratio > BEYOND else None


def unlike_held_out(gap: Mapping[Role, Gap]) -> bool:
    """Whether hold-outs show that something is missing of which the fitted runs do not tell."""
    return beyond_fitted(gap) is not None or worse_held_out(gap)


def worse_held_out(gap: Mapping[Role, Gap]) -> bool:
    """Whether the effects that were added make hold-outs worse: then others are missing that look alike in the fitted
    runs."""
    return "holdout" in gap and gap["holdout"].after > WORSE * gap["holdout"].before
