"""The verdict, and effects that are dropped before it."""

from __future__ import annotations

from ..effects import ResistanceHeating, ShaftCompliance, range_of
from ..effects.base import AbstractEffect
from ..identify.identification import Identification
from ..motor import Motor
from .diagnosis import Verdict, breaks_electrical_equation, holdouts_show_more, is_disturbed
from .evidence.assessment import FALSE_ALARM
from .gap import Noise, closed_fraction, gaps_by_role, gaps_of_runs, noise_of_runs
from .hypotheses.library import Library
from .selection.naming import Naming

# An effect with a smaller p-value without it is kept even if the runs give no interval of any of its parameters
CERTAIN_P_VALUE = 1e-30
# ... unless the effects leave what nothing explains: they are all dropped if they close less than this share of the gap
MIN_CLOSED = 0.1
# An effect whose interval of the amplitude reaches down to this share of the estimate may be absent
ABSENT_SHARE = 1e-2
# Damping over critical damping from which a shaft is none: couplings of rubber reach 0.3
MAX_DAMPING_RATIO = 2.0
# Thermal time constant, s, up to which what warms up is no winding: the smallest coreless ones take longer
MIN_THERMAL_TIME = 0.2


def implausible_effect(motor: Motor) -> str | None:
    """The effect that stands for something else that is missing, if there is one: a shaft whose damping keeps it from
    any oscillation, such as for a current that was read late, or a winding that warms up at once, for a voltage that
    depends on the current.

    Judged only once a set is chosen: on the way to a gear, the play may appear as damping of a shaft.
    """

    def is_implausible(effect: AbstractEffect) -> bool:
        if isinstance(effect, ShaftCompliance):
            return float(effect.damping_ratio(motor)) > MAX_DAMPING_RATIO
        return isinstance(effect, ResistanceHeating) and float(effect.time_constant_s) < MIN_THERMAL_TIME

    return next((effect.name for effect in motor.effects if is_implausible(effect)), None)


def is_doubtful(naming: Naming) -> bool:
    """Whether something was found, but no effect, or only an implausible one."""
    if not naming.chosen.effects:
        return naming.p_nothing_more < FALSE_ALARM
    return implausible_effect(naming.chosen.motor) is not None


def unneeded_effect(naming: Naming, base: Identification, final: Identification, library: Library) -> str | None:
    """The effect that the runs need least, if there is one that they do not need; else None.

    One of several effects is not needed if
    1. its p-value is not significant,
    2. its amplitude may be zero, or
    3. the runs determine none of its parameters, and its p-value is not below `CERTAIN_P_VALUE`.
    None is needed if they close hardly any of the gap and leave what nothing explains: no p-value says much then.

    **Arguments**: `base` and `final`, the motor without and with the effects.
    """
    unexplained = _more_is_missing(naming) and naming.line is None and naming.varies is None
    certain = 0.0 if unexplained else CERTAIN_P_VALUE
    if unexplained and _closed_fraction(naming, base, final) < MIN_CLOSED:
        return max(naming.p_without, key=lambda effect: naming.p_without[effect], default=None)
    if len(naming.p_without) < 2:
        return None
    amplitude = {c.effect: c.amplitude for c in library.candidates if c.amplitude}

    def is_unneeded(effect: str, p_value: float) -> bool:
        if p_value > FALSE_ALARM:
            return True
        if effect in amplitude and may_be_absent(final, effect, amplitude[effect]):
            return True
        intervals = [final.parameters[f"{effect}.{f}"].ci95 for f in final.motor.effect_named(effect).ranges]
        return p_value >= certain and all(interval is None for interval in intervals)

    unneeded = {e: p for e, p in naming.p_without.items() if is_unneeded(e, p)}
    return max(unneeded, key=lambda effect: unneeded[effect], default=None)


def may_be_absent(final: Identification, effect: str, amplitude: str) -> bool:
    """Whether the 95 % interval of an effect's amplitude includes zero, or, if it is strictly positive, the larger of
    its lower bound and the share `ABSENT_SHARE` of the estimate."""
    estimate, about = final.parameters[f"{effect}.{amplitude}"], range_of(effect, amplitude)
    if estimate.value is None or estimate.ci95 is None:
        return False
    least = about.lower * (1 + 1e-6)  # the bound after its logarithm and back
    absent = max(least, ABSENT_SHARE * estimate.value) if about.scale == "log" else 0.0
    return estimate.ci95[0] <= absent <= estimate.ci95[1]


def judge(
    naming: Naming, base: Identification, final: Identification, electrical_misfits: tuple[float, float]
) -> tuple[Verdict, Noise]:
    """The verdict, and the noise of each run that it implies.

    **Arguments**: `base` and `final`, the motor without and with the effects, and the `electrical_misfits` of both.
    """
    verdict = _by_evidence(naming, final)
    if breaks_electrical_equation(*electrical_misfits):
        verdict = "not_in_library"
    fits, share = final.fit, naming.noise_share if verdict == "not_in_library" else 1.0
    if naming.varies:  # what its own value leaves of each run is noise
        fits, share = {**fits, **naming.varies.fit}, 1.0
    noise = noise_of_runs(fits, share)
    gaps = gaps_of_runs(base.fit, final.fit, noise)
    if verdict == "none_detected" and is_disturbed(gaps, final):
        # what is left is then no noise but that of the sensors
        return "not_in_library", noise_of_runs(final.fit, share=0.0)
    if holdouts_show_more(gaps_by_role(gaps, base.fit)):
        verdict = "not_in_library"
    return verdict, noise


def _by_evidence(naming: Naming, final: Identification) -> Verdict:
    """The verdict by the evidence against the motor without effects and against the chosen one."""
    if naming.line is not None:
        return "not_in_library"
    if naming.p_nothing >= FALSE_ALARM:
        return "not_in_library" if naming.varies else "none_detected"
    if _more_is_missing(naming):
        return "not_in_library"
    if not naming.chosen.effects:
        is_small = naming.leaves_small_ripple and not final.missed
        return "none_detected" if is_small else "not_in_library"
    return "ambiguous" if naming.rivals else "named"


def _more_is_missing(naming: Naming) -> bool:
    """Whether the chosen effects leave what neither another form of them could explain, nor is a small ripple of the
    speed sensor."""
    tolerated = naming.may_be_model_form_error or naming.leaves_small_ripple
    return naming.p_nothing_more < FALSE_ALARM and not tolerated


def _closed_fraction(naming: Naming, base: Identification, final: Identification) -> float:
    """The share of the gap that the effects close; 1 if there is none."""
    noise = noise_of_runs(final.fit, naming.noise_share)
    closed = closed_fraction(gaps_by_role(gaps_of_runs(base.fit, final.fit, noise), base.fit))
    return 1.0 if closed is None else closed
