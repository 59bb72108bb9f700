"""From recordings to an `Identification`: check, bound, search, refine, judge."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import attrs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..check import check
from ..effects import AbstractEffect
from ..errors import InputError
from ..motor import PARAMETERS, Motor
from ..precision import double_precision
from ..recording import Finding, Recording
from ..simulate import Tape, uniform
from .bounds import search_bounds
from .identifiability import explain
from .identification import Estimate, Identification, Role, RunFit, Search, Status
from .noise import white_noise
from .parameters import Parameters, check_names, effects_named, unit_of
from .profile import QUADRATIC, profile_interval
from .refine import Polished, Problem, Refined, Unknowns, fit_own, polish, refine
from .search import Found
from .search import search as global_search
from .turning import turned
from .uncertainty import FLAT, Information, information

if TYPE_CHECKING:
    from ..report.terminal import ReportProgress

STARTS = 4
REACH = NormalDist().inv_cdf(0.975)  # of a 95 % interval, in standard errors
# Two refinements found the same optimum if their fitness agrees to this share.
SAME = 1e-4
# A fit worse than this many times the noise asks for another search, up to so many.
POOR = 1.5
SEARCHES = 5
TIDYINGS = 3
TURNINGS = 3
# Starts nearer to each other than this, in natural logarithms, are one.
DISTINCT = 0.3


@double_precision
def identify(
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
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

    **Arguments**: `recordings` to fit, at least one; `holdout`, runs kept out of the fit; `tie`, pairs such as
    ("Kt", "Kb") of parameters that are one; `known`, values in SI that are not sought; `unloaded` declares that
    runs without a load column have no load (otherwise a constant unknown one); `effects`, names of effects
    to identify too; `search`, a key of `pmdc_jax.identify.search.METHODS`; `seed` of the search; `progress`,
    called now and then with what is being done and how good the fit is.

    **Returns**: the motor, its parameters with uncertainty and status, and the fit of every run.

    **Raises**: `InputError` on data or arguments that cannot give an answer.
    """
    began = time.perf_counter()
    report = progress or (lambda *args, **kwargs: None)
    report("checking the recordings")
    given = prepare(
        recordings, holdout, tie=tie, known=known, unloaded=unloaded, effects=effects_named(effects)
    )
    given, solved = solve(given, search, seed, progress)
    report("judging the uncertainty", solved.polished.refined.fitness)
    found = judge(given, solved)
    seconds = {**solved.seconds, "total": time.perf_counter() - began}
    return attrs.evolve(found, seconds=seconds)


class Prepared(NamedTuple):
    """Checked recordings, training runs first, and the least-squares problem they make."""

    runs: list[Recording]  # evenly sampled
    roles: list[Role]
    findings: tuple[Finding, ...]
    untouched: Mapping[str, float]
    known: Mapping[str, float]
    ties: tuple[tuple[str, str], ...]
    problem: Problem

    @property
    def training(self) -> list[Recording]:
        """The runs that are fitted."""
        return [run for run, role in zip(self.runs, self.roles, strict=True) if role == "train"]

    def with_effects(self, effects: Sequence[type[AbstractEffect]]) -> Prepared:
        """The same runs for a motor with other effects."""
        parameters = Parameters.of(
            search_bounds(self.training), effects, {**self.untouched, **self.known}, self.ties
        )
        problem = Problem(
            parameters,
            self.problem.tape,
            self.problem.noise,
            free=jnp.ones(len(parameters.names), bool),
            counts=self.problem.counts,
        )
        return self._replace(problem=problem)


def prepare(
    recordings: Sequence[Recording],
    holdout: Sequence[Recording],
    *,
    tie: Sequence[tuple[str, str]] = (),
    known: Mapping[str, float] | None = None,
    unloaded: bool = False,
    effects: Sequence[type[AbstractEffect]] = (),
) -> Prepared:
    """Check the recordings and lay them out; raises `InputError` where they cannot give an answer."""
    _refuse(recordings, holdout, tie, known)
    findings = check([*recordings, *holdout])
    _refuse_errors(findings)
    runs = [uniform(r) for r in (*recordings, *holdout)]
    training = runs[: len(recordings)]
    noise = np.array([white_noise(_signals(training, c)) or 1.0 for c in ("current", "speed")])
    untouched = _untouched(training)
    parameters = Parameters.of(search_bounds(training), effects, untouched | dict(known or {}), tie)
    # hold-outs lie on the tape too, but do not count: only what is their own is fitted to them
    problem = Problem(
        parameters,
        jax.tree.map(jnp.asarray, Tape.from_recordings(runs, unloaded, follow=True)),
        jnp.asarray(noise),
        free=jnp.ones(len(parameters.names), bool),
        counts=jnp.arange(len(runs)) < len(recordings),
    )
    roles: list[Role] = [*("train" for _ in recordings), *("holdout" for _ in holdout)]
    return Prepared(runs, roles, findings, untouched, dict(known or {}), tuple(tie), problem)


