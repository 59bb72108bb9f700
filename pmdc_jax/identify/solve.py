"""The best fit: search the bounds, refine the best candidates, polish."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..progress import ReportProgress, silent
from ..runtime.threads import map_in_threads_until, submit
from ..simulate import RunUnknowns, Tape, Timing
from .corrections.gradual_brushes import with_gradual_brushes
from .corrections.initial_temperature import with_initial_temperatures
from .corrections.input_noise import without_input_noise
from .corrections.input_timing import negative_log_likelihood_within, other_timings
from .corrections.mains_hum import without_mains_hum
from .corrections.outliers import without_outliers
from .corrections.reading_time import with_fitted_reading
from .corrections.retiming import with_timing
from .corrections.speed_averaging import with_averaging, with_evident_averaging
from .corrections.step_times import with_step_times
from .corrections.uneven_sampling import with_even_clock
from .fit.fitted_runs import FittedRuns
from .fit.gauss_newton import TOLERANCE
from .fit.polish import polish
from .fit.refine import Optimum, refine
from .fit.run_unknowns import with_holdout_unknowns
from .identification import Search
from .parameters import Parameters
from .prepare import Prepared
from .problem import Evaluation, Problem, Unknowns
from .rotor_angle import with_rotor_angle
from .search.bounds import crude_motor, effect_bounds
from .search.evolution import SearchResult, global_search

STARTS = 4
# Two refinements found the same optimum if their fitness agrees to this share.
FITNESS_TOLERANCE = 1e-4
# ... where the model lacks something: refinements then end further from the optimum
POOR_FIT_TOLERANCE = 1e-3
# ... and where, besides, all coordinates agree to the second share of their ranges: a rotor that sticks in a torque
# that fluctuates has many optima near each other
STICKING_TOLERANCE, STICKING_SHARE = 0.03, 5e-3
# A mean square of the residuals above this many noise variances asks for another search, up to this many in all.
POOR_FIT = 1.5
MAX_SEARCHES = 5
# Updates of the rotor angle at most, and the share of the fitness that each must gain
ANGLE_ITERATIONS, MIN_ANGLE_GAIN = 3, 1e-5
# Starts that differ by less than this in all coordinates count as one.
MIN_DISTANCE = 0.3


class Solved(NamedTuple):
    """The best fit that a search and its refinements found, and how it was found."""

    fitted: FittedRuns
    search: Search
    seed: int
    seconds: Mapping[str, float]


def solve(
    prepared: Prepared, search: str, seed: int, progress: ReportProgress | None = None, timing: Timing | None = None
) -> Solved:
    """The best fit of a search, to runs corrected for artefacts of their sensors and for the timing of their inputs.

    **Arguments**: `timing` of the inputs, if it is known already.
    """
    recorded = with_evident_averaging(prepared)

    def at(timing: Timing | None) -> Solved:
        runs = with_timing(recorded, timing) if timing else recorded
        return _corrected(search_and_refine(runs, search, seed, progress))

    attempts = [at(timing)]
    if timing is None and not attempts[0].search.interrupted:
        attempts += map(at, other_timings(attempts[0].fitted))
    solutions = [a._replace(fitted=with_fitted_reading(with_step_times(a.fitted))) for a in attempts]
    if len(solutions) == 1:
        return solutions[0]
    return min(solutions, key=lambda solution: negative_log_likelihood_within(solution.fitted))


# Applied in this order: outliers spoil every fit, uneven sampling hides everything else, and a mean is recognised by
# the sensor's own noise
CORRECTIONS: tuple[Callable[[FittedRuns], FittedRuns], ...] = (
    without_outliers,
    with_even_clock,
    without_mains_hum,
    without_input_noise,
    with_averaging,
    with_initial_temperatures,
    with_gradual_brushes,
)


def _corrected(solved: Solved) -> Solved:
    """The runs corrected for artefacts of their sensors, and the fit to them."""
    prepared, fit = solved.fitted
    fitted = FittedRuns(prepared, with_holdout_unknowns(prepared.problem, fit))
    for correct in CORRECTIONS:
        fitted = correct(fitted)
    return solved._replace(fitted=fitted)


def search_and_refine(
    prepared: Prepared, search: str, seed: int, progress: ReportProgress | None = None, searches: int = MAX_SEARCHES
) -> Solved:
    """Search the bounds and refine the best candidates; repeat with other seeds while the fit is poor or no two
    refinements agree, up to `searches` searches in all.

    **Returns**: the fit, and the runs with the rotor angle updated from it where a torque depends on that.
    """
    began = time.perf_counter()
    report = progress or silent
    problem = prepared.problem
    searching = Tape.from_recordings(prepared.training, timing=prepared.timing)
    noise, parameters = np.asarray(problem.noise), _searched_parameters(prepared)

    def run_search(seed: int, guess: Mapping[str, float] | None = None) -> SearchResult:
        return global_search(parameters, searching, noise, search, seed, progress=progress, guess=guess)

    middle = (problem.parameters.lower + problem.parameters.upper) / 2
    # a refinement that stops at once, so that it is compiled on another core while the search runs
    compiled = submit(refine, problem, _start(problem.tape, middle), tolerance=1e3)
    # other searches do without the guess, in case it is a wrong one
    search_result = run_search(seed, crude_motor(prepared.training))
    search_ended = time.perf_counter()
    report("refining the best candidates", float(search_result.best[-1]))
    compiled.result()
    ends = _refine_all(problem, search_result)
    for attempt in range(1, searches):
        if search_result.interrupted or _agreed(ends, problem):
            break
        search_result = _continued(search_result, run_search(seed + attempt))
        ends = _refine_all(problem, search_result, ends)
    fitted = polish_with_angle(prepared, ends[0])
    seconds = {"search": search_ended - began, "refine": time.perf_counter() - search_ended}
    record = _search_record(search, search_result, ends, problem)
    return Solved(fitted, record, seed, seconds)


def _continued(before: SearchResult, search: SearchResult) -> SearchResult:
    """Another search, with the effort and the history of those before it."""
    return search._replace(
        evaluations=before.evaluations + search.evaluations,
        best=np.append(before.best, search.best),
        median=np.append(before.median, search.median),
    )


def _searched_parameters(prepared: Prepared) -> Parameters:
    """The parameters within narrower bounds: the search can skip values at which an effect does not show."""
    effects = prepared.problem.parameters.effects
    return prepared.parameters(effects, effect_bounds(effects, prepared.training))


def polish_with_angle(
    prepared: Prepared,
    end: Optimum,
    tolerance: float = TOLERANCE,
    at_start: Evaluation | None = None,
    give_up_above: float = np.inf,
) -> FittedRuns:
    """Polish; where a torque depends on the rotor angle, update the angle from the fit and repeat while that helps.

    **Arguments**: as of `polish`.
    """
    polished = polish(prepared.problem, end, tolerance=tolerance, at_start=at_start, give_up_above=give_up_above)
    is_useful = polished.fitness * prepared.problem.most_samples <= give_up_above
    for _ in range(ANGLE_ITERATIONS if prepared.problem.depends_on_angle and is_useful else 0):
        again = prepared._replace(problem=with_rotor_angle(prepared.problem, polished))
        better = polish(again.problem, polished.optimum, tolerance=tolerance, give_up_above=give_up_above)
        if not better.fitness < (1 - MIN_ANGLE_GAIN) * polished.fitness:
            break
        prepared, polished = again, better
    return FittedRuns(prepared, polished)


def _start(tape: Tape, coordinates: jax.Array | np.ndarray) -> Unknowns:
    return Unknowns(jnp.asarray(coordinates), RunUnknowns.as_recorded(tape))


def _distinct(search_result: SearchResult, parameters: Parameters) -> list[np.ndarray]:
    """The best few clearly different candidates, preceded by the best one with L in the middle of its range.

    Where L is too small to matter the sum of squares is flat in it, and no gradient leads back.
    """
    kept: list[np.ndarray] = []
    if "L" in parameters.names:
        L = parameters.names.index("L")
        kept.append(np.array(search_result.candidates[0]))
        kept[0][L] = (parameters.lower[L] + parameters.upper[L]) / 2
    for candidate in search_result.candidates:
        if all(np.max(np.abs(candidate - other)) > MIN_DISTANCE for other in kept):
            kept.append(candidate)
        if len(kept) == STARTS:
            break
    return kept


def _refine_all(problem: Problem, search_result: SearchResult, before: Sequence[Optimum] = ()) -> list[Optimum]:
    """Refine the best distinct candidates of a search, one on each core at a time, until they agree with each other and
    those `before`; the best of all first."""
    starts = [_start(problem.tape, candidate) for candidate in _distinct(search_result, problem.parameters)]

    def agreed(ends: list[Optimum]) -> bool:
        return _agreed(sorted([*before, *ends], key=_fitness), problem)

    ends = map_in_threads_until(lambda s: refine(problem, s), starts, agreed)
    return sorted([*before, *ends], key=_fitness)


def _fitness(end: Optimum) -> float:
    return end.fitness


def _agreed(ends: Sequence[Optimum], problem: Problem) -> bool:
    """Whether the best optimum was found often enough: twice if its residuals are about as small as the noise, else by
    more starts than one search has. Larger residuals may be due to the model or to a local optimum: only another search
    can tell.

    **Arguments**: `ends`, the best first.
    """
    needed = 2 if _is_good(ends[0], problem) else STARTS + 1
    return _times_found(ends, problem) >= needed


def _is_good(end: Optimum, problem: Problem) -> bool:
    """Whether the residuals are about as small as the noise."""
    return end.fitness < POOR_FIT * problem.perfect_fitness


def _times_found(ends: Sequence[Optimum], problem: Problem) -> int:
    """How many of some ends, the best first, are at the best one's optimum."""
    best, is_good = ends[0], _is_good(ends[0], problem)
    tolerance = FITNESS_TOLERANCE if is_good else POOR_FIT_TOLERANCE
    near = STICKING_SHARE * np.asarray(problem.parameters.upper - problem.parameters.lower)

    def is_same(end: Optimum) -> bool:
        if end.fitness <= best.fitness * (1 + tolerance) + 1e-12:
            return True
        moved = np.abs(np.asarray(end.unknowns.coordinates - best.unknowns.coordinates))
        return not is_good and end.fitness < best.fitness * (1 + STICKING_TOLERANCE) and bool(np.all(moved <= near))

    return sum(map(is_same, ends))


def _search_record(method: str, search_result: SearchResult, ends: Sequence[Optimum], problem: Problem) -> Search:
    return Search(
        method=method,
        evaluations=search_result.evaluations,
        best=search_result.best,
        median=search_result.median,
        refined=np.array([end.fitness for end in ends]),
        times_found=_times_found(ends, problem),
        interrupted=search_result.interrupted,
    )
