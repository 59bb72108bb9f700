"""The result of an identification in sentences: what was found, how well it fits, and what remains unidentified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ...identify.identification import Estimate, Identification, RunFit
from ...words import enumerate_words
from ..notation import NARROW_SPACE, percent, significant

MODEL_ASSUMPTION = "The standard errors assume that the model lacks no effect: `pmdc diagnose` tests that."
# an RMS residual up to this multiple of the noise counts as noise: the RMS of few samples scatters as much
MAX_RMSE_TO_NOISE = 1.25
# Kt / Kb, and its inverse, of a motor at most: iron loss and brushes make them differ by some percent
MAX_CONSTANT_RATIO = 1.5
# A refinement that stalls within so many standard errors of the best fit has found it all the same
MAX_STALLED_DISTANCE = 3.0


def summary(identification: Identification) -> list[str]:
    """The sentences at the top of the report, the most important first."""
    sentences = [_identified_sentence(identification), _holdout_sentence(identification)]
    sentences += cautions(identification)
    if _with_status(identification, "identified") and not identification.doubts:
        sentences.append(MODEL_ASSUMPTION)
    return sentences


def cautions(identification: Identification) -> list[str]:
    """What the recordings cannot tell, and where the numbers are not to be trusted."""
    modelled = {effect.name for effect in identification.motor.effects}
    warnings = [
        one for one in identification.findings if one.severity == "warning" and not modelled & set(one.modelled_by)
    ]
    doubted = dict.fromkeys(one.column or f"run {one.run}" for one in warnings)
    sentences = []
    if doubted:
        sentences.append(
            f"The data check warns about the {enumerate_words(list(doubted))}:"
            " the results are valid only if these warnings are harmless or corrected."
        )
    directions = identification.unidentified_directions
    reasons = (f"{as_sentence(one.why)} {as_sentence(one.mend)}" for one in directions)
    sentences += dict.fromkeys(reasons)  # several directions may have the same
    at_bound = _with_status(identification, "at_bound")
    if at_bound:
        who = f"{enumerate_words(at_bound)} {'are' if len(at_bound) > 1 else 'is'}"
        sentences.append(f"{who} at the bound of the search range: a limit, not an estimate.")
    sentences.append(_unequal_constants_sentence(identification.parameters))
    if not identification.converged:
        sentences.append(_unconverged_sentence(identification))
    return [sentence for sentence in sentences if sentence]


def _unequal_constants_sentence(parameters: Mapping[str, Estimate]) -> str:
    """A warning that Kt and Kb differ by more than any motor's; empty where they do not, or are tied."""
    estimated = {
        name: one.value for name, one in parameters.items() if one.value and one.status in ("identified", "at_bound")
    }
    if not {"Kt", "Kb"} <= estimated.keys():
        return ""
    ratio = estimated["Kt"] / estimated["Kb"]
    if 1 / MAX_CONSTANT_RATIO < ratio < MAX_CONSTANT_RATIO:
        return ""
    return (
        f"Kt is {significant(ratio)} times Kb, though in SI units the two are nearly equal in every motor: check the"
        " unit and the sign of the load torque. A brake opposes motion: in reverse, its torque is negative."
    )


def _unconverged_sentence(identification: Identification) -> str:
    distance = identification.distance
    if distance > MAX_STALLED_DISTANCE:
        return "The refinement did not converge: treat all results with care, or try another seed."
    reason = ""
    if identification.motor.switches:
        reason = ", as it may where dry friction sticks and slips or teeth part"
    return (
        f"The refinement stalled up to {distance:.2g} standard errors from the best fit{reason}: the intervals may be"
        " too narrow by as much."
    )


def _identified_sentence(identification: Identification) -> str:
    parameters = identification.parameters
    identified = _with_status(identification, "identified")
    not_identifiable = _with_status(identification, "not_identifiable")
    training = sum(fit.role == "train" for fit in identification.fit.values())
    source = f"from {training} training run{'s' * (training != 1)}"
    if not identified:
        return f"No parameter could be identified {source}."
    if len(identified) == len(parameters):
        sentence = f"All {len(parameters)} parameters were identified {source}"
    else:
        verb = "were" if len(identified) > 1 else "was"
        sentence = f"{enumerate_words(identified)} {verb} identified {source}"
    sentence += _precision_clause({name: parameters[name] for name in identified})
    if not_identifiable:
        sentence += f"; {enumerate_words(not_identifiable)} could not be identified"
    return f"{sentence}."


def _precision_clause(estimates: dict[str, Estimate]) -> str:
    errors = {
        name: 100 * estimate.stderr / abs(estimate.value)
        for name, estimate in estimates.items()
        if estimate.stderr is not None and estimate.value
    }
    if not errors:
        return ""
    best, worst = min(errors, key=errors.__getitem__), max(errors, key=errors.__getitem__)
    if best == worst:
        return f", with a standard error of {percent(errors[best])}"
    return f", with standard errors from {percent(errors[best])} ({best}) to {percent(errors[worst])} ({worst})"


def _holdout_sentence(identification: Identification) -> str:
    held_out = {name: fit for name, fit in identification.fit.items() if fit.role == "holdout"}
    if not held_out:
        return (
            "No run was held out, so the motor was not validated on data outside the fit:"
            " hold out a run with --holdout RUN."
        )
    worst = max(held_out, key=lambda name: _misfit(held_out[name], identification.noise))
    fit = held_out[worst]
    who = f"The held-out run {worst}"
    if len(held_out) > 1:
        who = f"The worst of {len(held_out)} held-out runs, {worst},"
    channels = _channels(fit, identification.noise)
    reproduced = [
        f"a {one.quantity} RMSE of {significant(one.rmse)}{NARROW_SPACE}{one.unit} ({percent(one.fit)} fit)"
        for one in channels
    ]
    excess = [
        f"the {one.quantity} error is {one.rmse / one.noise:.1f} times the measurement noise"
        for one in channels
        if one.noise and one.rmse > MAX_RMSE_TO_NOISE * one.noise
    ]
    sentence = f"{who} is reproduced in free-run simulation with {enumerate_words(reproduced)}"
    if not any(one.noise for one in channels):
        return f"{sentence}."
    return f"{sentence}; {enumerate_words(excess) or 'the residuals are measurement noise'}."


class _Channel(NamedTuple):
    quantity: str
    rmse: float
    fit: float | None
    unit: str
    noise: float | None


def _channels(fit: RunFit, noise: Mapping[str, float | None]) -> list[_Channel]:
    """Residual, fit and noise of speed and current, as far as the run has them."""
    channels = []
    if fit.speed_rmse is not None:
        one = ("speed", fit.speed_rmse, fit.speed_fit_percent, "rad/s", noise.get("speed_rad_s"))
        channels.append(_Channel(*one))
    if fit.current_rmse is not None:
        one = ("current", fit.current_rmse, fit.current_fit_percent, "A", noise.get("current_A"))
        channels.append(_Channel(*one))
    return channels


def _misfit(fit: RunFit, noise: Mapping[str, float | None]) -> float:
    """Residuals in units of the noise, summed over the channels, to find the worst run."""
    return sum(one.rmse / (one.noise or 1.0) for one in _channels(fit, noise))


def _with_status(identification: Identification, status: str) -> list[str]:
    return [name for name, one in identification.parameters.items() if one.status == status]


def as_sentence(text: str) -> str:
    """The text with a full stop, if it has none."""
    text = text.strip()
    return text if not text or text[-1] in ".!?" else f"{text}."
