"""From recordings to a `Diagnosis`: identify, gather evidence, name the missing effects, refit, describe the rest."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import attrs
import numpy as np

from ..errors import InputError
from ..identify.fit.generalised_least_squares import series_of
from ..identify.identification import Identification
from ..identify.prepare import Prepared, prepare
from ..identify.results import results_of
from ..identify.solve import Solved
from ..progress import ReportProgress, silent
from ..recordings.recording_file import Runs
from ..runtime.compiled import free_memory_maps
from ..runtime.precision import double_precision
from ..runtime.threads import one_blas_thread
from .description import detectable_effects, effects_found, learned_curves, regions_of_misfit, rival_sets
from .diagnosis import Diagnosis
from .evidence.assessment import FALSE_ALARM
from .evidence.electrical_balance import electrical_misfit
from .experiment import next_experiment
from .gap import closed_fraction, gaps_by_role, gaps_of_runs
from .judgement import implausible_effect, judge, unneeded_effect
from .selection.attempts import Attempt, likeliest_attempt
from .selection.naming import Naming

# Fewest samples with all outputs: with 24 of them, one motor in eight that lacks nothing seemed to lack something
MIN_READINGS = 40


@double_precision
@one_blas_thread
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
    _refuse_few_readings(prepared)
    attempt = likeliest_attempt(prepared, search, seed, report)
    naming_ended = time.perf_counter()
    report("estimating the uncertainty", attempt.naming.chosen.fit.fitness)
    diagnosis = _diagnosis(attempt)
    seconds = {
        "identify": attempt.identifying,
        "name": naming_ended - began - attempt.identifying,
        "total": time.perf_counter() - began,
    }
    return attrs.evolve(diagnosis, final=attrs.evolve(diagnosis.final, seconds=seconds), seconds=seconds)


def _refuse_few_readings(prepared: Prepared) -> None:
    tape = prepared.problem.tape
    readings = sum(
        int(series_of(tape, run, np.asarray(tape.measured)).known.sum()) for run in prepared.training_indices
    )
    if readings < MIN_READINGS:
        what = f"all recorded outputs are read together only {readings} times; a diagnosis needs {MIN_READINGS}"
        raise InputError("the training runs", what, "Record longer runs, or only identify the motor")


def _diagnosis(attempt: Attempt) -> Diagnosis:
    """What the effects named mean: the verdict, the motors without and with them, and what is left."""
    base = results_of(attempt.solved)
    naming, final = _without_unneeded_effects(attempt, base)
    before, after = (electrical_misfit(m) for m in (attempt.selection.base, naming.chosen))
    verdict, noise = judge(naming, base, final, (before, after))
    gaps = gaps_of_runs(base.fit, final.fit, noise)
    by_role = gaps_by_role(gaps, base.fit)
    # what differs from run to run would look like some curve
    reports_curves = (verdict == "not_in_library" or naming.leaves_sensor_error) and naming.varies is None
    return Diagnosis(
        verdict=verdict,
        effects=effects_found(naming, final),
        where=regions_of_misfit(naming),
        gap=by_role,
        gap_of_run=gaps,
        closed_fraction=closed_fraction(by_role) if naming.chosen.effects else None,
        rivals=rival_sets(naming),
        next_experiment=next_experiment(naming, attempt.solved.fitted.prepared.training)
        if verdict == "ambiguous"
        else None,
        curves=learned_curves(naming) if reports_curves else (),
        detectable=detectable_effects(naming.chosen_screen),
        base=base,
        final=final,
        p_nothing=naming.p_nothing,
        electrical_misfit=after,
        electrical_misfit_before=before,
        leaves_noise=naming.p_nothing_more >= FALSE_ALARM,
        varies=naming.varies,
        gap_by_own_value=gaps_of_runs(final.fit, naming.varies.fit, noise) if naming.varies else {},
    )


def _without_unneeded_effects(attempt: Attempt, base: Identification) -> tuple[Naming, Identification]:
    """The naming without effects that are implausible or that the runs do not need, and the motor it identifies; `base`
    is the motor without effects."""
    naming = attempt.naming
    final = _identification(naming, attempt.solved)
    while effect := (
        implausible_effect(naming.chosen.motor) or unneeded_effect(naming, base, final, attempt.selection.library)
    ):
        naming = attempt.selection.without(naming, effect)
        final = _identification(naming, attempt.solved)
    return naming, final


def _identification(naming: Naming, solved: Solved) -> Identification:
    """The identification of the chosen motor."""
    return results_of(solved._replace(fitted=naming.final_fit))
