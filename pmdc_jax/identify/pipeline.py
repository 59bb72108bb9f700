"""From recordings to an `Identification`: check, bound, search, refine, assess."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import attrs

from ..progress import ReportProgress, silent
from ..recordings.recording_file import Runs
from ..runtime.compiled import free_memory_maps
from ..runtime.precision import double_precision
from ..runtime.threads import one_blas_thread
from .fit.generalised_least_squares import last_fit
from .fit.slow_torque import whitener_of
from .identification import Identification
from .missing_friction import friction_messages, missing_friction
from .parameters import effects_named
from .prepare import prepare
from .results import results_of
from .solve import solve


@double_precision
@one_blas_thread
def identify(
    recordings: Runs,
    holdout: Runs = (),
    *,
    tie: Sequence[tuple[str, str]] = (),
    known: Mapping[str, float] | None = None,
    unloaded: bool = False,
    effects: Sequence[str] = (),
    search: str = "cma_es",
    seed: int = 0,
    progress: ReportProgress | None = None,
) -> Identification:
    """Identify a motor from recordings of it.

    **Arguments**: `recordings` to fit, or their files, at least one; `holdout`, runs kept out of the fit; `tie`, pairs
    such as ("Kt", "Kb") of parameters set equal, of which only the second is fitted; `known`, fixed values in SI;
    `unloaded` declares that runs without a load column have no load (otherwise a constant unknown one); `effects`,
    names of effects to identify too; `search`, a key of `pmdc_jax.identify.search.evolution.METHODS`; `seed` of the
    search; `progress`, called now and then with the current activity and the fitness.

    **Returns**: the motor, its parameters with uncertainty and status, and the fit of every run.

    **Raises**: `InputError` on data or arguments that cannot give an answer.
    """
    began = time.perf_counter()
    report = progress or silent
    free_memory_maps()
    report("checking the recordings")
    prepared = prepare(recordings, holdout, tie=tie, known=known, unloaded=unloaded, effects=effects_named(effects))
    solved = solve(prepared, search, seed, progress)
    plain = solved.fitted
    report("estimating the uncertainty", plain.fit.fitness)
    friction = missing_friction(*plain)
    white = whitener_of(*plain)
    result = results_of(solved._replace(fitted=last_fit(plain, plain.fit, white)))
    seconds = {**solved.seconds, "total": time.perf_counter() - began}
    residual_messages = (
        f"the residual of the {name} is {times:.3g} times its white noise: run `pmdc diagnose` to find out whether the "
        "model lacks an effect, or the motor or a sensor was disturbed"
        for name, times in result.missed.items()
    )
    doubts = (*friction_messages(friction, result), *residual_messages)
    messages = (*result.messages, *doubts)
    return attrs.evolve(result, seconds=seconds, messages=messages, doubts=doubts)