class Solved(NamedTuple):
    """The best fit that a search and its refinements found, and how it was found."""

    polished: Polished
    search: Search
    seed: int
    interrupted: bool
    seconds: Mapping[str, float]


def solve(
    given: Prepared, search: str, seed: int, progress: ReportProgress | None = None
) -> tuple[Prepared, Solved]:
    """Search the bounds, refine the best candidates; again, from another seed, while the fit is poor.

    **Returns**: the problem with the rotor turned as the fit says, and the fit.
    """
    began = time.perf_counter()
    report = progress or (lambda *args, **kwargs: None)
    problem, searching = given.problem, Tape.from_recordings(given.training)
    noise = np.asarray(problem.noise)

    def look(seed: int) -> Found:
        return global_search(problem.parameters, searching, noise, search, seed, progress=progress)

    middle = (problem.parameters.lower + problem.parameters.upper) / 2
    with ThreadPoolExecutor(1) as beside:
        # a refinement that gives up at once: it is compiled on another core while the search runs
        compiled = beside.submit(_refine, problem, _start(problem.tape, middle), tolerance=1e3)
        found = look(seed)
        searched = time.perf_counter()
        report("refining the best candidates", float(found.best[-1]))
        compiled.result()
    ends = _refine_all(problem, found)
    for attempt in range(1, SEARCHES):
        if found.interrupted or _agreed(ends, problem.outputs):
            break
        before, found = found, look(seed + attempt)
        found = found._replace(evaluations=before.evaluations + found.evaluations)
        ends = sorted([*ends, *_refine_all(problem, found)], key=_fitness)
    given, polished = settle(given, ends[0])
    seconds = {"search": searched - began, "refine": time.perf_counter() - searched}
    record = _search_record(search, found, ends)
    return given, Solved(polished, record, seed, found.interrupted, seconds)


def settle(given: Prepared, end: Refined) -> tuple[Prepared, Polished]:
    """Polish; again, as long as it helps, where a torque depends on how the better motor turns."""
    polished = polish(given.problem, end)
    for _ in range(TURNINGS):
        again = given._replace(problem=turned(given.problem, polished.evaluation.seen))
        if not given.problem.angular:
            return again, polished
        better = polish(again.problem, polished.refined)
        if not better.refined.fitness < polished.refined.fitness:
            break
        given, polished = again, better
    return given, polished


def judge(given: Prepared, solved: Solved) -> Identification:
    """What a fit tells of every parameter and of every run."""
    polished = solved.polished
    problem, training = given.problem, given.training
    parameters = problem.parameters
    free = np.array([k not in polished.refined.at_bound for k in range(len(parameters.names))])
    evaluation = polished.evaluation
    info = information(
        evaluation.residuals, evaluation.jacobian, problem.tape.run, free, len(training)
    )
    chosen = _tidy(problem, polished, info)
    best = chosen.refined
    problem = eqx.tree_at(lambda p: p.noise, problem, jnp.asarray(chosen.noise))

    def interval(k: int, spread: float, centre: float) -> tuple[float, float]:
        if not parameters.logarithmic[k] or spread < QUADRATIC:
            return centre - REACH * spread, centre + REACH * spread
        return profile_interval(problem, best.unknowns, k, spread, info.inflation[k], REACH)

    unknowns, ended = fit_own(problem, best.unknowns)
    fit = _fits(
        given.runs, given.roles, problem.tape, np.asarray(ended.seen), np.asarray(unknowns.local)
    )
    return Identification(
        motor=_plain(parameters(best.unknowns.coordinates)),
        parameters=_estimates(parameters, best, info, given.untouched, given.known, interval),
        unidentified_directions=explain(info.unseen, parameters, training),
        fit=fit,
        noise=_noise_of(fit),
        converged=best.converged,
        seed=solved.seed,
        seconds=solved.seconds,
        search=solved.search,
        findings=given.findings,
        covariance=info.covariance,
        covariance_names=parameters.names,
        messages=_messages(solved, best, chosen is not polished),
    )


