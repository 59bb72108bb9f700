"""From recordings to a `Diagnosis`: identify, gather evidence, name the missing effects, refit, describe the rest."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import attrs
import numpy as np
from scipy import stats

from ..compiled import free_memory_maps
from ..effects import EFFECTS, ShaftCompliance
from ..identify.corrections.input_timing import (
    HELD,
    Timing,
    negative_log_likelihood_within,
    only_current_is_late,
    other_timings,
)
from ..identify.identification import Identification
from ..identify.prepare import Prepared, prepare
from ..identify.results import results_of
from ..identify.solve import Solved, solve
from ..motor import Motor
from ..precision import double_precision
from ..progress import ReportProgress, silent
from ..recording_file import Runs
from .assessment import FALSE_ALARM
from .balance import electrical_misfit
from .diagnosis import (
    Detectable,
    Diagnosis,
    EffectFound,
    LearnedCurve,
    Region,
    Verdict,
    breaks_electrical_equation,
    is_disturbed,
    unlike_held_out,
)
from .evidence import MIN_EIGENVALUE, Block
from .experiment import next_experiment
from .gap import Noise, closed_fraction, gaps_by_role, gaps_of_runs, noise_of_runs
from .library import Curve, Library
from .model import model_of
from .naming import Naming, StepwiseSelection
from .signals import Screen, log_p_value

# A knot of a curve is part of a region if its misfit is so many standard errors
REGION_Z = 4.0
# An effect with a smaller p-value without it is kept even if the runs give no interval of any of its parameters
CERTAIN_P_VALUE = 1e-30
# ... and one whose interval of the amplitude reaches down to this share of the estimate may be absent
ABSENT_SHARE = 1e-2
# Damping over critical damping from which a shaft is none: couplings of rubber reach 0.3
MAX_DAMPING_RATIO = 2.0


@double_precision
def diagnose(
    recordings: Runs,
    holdout: Runs = (),
    *,
    tie: Sequence[tuple[str, str]] = (),
    known: Mapping[str, float] | None = None,
    unloaded: bool = False,
    search: str = "cma_es",
    seed: int = 0,
    progress: ReportProgress | None = None,
) -> Diagnosis:
    """Find where a motor's recordings and its simulation disagree, name the missing effects and add them.

    **Arguments**: those of `pmdc_jax.identify`, where they are described, without `effects`: these are the answer.

    **Returns**: the verdict, the effects with their parameters, where the misfit shows, how much of the gap
    they close, and the motor before and after (see `Diagnosis`).

    **Raises**: `InputError` on data or arguments that cannot give an answer.
    """
    began = time.perf_counter()
    report = progress or silent
    free_memory_maps()
    report("checking the recordings")
    prepared = prepare(recordings, holdout, tie=tie, known=known, unloaded=unloaded)
    found = _likeliest_attempt(prepared, search, seed, report)
    given, solved, selection, naming, identifying = found
    naming_ended = time.perf_counter()
    report("estimating the uncertainty", naming.chosen.fit.fitness)
    base = results_of(given, solved)
    final = _identification(naming, solved)
    while effect := (
        implausible_effect(naming.chosen.motor)
        or _unneeded_effect(naming, final, selection.library)
    ):
        naming = selection.without(naming, effect)
        final = _identification(naming, solved)
    before, after = (electrical_misfit(m) for m in (selection.base, naming.chosen))
    verdict = "not_in_library" if breaks_electrical_equation(before, after) else _verdict(naming)
    verdict, noise = _judged_by_run(verdict, naming, base, final)
    gaps = gaps_of_runs(base.fit, final.fit, noise)
    by_role = gaps_by_role(gaps, base.fit)
    if unlike_held_out(by_role):
        verdict = "not_in_library"
    # what differs from run to run would look like some curve
    tells_curves = verdict == "not_in_library" or naming.leaves_sensor_error
    tells_curves = tells_curves and naming.varies is None
    seconds = {
        "identify": identifying,
        "name": naming_ended - began - identifying,
        "total": time.perf_counter() - began,
    }
    final = attrs.evolve(final, seconds=seconds)
    return Diagnosis(
        verdict=verdict,
        effects=_effects(naming, final),
        where=_regions(naming),
        gap=by_role,
        gap_of_run=gaps,
        closed_fraction=closed_fraction(by_role) if naming.chosen.effects else None,
        next_experiment=next_experiment(naming, given.training) if verdict == "ambiguous" else None,
        curves=_learned_curves(naming) if tells_curves else (),
        detectable=_detectable_effects(naming.chosen_screen),
        base=base,
        final=final,
        p_nothing=naming.p_nothing,
        electrical_misfit=after,
        electrical_misfit_before=before,
        seconds=seconds,
        leaves_noise=naming.p_nothing_more >= FALSE_ALARM,
        varies=naming.varies,
        gap_by_own_value=(
            gaps_of_runs(final.fit, naming.varies.fit, noise) if naming.varies else {}
        ),
    )


class _Attempt(NamedTuple):
    """Effects named for one timing of the voltages."""

    given: Prepared
    solved: Solved
    selection: StepwiseSelection
    naming: Naming
    identifying: float  # s that the identification of the motor without effects took


def _likeliest_attempt(
    prepared: Prepared, search: str, seed: int, report: ReportProgress
) -> _Attempt:
    """The effects named. If these reveal another timing of the voltages, which a fit without them could not tell: those
    named with that timing, if they make the runs likelier; or, if the current alone was late, with held voltages."""

    def attempt(timing: Timing | None = None) -> _Attempt:
        began = time.perf_counter()
        given, solved = solve(prepared, search, seed, report, timing)
        identifying = time.perf_counter() - began
        report("gathering evidence", solved.fit.fitness)
        selection = StepwiseSelection(model_of((), given, solved.fit), solved, report)
        return _Attempt(given, solved, selection, selection.name(), identifying)

    def unlikelihood(attempt: _Attempt) -> float:
        chosen = attempt.naming.chosen
        return negative_log_likelihood_within(chosen.given, chosen.fit)

    first = attempt()
    chosen = first.naming.chosen
    if not chosen.effects:
        return first
    if first.given.timing is not None:
        return attempt(HELD) if only_current_is_late(chosen.given, chosen.fit) else first
    others = other_timings(chosen.given, chosen.fit)
    return min(first, *map(attempt, others[:1]), key=unlikelihood) if others else first


def _identification(naming: Naming, solved: Solved) -> Identification:
    """The identification of the chosen motor."""
    given, fit = naming.final_fit
    return results_of(given, solved._replace(fit=fit))


def implausible_effect(motor: Motor) -> str | None:
    """The shaft, if its damping keeps it from any oscillation: it then stands for something else that is missing, such
    as a current that was read late.

    Judged only once a set is chosen: on the way to a gear, the play may appear as damping of a shaft.
    """
    shafts = (e for e in motor.effects if isinstance(e, ShaftCompliance))
    return next((e.name for e in shafts if e.damping_ratio(motor) > MAX_DAMPING_RATIO), None)


def _unneeded_effect(naming: Naming, final: Identification, library: Library) -> str | None:
    """The one of several effects that the runs need least, if they do not need it: by its p-value, as its amplitude may
    be zero, or as they determine none of its parameters and its p-value is not below `CERTAIN_P_VALUE`."""
    if len(naming.p_without) < 2:
        return None
    amplitude = {c.effect: c.amplitude for c in library.candidates if c.amplitude}

    def is_unneeded(effect: str, p_value: float) -> bool:
        if p_value > FALSE_ALARM:
            return True
        if effect in amplitude and may_be_absent(final, effect, amplitude[effect]):
            return True
        intervals = [final.parameters[f"{effect}.{f}"].ci95 for f in EFFECTS[effect].ranges]
        return p_value > CERTAIN_P_VALUE and all(interval is None for interval in intervals)

    unneeded = {e: p for e, p in naming.p_without.items() if is_unneeded(e, p)}
    return max(unneeded, key=lambda effect: unneeded[effect], default=None)


def may_be_absent(final: Identification, effect: str, amplitude: str) -> bool:
    """Whether the 95 % interval of an effect's amplitude includes zero, or, if it is strictly positive, the larger of
    its lower bound and the share `ABSENT_SHARE` of the estimate."""
    found, about = final.parameters[f"{effect}.{amplitude}"], EFFECTS[effect].ranges[amplitude]
    if found.value is None or found.ci95 is None:
        return False
    least = about.lower * (1 + 1e-6)  # the bound after its logarithm and back
    absent = max(least, ABSENT_SHARE * found.value) if about.scale == "log" else 0.0
    return found.ci95[0] <= absent <= found.ci95[1]


def _verdict(naming: Naming) -> Verdict:
    """The verdict by the evidence against the motor without effects and against the chosen one."""
    if naming.line is not None:
        return "not_in_library"
    if naming.p_nothing >= FALSE_ALARM:
        return "not_in_library" if naming.varies else "none_detected"
    if naming.p_nothing_more < FALSE_ALARM and not naming.may_be_model_form_error:
        return "not_in_library"
    if not naming.chosen.effects:
        return "not_in_library"
    return "ambiguous" if naming.rivals else "named"


def _judged_by_run(
    verdict: Verdict, naming: Naming, base: Identification, final: Identification
) -> tuple[Verdict, Noise]:
    """The verdict, once the runs are compared, and the noise of each run that it implies."""
    fits, share = final.fit, naming.noise_share if verdict == "not_in_library" else 1.0
    if naming.varies:  # what its own value leaves of each run is noise
        fits, share = {**fits, **naming.varies.fit}, 1.0
    noise = noise_of_runs(fits, share)
    gaps = gaps_of_runs(base.fit, final.fit, noise)
    if verdict == "none_detected" and is_disturbed(gaps, final):
        # what is left is then no noise but that of the sensors
        return "not_in_library", noise_of_runs(final.fit, share=0.0)
    return verdict, noise


def _effects(naming: Naming, final: Identification) -> tuple[EffectFound, ...]:
    rivals = tuple(" + ".join(sorted(m.effects)) for m in naming.rivals)
    return tuple(
        EffectFound(
            name,
            EFFECTS[name].equation,
            {f: final.parameters[f"{name}.{f}"] for f in EFFECTS[name].ranges},
            naming.p_without[name],
            rivals,
        )
        for name in naming.chosen.effects
    )


def _regions(naming: Naming) -> tuple[Region, ...]:
    """Where the curves of the motor without effects are far from zero, the clearest first; also a line in frequency."""
    found, line = naming.base_screen, naming.line
    base = found.evidence.regress().squares
    regions = []
    for curve, block in zip(found.curves, found.curve_blocks, strict=True):
        if curve.per_run or curve.is_sensor_error:
            continue
        gain = base - found.evidence.regress([block]).squares
        if log_p_value(gain, found.evidence.degrees_of_freedom(block)) > np.log(1e-4):
            continue
        z = np.array([_z_of_column(found, column) for column in block.columns])
        regions += _regions_of_curve(curve, z)
    if line is not None:
        region = (line.low, line.high)
        regions.append(Region("mechanical", "frequency", region, float(np.sqrt(line.height))))
    return tuple(sorted(regions, key=lambda r: -abs(r.z))[:12])


def _z_of_column(found: Screen, column: int) -> float:
    """The misfit at one knot over its standard error; regressed alone, as neighbours would share what they explain."""
    fit = found.evidence.regress([Block((column,))])
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


def _learned_curves(naming: Naming) -> tuple[LearnedCurve, ...]:
    """The curves that the data still show, at most three, the most significant first; none for a line in frequency."""
    found = naming.chosen_screen
    if naming.p_nothing_more >= FALSE_ALARM:
        return ()
    base = found.evidence.regress().squares
    learned = []
    for curve, block in zip(found.curves, found.curve_blocks, strict=True):
        # directions that the motor's own parameters can imitate are no part of the curve
        least = 1e-3 if curve.order > 1 else MIN_EIGENVALUE
        fit = found.evidence.regress([block], min_eigenvalue=least)
        log_p = log_p_value(base - fit.squares, found.evidence.degrees_of_freedom(block))
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
    return tuple(curve for _, curve in sorted(learned, key=lambda pair: pair[0])[:3])


def _detectable_effects(found: Screen) -> tuple[Detectable, ...]:
    """The smallest amplitude of each effect that would be detected with a probability of 90 %, if it is physical."""
    count = len(found.candidates) + len(found.curves)
    needed = stats.norm.isf(FALSE_ALARM / count / 2) + stats.norm.isf(0.1)
    smallest: dict[str, Detectable] = {}
    for candidate, block in zip(found.candidates, found.candidate_blocks, strict=True):
        field = candidate.amplitude
        if field is None:
            continue
        error = float(np.min(found.evidence.regress([block]).errors[0][..., -1]))
        error *= np.sqrt(found.evidence.rounding_dispersion(block))
        least = max(found.sensor_floor(candidate), candidate.min_amplitude)
        amplitude = max(float(needed * error * candidate.unit), least)
        known = smallest.get(candidate.effect)
        if error > 0 and amplitude < (known.amplitude if known else candidate.max_amplitude):
            unit = EFFECTS[candidate.effect].ranges[field].unit
            smallest[candidate.effect] = Detectable(candidate.effect, field, amplitude, unit)
    return tuple(smallest.values())
