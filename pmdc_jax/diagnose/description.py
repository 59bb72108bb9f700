"""What a diagnosis tells beside its verdict: the effects found, where the motor without them is off, what is left, and
what would have been detected."""

from __future__ import annotations

import numpy as np
from scipy import stats

from ..effects import EFFECTS
from ..identify.identification import Identification
from .diagnosis import Detectable, EffectFound, LearnedCurve, Region
from .evidence.assessment import FALSE_ALARM
from .evidence.regression import MIN_EIGENVALUE, Block
from .evidence.signals import Screen, log_p_value
from .hypotheses.curves import Curve
from .selection.naming import Naming

# A knot of a curve is part of a region if its misfit is so many standard errors
REGION_Z = 4.0
# Largest p-value of a curve whose regions are told, and most regions
REGION_P_VALUE, MAX_REGIONS = 1e-4, 12
# Most curves that are told
MAX_CURVES = 3
# Directions of a curve with a smaller eigenvalue, which the motor's own parameters can imitate, are no part of it
CURVE_EIGENVALUE = 1e-3
# Probability with which an effect of the amplitude called detectable is detected
DETECTION_PROBABILITY = 0.9


def effects_found(naming: Naming, final: Identification) -> tuple[EffectFound, ...]:
    """The effects of the chosen set, with their parameters and the p-value of the data without each."""
    return tuple(
        EffectFound(
            name,
            EFFECTS[name].equation,
            {f: final.parameters[f"{name}.{f}"] for f in naming.chosen.motor.effect_named(name).ranges},
            naming.p_without[name],
        )
        for name in naming.chosen.effects
    )


def rival_sets(naming: Naming) -> tuple[tuple[str, ...], ...]:
    """The other sets that explain the runs as well as the effects found, if any were."""
    rivals = naming.rivals if naming.chosen.effects else ()
    return tuple(dict.fromkeys(tuple(sorted(rival.effects)) for rival in rivals))


def regions_of_misfit(naming: Naming) -> tuple[Region, ...]:
    """Where the curves of the motor without effects are far from zero, and a line in frequency; at most `MAX_REGIONS`,
    the clearest first."""
    screen, line = naming.base_screen, naming.line
    base = screen.evidence.regress().squares
    regions = []
    for curve, block in zip(screen.curves, screen.curve_blocks, strict=True):
        if curve.per_run or curve.is_sensor_error:
            continue
        gain = base - screen.evidence.regress([block]).squares
        if log_p_value(gain, screen.evidence.degrees_of_freedom(block)) > np.log(REGION_P_VALUE):
            continue
        z = np.array([_z_of_column(screen, column) for column in block.columns])
        regions += _regions_of_curve(curve, z)
    if line is not None:
        region = (line.low, line.high)
        regions.append(Region("mechanical", "frequency", region, float(np.sqrt(line.height))))
    return tuple(sorted(regions, key=lambda r: -abs(r.z))[:MAX_REGIONS])


def _z_of_column(screen: Screen, column: int) -> float:
    """The misfit at one knot over its standard error; regressed alone, as neighbours would share what they explain."""
    fit = screen.evidence.regress([Block((column,))])
    error = float(fit.errors[0][0])
    return float(fit.coefficients[0][0]) / error if error > 0 else 0.0


def _regions_of_curve(curve: Curve, z: np.ndarray) -> list[Region]:
    """The stretches of neighbouring knots where a curve is clearly different from zero, with one sign."""
    knots, clear = curve.knots, np.abs(z) > REGION_Z
    regions, first = [], None
    for k in range(len(knots) + 1):
        inside = k < len(knots) and clear[k] and (first is None or z[k] * z[first] > 0)
        if first is not None and not inside:
            part = z[first:k]
            peak = float(part[np.argmax(np.abs(part))])
            ends = float(knots[max(first - 1, 0)]), float(knots[min(k, len(knots) - 1)])
            regions.append(Region(curve.equation, curve.variable, ends, peak))
            first = k if k < len(knots) and clear[k] else None
        elif inside and first is None:
            first = k
    return regions


def learned_curves(naming: Naming) -> tuple[LearnedCurve, ...]:
    """The curves that the data still show, at most `MAX_CURVES`, the most significant first."""
    screen = naming.chosen_screen
    if naming.p_nothing_more >= FALSE_ALARM:
        return ()
    base = screen.evidence.regress().squares
    learned = []
    for curve, block in zip(screen.curves, screen.curve_blocks, strict=True):
        least = CURVE_EIGENVALUE if curve.width > 1 else MIN_EIGENVALUE
        fit = screen.evidence.regress([block], min_eigenvalue=least)
        log_p = log_p_value(base - fit.squares, screen.evidence.degrees_of_freedom(block))
        value, error = fit.coefficients[0], fit.errors[0]
        if curve.per_run:  # of the run that shows it most clearly
            clearest = np.argmax(np.sum(np.square(value / np.maximum(error, 1e-300)), axis=1))
            value, error = value[clearest], error[clearest]
        estimated = LearnedCurve(
            curve.equation,
            curve.variable,
            curve.unit,
            curve.knots,
            curve.values(value),
            curve.errors(error),
            float(np.exp(log_p)),
            curve.reverses,
        )
        learned.append((log_p, estimated))
    return tuple(curve for _, curve in sorted(learned, key=lambda pair: pair[0])[:MAX_CURVES])


def detectable_effects(screen: Screen) -> tuple[Detectable, ...]:
    """The smallest amplitude of each effect that would be detected with `DETECTION_PROBABILITY`, if it is physical."""
    count = len(screen.candidates) + len(screen.curves)
    needed = max(
        stats.norm.isf(FALSE_ALARM / count / 2) + stats.norm.isf(1 - DETECTION_PROBABILITY), np.sqrt(screen.least_gain)
    )
    smallest: dict[str, Detectable] = {}
    for candidate, block in zip(screen.candidates, screen.candidate_blocks, strict=True):
        field = candidate.amplitude
        if field is None:
            continue
        error = float(np.min(screen.evidence.regress([block]).errors[0][..., -1]))
        error *= np.sqrt(screen.evidence.rounding_dispersion(block))
        least = max(screen.sensor_floor(candidate), candidate.min_amplitude)
        amplitude = max(float(needed * error * candidate.unit), least)
        known = smallest.get(candidate.effect)
        if error > 0 and amplitude < (known.amplitude if known else candidate.max_amplitude):
            unit = EFFECTS[candidate.effect].ranges[field].unit
            smallest[candidate.effect] = Detectable(candidate.effect, field, amplitude, unit)
    return tuple(smallest.values())