def _refuse(recordings, holdout, tie, known) -> None:
    if not recordings:
        raise InputError("RUN", "there is no recording to fit", "Name at least one")
    names = [r.name for r in (*recordings, *holdout)]
    for name in names:
        if names.count(name) > 1:
            raise InputError(name, "two runs have this name", "Rename one, or name it only once")
    check_names("--tie", [name for pair in tie for name in pair])
    check_names("--known", list(known or {}))
    targets = [target for target, _ in tie]
    for target, source in tie:
        if targets.count(target) > 1:
            raise InputError("--tie", f"{target} is tied twice", "Drop one")
        if target == source or target in (known or {}) or target in {b for _, b in tie}:
            raise InputError(
                "--tie", f"{target}={source} ties in a circle or a known value", "Drop one"
            )
    for name, value in (known or {}).items():
        if not 0 < value < np.inf:
            raise InputError("--known", f"{name}={value} is not positive", "Give a value in SI")


def _refuse_errors(findings: Sequence[Finding]) -> None:
    for finding in findings:
        if finding.severity == "error":
            where = ", ".join(filter(None, (finding.run, finding.column, finding.where)))
            raise InputError(where, finding.what, finding.mend)


def _signals(recordings: Sequence[Recording], name: str) -> list[np.ndarray]:
    return [signal for r in recordings if (signal := getattr(r, name)) is not None]


def _untouched(recordings: Sequence[Recording]) -> dict[str, float]:
    """Parameters that no run has anything to do with, at a harmless value."""
    drives = {r.drive for r in recordings}
    touched = {"torque": "J f", "current": "Kt J f", "voltage": "R L Kb Kt J f"}
    known = {name for drive in drives for name in touched[drive].split()}
    return {name: 1.0 for name in PARAMETERS if name not in known}


def _start(tape: Tape, coordinates: jax.Array | np.ndarray) -> Unknowns:
    local = np.column_stack([tape.initial, np.zeros(tape.runs), tape.angle])
    return Unknowns(jnp.asarray(coordinates), jnp.asarray(local))


def _distinct(found: Found, parameters: Parameters) -> list[np.ndarray]:
    """The best few candidates that are not nearly the same, and the best once more with a middling L.

    Where L is too small to matter the misfit is flat, and nothing leads back from there.
    """
    kept: list[np.ndarray] = []
    if "L" in parameters.names:
        L = parameters.names.index("L")
        kept.append(np.array(found.candidates[0]))
        kept[0][L] = (parameters.lower[L] + parameters.upper[L]) / 2
    for candidate in found.candidates:
        if all(np.max(np.abs(candidate - other)) > DISTINCT for other in kept):
            kept.append(candidate)
        if len(kept) == STARTS:
            break
    return kept


def _refine(problem: Problem, start: Unknowns, **options: float) -> Refined:
    """Refine in a thread, to which the precision does not carry over by itself."""
    with jax.enable_x64(True):
        return refine(problem, start, **options)


def _refine_all(problem: Problem, found: Found) -> list[Refined]:
    """Refine the best distinct candidates of a search, one a core at a time; the best first."""
    starts = [_start(problem.tape, candidate) for candidate in _distinct(found, problem.parameters)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return sorted(pool.map(lambda start: _refine(problem, start), starts), key=_fitness)


def _fitness(end: Refined) -> float:
    return end.fitness


def _agreed(ends: Sequence[Refined], outputs: int) -> bool:
    """Whether several starts ended in the best optimum, and it is as good as the noise or was found often.

    A misfit may be the model's, or an optimum of the search's own making: only another search can tell.
    """
    needed = 2 if ends[0].fitness < POOR * outputs else STARTS + 1
    return _times_found(ends) >= needed


def _times_found(ends: Sequence[Refined]) -> int:
    fitness = np.array([end.fitness for end in ends])
    return int(np.sum(fitness <= fitness[0] * (1 + SAME) + 1e-12))


def _tidy(problem: Problem, polished: Polished, info: Information) -> Polished:
    """Along an unseen direction in which Kt may be anything, choose Kt = Kb, equals in SI.

    The direction is straight only nearby, so whatever else is free is refined again; a fit that is worse
    then is no choice.
    """
    names, best = problem.parameters.names, polished.refined
    if "Kt" not in names or "Kb" not in names:
        return polished
    k, b = names.index("Kt"), names.index("Kb")
    along = [d for d in info.unseen if abs(d[k]) > 0.1 and abs(d[b]) < 1e-2]
    if not along:
        return polished
    held = eqx.tree_at(lambda p: p.free, problem, problem.free.at[k].set(False))
    tidied = polished
    for _ in range(TIDYINGS):  # Kb moves a little as well
        coordinates = np.array(tidied.refined.unknowns.coordinates)
        coordinates += along[0] * (coordinates[b] - coordinates[k]) / along[0][k]
        coordinates[k] = coordinates[b]
        unknowns = tidied.refined.unknowns._replace(coordinates=jnp.asarray(coordinates))
        tidied = polish(held, tidied.refined._replace(unknowns=unknowns))
    return tidied if tidied.refined.fitness <= best.fitness * (1 + SAME) else polished


def _plain(motor: Motor) -> Motor:
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in PARAMETERS],
        motor,
        [np.asarray(getattr(motor, name)) for name in PARAMETERS],
    )


