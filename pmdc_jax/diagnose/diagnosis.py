"""What a diagnosis returns: plain records, read by the command line and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from attrs import field, frozen
from jaxtyping import Float

from ..identify.identification import Estimate, Identification, Role, RunFit

Verdict = Literal["none_detected", "named", "ambiguous", "not_in_library"]


# Electrical misfit (`electrical_misfit`) that no torque and no effect of the library explains. Peculiarities of sensors
# and model-form error leave up to 1.4; what is not in the library, such as a current that is the mean of many samples,
# leaves 3 and more.
MAX_ELECTRICAL = 3.0
# The effects added are not what is missing if they leave an electrical misfit above this,
MAX_EXPLAINED_ELECTRICAL = 1.5
# whose excess over the noise, in squares, is more than this share of that of the motor without effects
MAX_ELECTRICAL_SHARE = 0.5
# Misfit of hold-outs over that of the fitted runs above which the hold-outs show something that the fitted runs do not
MAX_HOLDOUT_RATIO = 2.5
# ... unless the effects added leave no more than this share of the hold-outs' gap, in squares: their formulas, too, may
# be less exact where hold-outs go beyond the fitted runs
MAX_HOLDOUT_SHARE = 0.2
# Misfit of hold-outs after effects were added, over that before, above which these made them worse
MAX_HOLDOUT_GROWTH = 1.1
# Misfit of one fitted run over the largest of all others above which something happened in that run alone
OUTLIER_RATIO = 5.0
# ... and above which noise does not explain that it differs, even if it explains all that is left
DISTURBED_RATIO = 10.0


@frozen
class EffectFound:
    """An effect for which there is evidence: its parameters, and how certain it is."""

    name: str  # a key of `pmdc_jax.effects.EFFECTS`
    equation: str  # "electrical", "mechanical", "input" or "sensor"
    parameters: Mapping[str, Estimate]  # by field of the effect
    p_value: float  # of the data if the effect were not there


@frozen
class Region:
    """A stretch of one variable in which one equation of the motor without effects is off."""

    equation: str  # "mechanical" or "electrical"
    variable: str  # "speed", "current", "voltage", "time", "frequency"
    region: tuple[float, float]  # rad/s, A, V, share of a run, or Hz
    z: float  # misfit over its standard error where that is largest; for a frequency, amplitude over the level around


@frozen
class LearnedCurve:
    """An unknown term of one equation over a variable, as estimated from the data, in SI."""

    equation: str
    variable: str
    # of `value`: "N m" opposing motion, "V" at the terminals, "A" of the current that is read, or "" for a share of the
    # speed that is read
    unit: str
    x: Float[np.ndarray, " knots"]
    value: Float[np.ndarray, " knots"]
    stderr: Float[np.ndarray, " knots"]
    p_value: float
    reverses: bool  # changes sign with the direction of motion, as friction does


@frozen
class VaryingParameter:
    """A parameter of the motor that differs from run to run."""

    name: str
    by_run: Mapping[str, Estimate]  # of the runs that determine it, at least two
    p_value: float  # of the data if it were the same in all runs
    also_possible: tuple[str, ...]  # parameters whose variation would explain the runs as well
    fit: Mapping[str, RunFit]  # of every training run, simulated with its own value
    negative_log_likelihood: float  # negative logarithm of the likelihood of these, up to a constant


@frozen
class Gap:
    """Root mean squares of the noise-scaled residual over both outputs; a perfect model has 1."""

    before: float  # of the motor without effects
    after: float  # of the motor with the effects found
    floor: float  # what no model can close: 1, or `after` if that is less


@frozen
class NextExperiment:
    """A run that would distinguish the rivals, and the probability that it does."""

    why: str
    description: str
    power: float  # probability of distinguishing them, 0 to 1
    time: Float[np.ndarray, " samples"]  # s
    voltage: Float[np.ndarray, " samples"]  # V


@frozen
class Detectable:
    """The smallest amplitude of an effect that these runs would have shown with a probability of 90 %."""

    effect: str
    parameter: str
    amplitude: float
    unit: str


@frozen
class Diagnosis:
    """Which effects are missing from the motor without effects, where that shows, and the completed motor."""

    verdict: Verdict
    effects: tuple[EffectFound, ...]
    where: tuple[Region, ...]
    gap: Mapping[Role, Gap]
    gap_of_run: Mapping[str, Gap]
    # of the gap, in squares, on hold-outs where there are any; None without effects or gap
    closed_fraction: float | None
    rivals: tuple[tuple[str, ...], ...]  # other sets of effects that would explain the runs as well
    next_experiment: NextExperiment | None  # for the verdict "ambiguous", where a run was found
    # what is left, for the verdict "not_in_library" or where it is an error of a sensor
    curves: tuple[LearnedCurve, ...]
    detectable: tuple[Detectable, ...]
    base: Identification  # without effects
    final: Identification  # with the effects that were found
    p_nothing: float  # p-value of the data if nothing were missing
    # residual of the electrical equation over the sensors' white noise; see `electrical_misfit`
    electrical_misfit: float
    electrical_misfit_before: float  # the same without effects
    # whether what the final motor leaves is no more than noise may
    leaves_noise: bool = True
    varies: VaryingParameter | None = None  # what differs from run to run, if that is what is left
    # by training run: its misfit with a common value of what differs, and with its own
    gap_by_own_value: Mapping[str, Gap] = field(factory=dict)
    seconds: Mapping[str, float] = field(factory=dict)  # time taken: "identify", "name", "total"

    @property
    def breaks_electrical_equation(self) -> bool:
        """Whether the electrical equation is violated by more than any torque or the effects added can explain."""
        return breaks_electrical_equation(self.electrical_misfit_before, self.electrical_misfit)

    @property
    def beyond_fitted(self) -> float | None:
        """The misfit of the hold-outs over that of the fitted runs, if it is too large for one motor; else None."""
        return beyond_fitted(self.gap)

    @property
    def run_apart(self) -> tuple[str, float] | None:
        """The fitted run whose misfit is far larger than that of any other, and how many times; None without one, or if
        all that is left is white noise, which may be larger in one run."""
        leaves_more = self.final.missed or not self.leaves_noise or self.verdict == "not_in_library"
        name, ratio = _largest_misfit(self.gap_of_run, self.final)
        return (name, ratio) if leaves_more and ratio > OUTLIER_RATIO else None


def is_disturbed(gap_of_run: Mapping[str, Gap], final: Identification) -> bool:
    """Whether something happened in one fitted run that noise does not explain."""
    return bool(final.missed) and _largest_misfit(gap_of_run, final)[1] > DISTURBED_RATIO


def _largest_misfit(gap_of_run: Mapping[str, Gap], final: Identification) -> tuple[str, float]:
    """The fitted run with the largest misfit, and its ratio to the largest of all others: 1 for less than three."""
    fitted = [name for name, fit in final.fit.items() if fit.role == "train"]
    if len(fitted) < 3:
        return fitted[0], 1.0
    *_, second, worst = sorted(fitted, key=lambda name: gap_of_run[name].after)
    return worst, gap_of_run[worst].after / max(gap_of_run[second].after, 1e-300)


def share_left(before: float, after: float, floor: float = 1.0) -> float:
    """The share of a misfit above its floor, in squares, that is left; infinite if it was at the floor already."""
    open_before = before**2 - floor**2
    return (after**2 - floor**2) / open_before if open_before > 0 else np.inf


def breaks_electrical_equation(before: float, after: float) -> bool:
    """Whether the electrical equation is violated by more than any torque or the effects added can explain, by its
    misfits before and after they were added."""
    unexplained = share_left(before, after) > MAX_ELECTRICAL_SHARE
    return after > MAX_ELECTRICAL or (after > MAX_EXPLAINED_ELECTRICAL and unexplained)


def beyond_fitted(gap: Mapping[Role, Gap]) -> float | None:
    """The misfit of the hold-outs over that of the fitted runs, if it is too large for one motor; else None."""
    if "holdout" not in gap:
        return None
    # a misfit of the fitted runs below the noise, as of a noiseless simulation, says nothing
    ratio = gap["holdout"].after / max(gap["train"].after, 1.0)
    return ratio if ratio > MAX_HOLDOUT_RATIO else None


def holdouts_show_more(gap: Mapping[Role, Gap]) -> bool:
    """Whether hold-outs show that something is missing that the fitted runs do not show."""
    if beyond_fitted(gap) is None:
        return effects_worsen_holdouts(gap)
    return share_left(gap["holdout"].before, gap["holdout"].after) > MAX_HOLDOUT_SHARE


def effects_worsen_holdouts(gap: Mapping[Role, Gap]) -> bool:
    """Whether the effects added make hold-outs worse: the missing ones are then others that look alike in the fitted
    runs."""
    return "holdout" in gap and gap["holdout"].after > MAX_HOLDOUT_GROWTH * gap["holdout"].before
