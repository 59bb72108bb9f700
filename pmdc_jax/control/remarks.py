"""What a user is told about a tuning: unmet requirements and warnings."""

from __future__ import annotations

from collections.abc import Iterator

from ..motor import Motor
from ..motor_file import Uncertainty
from .evaluation import SMALL_STEP
from .metrics import BAND
from .specification import MAX_SENSITIVITY
from .tuning import Tuning

# Thresholds for a message: overshoot of the small step, over the larger of the allowed overshoot and the overshoot of
# the full step; peak sensitivity, over its default limit; and current, over its limit.
OVERSHOOT_TO_REPORT = 1.2
SENSITIVITY_TO_REPORT = 1.1
CURRENT_TO_REPORT = 1.02
KB_CHANGE_TO_SURVIVE = 0.15  # share of Kb by which it may be smaller than known, when magnets are hot
# Kt over Kb, or its inverse, from which one of them must be in another unit: in SI they differ by iron losses
CONSTANTS_RATIO_TO_REPORT = 3.0


def remarks(result: Tuning, uncertainty: Uncertainty | None) -> Iterator[str]:
    """Messages on unmet requirements, and warnings; `uncertainty` is that of the motor's file."""
    yield from _undetermined_remark(uncertainty)
    yield from _unmet_requirements(result)
    yield from _constants_remark(result.motor)
    yield from _small_step_remark(result)
    yield from _quantum_remark(result)
    peak = result.margins.sensitivity_peak
    if peak is not None and peak > SENSITIVITY_TO_REPORT * MAX_SENSITIVITY:
        yield f"the loop has small stability margins: its sensitivity peak is {peak:.2f}"
    limit = result.requirements.current_limit
    if limit is not None:
        yield from _current_limit_remarks(result, limit)


def _current_limit_remarks(result: Tuning, limit: float) -> Iterator[str]:
    """Messages where the current exceeds its limit, and where that limit leaves no room for another Kb."""
    motor = result.motor
    if result.peak_current > CURRENT_TO_REPORT * limit:
        predicted = "that of the motor without its effects" if motor.effects else "what it predicts for one instant"
        yield (
            f"the current reaches {result.peak_current:.3g} A in simulation, beyond its limit of {limit:g} A, because"
            f" the controller limits {predicted}: choose a lower limit"
        )
    share = float(motor.R) * limit / abs(float(motor.Kb) * result.setpoint)
    if share < KB_CHANGE_TO_SURVIVE and not result.hardware.measures_current:
        yield (
            f"the current limit relies on the back-EMF: with Kb {100 * share:.2g} % smaller, as of hot magnets, the"
            " controller could not brake from the set point. Measure the current, or choose a larger limit"
        )


def _undetermined_remark(uncertainty: Uncertainty | None) -> Iterator[str]:
    """A message on the parameters that no recording determined."""
    if uncertainty is not None and uncertainty.undetermined:
        yield (
            f"the recordings did not determine {', '.join(uncertainty.undetermined)} of this motor: the values in the"
            " file are used as they are"
        )


def _constants_remark(motor: Motor) -> Iterator[str]:
    """A message where the constants of torque and back-EMF cannot be those of one motor."""
    ratio = float(motor.Kt / motor.Kb)
    if max(ratio, 1 / ratio) > CONSTANTS_RATIO_TO_REPORT:
        yield (
            f"Kt is {ratio:.2g} times Kb, whereas they are about equal in SI (N m/A and V s/rad): check their units in"
            " the motor file"
        )


def _unmet_requirements(result: Tuning) -> Iterator[str]:
    """Messages where settling or overshoot miss the specification."""
    overshoot, settling = result.metrics["Overshoot"], result.metrics["SettlingTime"]
    requirements = result.requirements
    max_settling, max_overshoot = requirements.max_settling, requirements.allowed_overshoot
    if settling is None:
        yield "the loop does not settle: try another controller or a shorter sample time"
    elif not result.margins.stable:
        yield "the loop is unstable and may oscillate within its limits, though a step settles: try another controller"
    elif max_settling is not None and settling > max_settling:
        yield f"settling takes {settling:.4g} s, longer than the required {max_settling:g} s"
    if overshoot is not None and overshoot > max_overshoot:
        yield f"overshoot is {overshoot:.3g} %, above the allowed {max_overshoot:g} %"


def _quantum_remark(result: Tuning) -> Iterator[str]:
    """A message where the speed sensor cannot tell whether the speed is within the settling band."""
    quantum, band = result.requirements.speed_step or 0.0, BAND * abs(result.setpoint)
    if quantum > 2 * band:
        yield (
            f"the speed sensor's step of {quantum:g} rad/s is wider than the settling band of ± {band:.2g} rad/s: the"
            " speed may wander by that step"
        )


def _small_step_remark(result: Tuning) -> Iterator[str]:
    """A message where a small step overshoots notably more than the step to the set point, and by more than the
    sensor's quantum."""
    overshoot = result.tuned.small_step["Overshoot"] or 0.0
    step = SMALL_STEP * result.setpoint
    allowed = OVERSHOOT_TO_REPORT * max(result.requirements.max_overshoot, result.metrics["Overshoot"] or 0.0)
    quantum = result.requirements.speed_step or 0.0
    if overshoot > allowed and overshoot / 100 * abs(step) > quantum:
        yield (
            f"a small step of {step:.3g} rad/s overshoots by {overshoot:.3g} %, more than the step to the set point:"
            " tune for a smaller set point if such steps matter"
        )