def _estimates(
    parameters: Parameters,
    best: Refined,
    info: Information,
    untouched: Mapping[str, float],
    known: Mapping[str, float],
    interval: Callable[[int, float, float], tuple[float, float]],
) -> dict[str, Estimate]:
    """What to say of each parameter; `interval` gives the 95 % interval of a coordinate from its spread."""
    coordinates = np.asarray(best.unknowns.coordinates)
    ties = dict(parameters.ties)
    names = [*PARAMETERS, *(n for n in parameters.names if n not in PARAMETERS)]
    estimates = {}
    for name in names:
        unit, source = unit_of(name), ties.get(name, name)
        if source in untouched and source not in known:
            estimates[name] = Estimate(None, None, None, unit, "not_identifiable")
            continue
        value = parameters.value(name, coordinates)
        if source in known:
            estimates[name] = Estimate(value, 0.0, (value, value), unit, "known")
            continue
        k = parameters.names.index(source)
        status = _status(k, best, info, name in ties)
        if status in ("at_bound", "not_identifiable"):
            estimates[name] = Estimate(value, None, None, unit, status)
            continue
        spread = float(np.sqrt(info.covariance[k, k]))
        low, high = interval(k, spread, coordinates[k])
        if parameters.logarithmic[k]:
            stderr, low, high = value * spread, np.exp(low), np.exp(high)
        else:
            stderr = spread
        ends = (float(low), float(high))
        estimates[name] = Estimate(value, stderr, ends, unit, status)
    return estimates


def _status(k: int, best: Refined, info: Information, tied: bool) -> Status:
    if k in best.at_bound:
        return "at_bound"
    unseen = any(abs(direction[k]) > 0.05 for direction in info.unseen)
    if unseen or np.sqrt(info.covariance[k, k]) > FLAT:
        return "not_identifiable"
    return "tied" if tied else "identified"


def _fits(
    even: Sequence[Recording],
    roles: Sequence[Role],
    tape: Tape,
    seen: np.ndarray,
    local: np.ndarray,
) -> dict[str, RunFit]:
    fits = {}
    for index, (run, role) in enumerate(zip(even, roles, strict=True)):
        current, speed = (tape.samples_of(index, seen[:, c], len(run.time)) for c in range(2))
        driven = run.drive == "voltage"
        fits[run.name] = RunFit(
            role=role,
            current_rmse=_rmse(run.current, current) if driven else None,
            speed_rmse=_rmse(run.speed, speed),
            current_fit_percent=_fit_percent(run.current, current) if driven else None,
            speed_fit_percent=_fit_percent(run.speed, speed),
            load_offset=float(local[index, 2]) if tape.load_unknown[index] else None,
            time=run.time,
            voltage=run.voltage,
            current=run.current,
            current_simulated=current if driven else None,
            speed=run.speed,
            speed_simulated=speed,
            load=run.load,
        )
    return fits


def _rmse(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    return None if measured is None else float(np.sqrt(np.nanmean(np.square(measured - simulated))))


def _fit_percent(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    if measured is None:
        return None
    spread = np.sqrt(np.nansum(np.square(measured - np.nanmean(measured))))
    error = np.sqrt(np.nansum(np.square(measured - simulated)))
    return float(100 * (1 - error / spread)) if spread > 0 else None


def _noise_of(fit: Mapping[str, RunFit]) -> dict[str, float | None]:
    def errors(name: str) -> list[np.ndarray]:
        runs = [f for f in fit.values() if f.role == "train"]
        pairs = [(getattr(f, name), getattr(f, f"{name}_simulated")) for f in runs]
        return [m - s for m, s in pairs if m is not None and s is not None]

    return {
        "current_A": white_noise(errors("current")),
        "speed_rad_s": white_noise(errors("speed")),
    }


def _search_record(method: str, found: Found, ends: Sequence[Refined]) -> Search:
    return Search(
        method=method,
        evaluations=found.evaluations,
        best=found.best,
        median=found.median,
        refined=np.array([end.fitness for end in ends]),
        times_found=_times_found(ends),
    )


def _messages(solved: Solved, best: Refined, tied: bool) -> tuple[str, ...]:
    messages = []
    if solved.interrupted:
        messages.append(f"the search was interrupted after {len(solved.search.best)} generations")
    if not best.converged:
        messages.append("the refinement did not converge: the gradient is not zero at its end")
    if tied:
        messages.append("Kt was set equal to Kb, as they are in SI, and J and f go with it")
    return tuple(messages)
