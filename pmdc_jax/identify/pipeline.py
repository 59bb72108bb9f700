"""From recordings to an `Identification`: check, bound, search, refine, judge."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import NormalDist
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..check import check
from ..errors import InputError
from ..motor import PARAMETERS, Motor
from ..precision import double_precision
from ..recording import Finding, Recording
from ..simulate import Tape, uniform
from .bounds import search_bounds
from .identifiability import explain
from .identification import Direction, Estimate, Identification, Role, RunFit, Search, Status
from .noise import white_noise
from .parameters import Parameters, check_names, effects_named, unit_of
from .profile import QUADRATIC, profile_interval
from .refine import Problem, Refined, Unknowns, fit_own, polish, refine
from .search import Found
from .search import search as global_search
from .uncertainty import FLAT, Information, information

if TYPE_CHECKING:
    from ..report.terminal import ReportProgress

STARTS = 4
REACH = NormalDist().inv_cdf(0.975)  # of a 95 % interval, in standard errors
# Two refinements found the same optimum if their fitness agrees to this share.
SAME = 1e-4
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
    _refuse(recordings, holdout, tie, known)
    findings = check([*recordings, *holdout])
    _refuse_errors(findings)
    runs = [*recordings, *holdout]
    even = [uniform(r) for r in runs]
    training = even[: len(recordings)]
    noise = np.array([white_noise(_signals(training, c)) or 1.0 for c in ("current", "speed")])
    untouched = _untouched(training)
    parameters = Parameters.of(
        search_bounds(training), effects_named(effects), untouched | dict(known or {}), tie
    )

    # hold-outs lie on the tape too, but do not count: only what is their own is fitted to them
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings(even, unloaded))
    problem = Problem(
        parameters,
        tape,
        jnp.asarray(noise),
        free=jnp.ones(len(parameters.names), bool),
        counts=jnp.arange(len(runs)) < len(recordings),
    )
    middle = (parameters.lower + parameters.upper) / 2
    with ThreadPoolExecutor(1) as beside:
        # a refinement that gives up at once: it is compiled on another core while the search runs
        compiled = beside.submit(_refine, problem, _start(tape, middle), tolerance=1e3)
        found = global_search(
            parameters, Tape.from_recordings(training), noise, search, seed, progress=progress
        )
        searched = time.perf_counter()
        report("refining the best candidates", float(found.best[-1]))
        compiled.result()
    ends = _refine_all(problem, [_start(tape, c) for c in _distinct(found)])
    best, at_best, scale = polish(problem, ends[0])
    refined = time.perf_counter()

    report("judging the uncertainty", best.fitness)
    free = np.array([k not in best.at_bound for k in range(len(parameters.names))])
    info = information(at_best.residuals, at_best.jacobian, tape.run, free, len(recordings))
    best = _tidy(best, info, parameters)
    motor = _plain(parameters(best.unknowns.coordinates))
    directions = explain(info.unseen, parameters, training)
    problem = eqx.tree_at(lambda p: p.noise, problem, jnp.asarray(scale))

    def interval(k: int, spread: float, centre: float) -> tuple[float, float]:
        if not parameters.logarithmic[k] or spread < QUADRATIC:
            return centre - REACH * spread, centre + REACH * spread
        return profile_interval(problem, best.unknowns, k, spread, info.inflation[k], REACH)

    unknowns, ended = fit_own(problem, best.unknowns)
    roles: list[Role] = [*("train" for _ in recordings), *("holdout" for _ in holdout)]
    fit = _fits(even, roles, tape, np.asarray(ended.seen), np.asarray(unknowns.local))
    return Identification(
        motor=motor,
        parameters=_estimates(parameters, best, info, untouched, dict(known or {}), interval),
        unidentified_directions=directions,
        fit=fit,
        noise=_noise_of(fit),
        converged=best.converged,
        seed=seed,
        seconds={
            "search": searched - began,
            "refine": refined - searched,
            "total": time.perf_counter() - began,
        },
        search=_search_record(search, found, ends, best),
        findings=findings,
        covariance=info.covariance,
        covariance_names=parameters.names,
        messages=_messages(found, best, directions),
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


def _distinct(found: Found) -> list[np.ndarray]:
    """The best few candidates that are not nearly the same."""
    kept: list[np.ndarray] = []
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


def _refine_all(problem: Problem, starts: Sequence[Unknowns]) -> list[Refined]:
    """Refine from several starts, one a core at a time; the best first."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ends = pool.map(lambda start: _refine(problem, start), starts)
        return sorted(ends, key=lambda end: end.fitness)


def _tidy(best: Refined, info: Information, parameters: Parameters) -> Refined:
    """Along an unseen direction in which Kt may be anything, choose Kt = Kb, equals in SI."""
    names = parameters.names
    if "Kt" not in names or "Kb" not in names:
        return best
    k, b = names.index("Kt"), names.index("Kb")
    coordinates = np.array(best.unknowns.coordinates)
    for direction in info.unseen:
        if abs(direction[k]) > 0.1 and abs(direction[b]) < 1e-2:
            coordinates += direction * (coordinates[b] - coordinates[k]) / direction[k]
            break
    local = np.array(best.unknowns.local)
    return best._replace(unknowns=Unknowns(jnp.asarray(coordinates), jnp.asarray(local)))


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


def _search_record(method: str, found: Found, ends: Sequence[Refined], best: Refined) -> Search:
    fitness = np.array([end.fitness for end in ends])
    return Search(
        method=method,
        evaluations=found.evaluations,
        best=found.best,
        median=found.median,
        refined=fitness,
        times_found=int(np.sum(fitness <= fitness[0] * (1 + SAME) + 1e-12)),
    )


def _messages(found: Found, best: Refined, directions: Sequence[Direction]) -> tuple[str, ...]:
    messages = []
    if found.interrupted:
        messages.append(f"the search was interrupted after {len(found.best)} generations")
    if not best.converged:
        messages.append("the refinement did not converge: the gradient is not zero at its end")
    if any("Kt" in d.parameters for d in directions):
        messages.append("Kt was set equal to Kb, as they are in SI, and J and f go with it")
    return tuple(messages)
