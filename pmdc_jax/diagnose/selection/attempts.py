"""Effects named for the likeliest timing of the voltages and of counted speeds, and for runs that begin with a warm
winding: none of these may show in a fit without the effects."""

from __future__ import annotations

import time
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp

from ...identify.corrections.initial_temperature import with_initial_temperatures
from ...identify.corrections.input_timing import negative_log_likelihood_within, only_current_is_late, other_timings
from ...identify.corrections.mains_hum import without_mains_hum
from ...identify.corrections.speed_averaging import with_averaging, with_means
from ...identify.fit.fitted_runs import FittedRuns
from ...identify.fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN
from ...identify.noise.noise_model import Whitener
from ...identify.prepare import Prepared
from ...identify.solve import Solved, solve
from ...progress import ReportProgress
from ...recordings.recording import AROUND
from ...simulate import ZERO_ORDER_HOLD, Timing
from ..judgement import is_doubtful
from ..model import Model, model_of, refit_from
from .naming import Naming, StepwiseSelection

# Difference of two leads, in samples, below which they are the same
SAME_LEAD = 0.05


class Attempt(NamedTuple):
    """Effects named for one timing of the voltages and one set of runs that begin with a warm winding."""

    solved: Solved  # the motor without effects, and the runs with this timing
    selection: StepwiseSelection
    naming: Naming
    identifying: float  # s that the identification of the motor without effects took


def likeliest_attempt(prepared: Prepared, search: str, seed: int, report: ReportProgress) -> Attempt:
    """The effects named, and then once more if these reveal another timing of the voltages or of counted speeds, a
    sensor that hums, or runs that begin with a warm winding."""
    attempt = _of_likeliest_timing(prepared, search, seed, report)
    if _may_be_around(attempt):
        around = _of_likeliest_timing(with_means(prepared, AROUND), search, seed, report)
        settles = is_doubtful(attempt.naming) and not is_doubtful(around.naming)
        attempt = around if settles else _likelier(attempt, around)
    chosen = attempt.naming.chosen
    quiet = without_mains_hum(chosen.fitted)
    if quiet.prepared is not chosen.prepared:
        return _named(_without_hum_of(quiet.prepared, attempt.solved), attempt.identifying, report)
    warm = with_initial_temperatures(chosen.fitted)
    if warm.prepared is chosen.prepared:
        return attempt
    prepared, fit = attempt.solved.fitted
    begins_warm = FittedRuns(prepared.with_problem(begins_warm=warm.problem.begins_warm), fit)
    return _likelier(attempt, _named(attempt.solved._replace(fitted=begins_warm), attempt.identifying, report))


def _may_be_around(attempt: Attempt) -> bool:
    """Whether counted speeds may be means around each instant rather than as they were treated: beside the effects
    named, or without any where these are doubtful."""
    if attempt.naming.chosen.prepared.averaging == AROUND:
        return False
    if is_doubtful(attempt.naming):
        return with_averaging(attempt.selection.base.fitted, beside_more=True).prepared.averaging == AROUND
    chosen = attempt.naming.chosen
    return bool(chosen.effects) and with_averaging(chosen.fitted).prepared.averaging == AROUND


def _of_likeliest_timing(prepared: Prepared, search: str, seed: int, report: ReportProgress) -> Attempt:
    """The effects named, and then once more if these reveal another timing of the voltages: the likelier ones of both,
    or those with a zero-order hold if nothing speaks against it any more."""

    @cache
    def identified(timing: Timing | None) -> tuple[Solved, float]:
        began = time.perf_counter()
        return solve(prepared, search, seed, report, timing), time.perf_counter() - began

    def attempt(timing: Timing | None = None) -> Attempt:
        return _named(*identified(timing), report)

    first = attempt()
    zero_order, timing = first.naming.chosen, first.solved.fitted.prepared.timing
    if not zero_order.effects:
        return first
    if timing != ZERO_ORDER_HOLD:
        chosen = zero_order
        if only_current_is_late(chosen.fitted):
            return attempt(ZERO_ORDER_HOLD)
        solved, _ = identified(ZERO_ORDER_HOLD)
        zero_order = _with_effects_of(chosen, solved.fitted.prepared, first.selection.comparison.filter_of(chosen))
        gain = negative_log_likelihood_within(zero_order.fitted) - negative_log_likelihood_within(chosen.fitted)
        if not gain > MIN_LOG_LIKELIHOOD_GAIN:
            return attempt(ZERO_ORDER_HOLD)
    likelier = other_timings(zero_order.fitted)[:1]
    if not likelier or _is_tried(likelier[0], timing):
        return first
    return _likelier(first, attempt(likelier[0]))


def _named(solved: Solved, identifying: float, report: ReportProgress) -> Attempt:
    """The effects named beside the motor without effects that was identified."""
    report("gathering evidence", solved.fitted.fit.fitness)
    selection = StepwiseSelection(model_of(solved.fitted), solved, report)
    return Attempt(solved, selection, selection.select(), identifying)


def _with_effects_of(model: Model, prepared: Prepared, white: Whitener) -> Model:
    """The effects of a model fitted to runs with another timing, as the model was: to whitened residuals."""
    prepared = prepared.with_effects(model.prepared.forms_of(model.effects))
    return refit_from(prepared, model.fit.optimum, white)


def _without_hum_of(quiet: Prepared, solved: Solved) -> Solved:
    """The motor without effects, fitted to runs whose sensors hum no more."""
    prepared, fit = solved.fitted
    prepared = prepared._replace(runs=quiet.runs, mains_hum=quiet.mains_hum)
    measured = jnp.asarray(quiet.problem.tape.measured)
    return solved._replace(fitted=FittedRuns.polished(prepared.with_tape(measured=measured), fit.optimum))


def _likelier(*attempts: Attempt) -> Attempt:
    """The attempt whose effects make the runs likeliest."""
    return min(attempts, key=lambda a: negative_log_likelihood_within(a.naming.chosen.fitted))


def _is_tried(other: Timing, timing: Timing) -> bool:
    """Whether another timing is of the same kind as the one assumed, and nearly the same; smooth voltages are found
    from a first-order hold."""
    if other.smooth is not None and timing.smooth is None:
        return False
    return (
        other.first_order_hold == timing.first_order_hold
        and other.current_mean == timing.current_mean
        and abs(other.lead - timing.lead) < SAME_LEAD
    )
