"""Results of an identification: estimates, intervals and the fit of every run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..motor import PARAMETERS, Motor
from ..recordings.recording import OVER_BOTH, OVER_LAST, Recording
from ..runtime.threads import map_in_threads
from ..simulate import RunUnknowns, Tape
from .fit.polish import Fit, fit_at, polish
from .fit.refine import Optimum
from .fit.run_unknowns import fit_run_unknowns
from .identification import Direction, Estimate, Identification, Role, RunFit, Status
from .noise.sensor_noise import ratio_to_noise, rms, white_noise
from .parameters import Parameters, unit_of
from .prepare import Prepared
from .problem import Problem, Unknowns
from .solve import FITNESS_TOLERANCE, Solved
from .uncertainty.covariance import MIN_UNSEEN_STDERR, Information, information_of
from .uncertainty.identifiability import (
    MIN_SHARE,
    enumerate_names,
    explain_directions,
    sees_torque_scale,
)
from .uncertainty.profile import QUADRATIC_STDERR, profile_interval

# Residuals this many times their white noise are reported
MAX_RESIDUAL_RATIO = 2.0
# An unknown load is worth a message from this share of the motor's torque on (root mean square),
MIN_LOAD_SHARE = 0.02
# if it differs by less than this share of itself between the runs
MAX_LOAD_SPREAD = 0.2
# Initial rise of a winding's resistance that is worth a message
MIN_INITIAL_RISE = 0.005
# Units of what drives a motor
UNITS = {"voltage": "V", "current": "A", "torque": "N m"}
# Spans over which a speed may be averaged
AVERAGING_SPANS = {
    OVER_LAST: "the last sample interval",
    OVER_BOTH: "the last and the next sample interval",
}
# A parameter is unseen by itself if at least this share of it lies in unseen directions
MIN_UNSEEN_SHARE = 0.99
# A refit makes a parameter visible: it then changes the outputs by this share of what the most sensitive one does
VISIBLE_SHARE = 0.3


def results_of(prepared: Prepared, solved: Solved) -> Identification:
    """The result of a fit: estimates with uncertainty and status, and the fit of every run."""
    problem, training = prepared.problem, prepared.training
    released = _released_from_bounds(problem, solved.fit)
    parameters = problem.parameters
    info = information_of(problem, released)
    chosen = _with_Kt_equal_Kb(problem, released, info)
    visible = [_refit_with_visible(problem, chosen, k) for k in _invisible_alone(parameters, info)]
    others = [information_of(problem, fit) for fit in visible if fit is not None]
    # what any fit as good does not determine is not determined
    info = max([info, *others], key=lambda i: i.unseen_share.sum())
    best = chosen.optimum
    motor = _with_numpy_arrays(parameters(best.unknowns.coordinates))
    problem = eqx.tree_at(lambda p: p.noise, problem, jnp.asarray(chosen.noise))

    unknowns, ended = fit_run_unknowns(problem, best.unknowns)
    fit = run_fits(
        prepared.runs, prepared.roles, problem.tape, np.asarray(ended.simulated), unknowns.runs
    )
    names, covariance = parameters.with_tied(info.covariance)
    noise = {
        name: white_noise([residual for _, residual in _measured_and_residuals(fit, name)])
        for name in ("current", "speed")
    }
    return Identification(
        motor=motor,
        parameters=_estimates(parameters, best, info, prepared, _intervals(problem, best, info)),
        unidentified_directions=(
            *_without_effect(prepared),
            *explain_directions(info.unseen, parameters, training),
        ),
        fit=fit,
        noise={"current_A": noise["current"], "speed_rad_s": noise["speed"]},
        distance=best.distance,
        seed=solved.seed,
        seconds=solved.seconds,
        search=solved.search,
        findings=prepared.findings,
        covariance=covariance,
        covariance_names=names,
        messages=(
            *_messages(prepared, solved, Kt_set_to_Kb=chosen is not released),
            *_unknown_load(motor, _of_training(fit)),
            *_warm_windings(prepared, unknowns.runs.rise),
        ),
        missed=_large_residuals(fit),
    )


def _intervals(
    problem: Problem, best: Optimum, info: Information
) -> dict[int, tuple[float, float]]:
    """The 95 % intervals of the identified coordinates, in parallel on all cores."""
    coordinates = np.asarray(best.unknowns.coordinates)
    # teeth that meet at another moment change all that follows: the sum of squares jumps, and no profile is smooth
    jumps = problem.parameters(best.unknowns.coordinates).toothed is not None

    def interval(k: int) -> tuple[float, float]:
        spread, reach = float(np.sqrt(info.covariance[k, k])), float(info.interval_factor[k])
        # the refits of a profile would not reach as far along an unseen direction as the truth may lie
        hidden = info.unseen_variance[k] > info.covariance[k, k] / 2
        quadratic = not problem.parameters.logarithmic[k] or spread < QUADRATIC_STDERR
        if quadratic or hidden or jumps:
            return coordinates[k] - reach * spread, coordinates[k] + reach * spread
        return profile_interval(problem, best.unknowns, k, spread, info.inflation[k], reach)

    places = range(len(coordinates))
    identified = [k for k in places if _status(k, problem.parameters, best, info) == "identified"]
    return dict(zip(identified, map_in_threads(interval, identified), strict=True))


def _released_from_bounds(problem: Problem, polished: Fit) -> Fit:
    """The fit with those coordinates released from their bound that an unseen direction of several parameters leaves
    arbitrary."""

    def released(fixed: Sequence[int]) -> Fit:
        return polished._replace(optimum=polished.optimum._replace(at_bound=tuple(fixed)))

    bound = polished.at_bound
    unseen = information_of(problem, released(())).unseen if bound else ()
    several = [d for d in unseen if np.max(np.abs(d)) <= MIN_UNSEEN_SHARE]
    return released([k for k in bound if all(abs(d[k]) <= MIN_SHARE for d in several)])


def _invisible_alone(parameters: Parameters, info: Information) -> list[int]:
    """Positive parameters that change nothing by themselves, because they are nearly zero for example."""
    return [
        int(k)
        for k in np.flatnonzero(info.unseen_share > MIN_UNSEEN_SHARE)
        if parameters.logarithmic[k]
    ]


def _refit_with_visible(problem: Problem, polished: Fit, k: int) -> Fit | None:
    """An equally good fit in which parameter `k` is large enough to be visible, None if there is no such fit. Only
    there do the derivatives show which parameters it trades off against.

    Where only voltage and speed are measured, friction may be zero and Kb alone decides the speed per volt, or friction
    takes part of the voltage and Kb is smaller.
    """
    jacobian = np.asarray(polished.evaluation.jacobian)[problem.fitted_blocks]
    lengths = np.sqrt(np.square(jacobian[..., : len(problem.free)]).sum((0, 1, 2)))
    coordinates = np.array(polished.coordinates)
    coordinates[k] += np.log(VISIBLE_SHARE * lengths.max() / max(lengths[k], 1e-300))
    coordinates[k] = np.clip(
        coordinates[k], problem.parameters.lower[k], problem.parameters.upper[k]
    )
    unknowns = polished.unknowns._replace(coordinates=jnp.asarray(coordinates))
    refitted = _as_good_with_fixed(problem, polished, k, unknowns)
    return fit_at(problem, refitted.optimum._replace(at_bound=())) if refitted else None


def _as_good_with_fixed(problem: Problem, polished: Fit, k: int, start: Unknowns) -> Fit | None:
    """The fit from other unknowns with coordinate `k` fixed as there; None if it is worse than the one before."""
    with_k_fixed = eqx.tree_at(lambda p: p.free, problem, problem.free.at[k].set(False))
    refitted = polish(with_k_fixed, polished.optimum._replace(unknowns=start))
    # false where the simulation failed: its fitness is infinite
    as_good = refitted.fitness <= polished.fitness * (1 + FITNESS_TOLERANCE)
    return refitted if as_good else None


def _with_Kt_equal_Kb(problem: Problem, polished: Fit, info: Information) -> Fit:
    """The fit with all torques scaled so that Kt = Kb, which are equal in SI, where the runs do not show that scale."""
    parameters, unknowns = problem.parameters, polished.unknowns
    if sees_torque_scale(info.unseen, parameters.names):
        return polished
    coordinates = np.asarray(polished.coordinates)
    factor = parameters.value("Kb", coordinates) / parameters.value("Kt", coordinates)
    runs = unknowns.runs
    scaled = unknowns._replace(
        coordinates=jnp.asarray(parameters.with_torques_scaled(coordinates, factor)),
        runs=runs._replace(load_offset=runs.load_offset * factor),
    )
    # with Kt fixed, as along the unseen direction no refinement ends
    Kt = parameters.names.index("Kt")
    return _as_good_with_fixed(problem, polished, Kt, scaled) or polished


def _with_numpy_arrays(motor: Motor) -> Motor:
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in PARAMETERS],
        motor,
        [np.asarray(getattr(motor, name)) for name in PARAMETERS],
    )


def _estimates(
    parameters: Parameters,
    best: Optimum,
    info: Information,
    prepared: Prepared,
    intervals: Mapping[int, tuple[float, float]],
) -> dict[str, Estimate]:
    """The estimate of each parameter, from the 95 % `intervals` of the identified coordinates."""
    coordinates = np.asarray(best.unknowns.coordinates)
    ties = dict(parameters.ties)
    names = [*PARAMETERS, *(n for n in parameters.names if n not in PARAMETERS)]
    estimates = {}
    for name in names:
        unit, source = unit_of(name), ties.get(name, name)
        if source in prepared.irrelevant and source not in prepared.known:
            estimates[name] = Estimate(None, None, None, unit, "not_identifiable")
            continue
        value = parameters.value(name, coordinates)
        if source in prepared.known:
            estimates[name] = Estimate(value, 0.0, (value, value), unit, "known")
            continue
        k = parameters.names.index(source)
        status = _status(k, parameters, best, info)
        if status != "identified":
            estimates[name] = Estimate(value, None, None, unit, status)
            continue
        spread = float(np.sqrt(info.covariance[k, k]))
        low, high = intervals[k]
        if parameters.logarithmic[k]:
            stderr, low, high = value * spread, np.exp(low), np.exp(high)
        else:
            stderr = spread
        ends = (float(low), float(high))
        estimates[name] = Estimate(value, stderr, ends, unit, "tied" if name in ties else status)
    return estimates


def _status(k: int, parameters: Parameters, best: Optimum, info: Information) -> Status:
    if k in best.at_bound:
        return "at_bound"
    variance, unseen_variance = info.covariance[k, k], info.unseen_variance[k]
    if info.unseen_share[k] > MIN_SHARE or np.sqrt(variance) > MIN_UNSEEN_STDERR:
        return "not_identifiable"
    # a torque of either sign whose scale is unseen: in its unit it is too small to make up much of a direction
    size = 0.0 if parameters.logarithmic[k] else abs(float(best.unknowns.coordinates[k]))
    if size and np.sqrt(unseen_variance) > max(MIN_UNSEEN_STDERR * size, np.sqrt(variance / 2)):
        return "not_identifiable"
    return "identified"


def run_fits(
    runs: Sequence[Recording],
    roles: Sequence[Role],
    tape: Tape,
    simulated: np.ndarray,
    own: RunUnknowns,
) -> dict[str, RunFit]:
    """The fit of each run: what was measured beside what was `simulated`, the outputs in the blocks of the tape."""
    # as fitted: a speed corrected for what the sensor added, and both without samples that do not count
    fitted = np.where(np.asarray(tape.weight) > 0, tape.measured, np.nan)
    fits = {}
    for index, (run, role) in enumerate(zip(runs, roles, strict=True)):
        current, speed = tape.samples_of(index, simulated, len(run)).T
        i, w = tape.samples_of(index, fitted, len(run)).T
        driven = run.drive == "voltage"
        i = i if driven and run.current is not None else None
        w = w if run.speed is not None else None
        fits[run.name] = RunFit(
            role=role,
            current_rmse=_rmse(i, current),
            speed_rmse=_rmse(w, speed),
            current_fit_percent=_fit_percent(i, current),
            speed_fit_percent=_fit_percent(w, speed),
            load_offset=float(own.load_offset[index]) if tape.load_unknown[index] else None,
            time=run.time,
            voltage=run.voltage,
            current=i if driven else run.current,
            current_simulated=current if driven else None,
            speed=w,
            speed_simulated=speed,
            load=run.load,
        )
    return fits


def _rmse(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    return None if measured is None else rms(measured - simulated)


def _fit_percent(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    if measured is None:
        return None
    spread = np.sqrt(np.nansum(np.square(measured - np.nanmean(measured))))
    error = np.sqrt(np.nansum(np.square(measured - simulated)))
    return float(100 * (1 - error / spread)) if spread > 0 else None


def _of_training(fit: Mapping[str, RunFit]) -> list[RunFit]:
    return [one for one in fit.values() if one.role == "train"]


def _measured_and_residuals(
    fit: Mapping[str, RunFit], name: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """An output as measured and its residuals, in every training run that has it."""
    pairs = [(getattr(f, name), f.residual(name)) for f in _of_training(fit)]
    return [(measured, residual) for measured, residual in pairs if residual is not None]


def _large_residuals(fit: Mapping[str, RunFit]) -> dict[str, float]:
    """RMS of the residuals over the white noise of the runs, for the outputs for which that exceeds
    `MAX_RESIDUAL_RATIO`."""
    ratios = {
        name: ratio_to_noise(_measured_and_residuals(fit, name)) for name in ("current", "speed")
    }
    return {name: ratio for name, ratio in ratios.items() if ratio > MAX_RESIDUAL_RATIO}


def _without_effect(prepared: Prepared) -> list[Direction]:
    """The parameters that affect no run, as of the electrical half where only a torque is recorded."""
    names = tuple(name for name in prepared.irrelevant if name not in prepared.known)
    if not names:
        return []
    lacking = "a voltage" if {"R", "L"} & set(names) else "a turning rotor"
    why = f"No run has {lacking}, so {enumerate_names(names)} affect none of them"
    return [Direction(names, why, "Add a run with a voltage, a current and a speed")]


def _unknown_load(motor: Motor, training: Sequence[RunFit]) -> list[str]:
    """What the unknown load of the runs may be, where it is considerable and the same in all of them."""
    loads = [fit.load_offset for fit in training if fit.load_offset is not None]
    currents = [fit.current for fit in training if fit.current is not None]
    if not loads or not currents:
        return []
    least, largest = sorted((min(loads), max(loads)), key=abs)
    motor_torque = float(motor.Kt) * rms(np.concatenate(currents))
    differ = abs(largest - least) > MAX_LOAD_SPREAD * abs(least)
    if differ or abs(least) < MIN_LOAD_SHARE * motor_torque:
        return []
    what = "a constant load"
    if all(np.ptp(np.sign(fit.speed_simulated)) < 2 for fit in training):
        what += ", or friction, which looks the same while the motor turns one way only"
    return [
        f"the unknown load is {largest:.3g} N m in all runs: {what}. If nothing was attached, give --unloaded"
    ]


def _warm_windings(prepared: Prepared, rises: Float[Array, " runs"]) -> list[str]:
    """The runs that begin with a warmer winding than another one."""
    begins_warm = prepared.problem.begins_warm
    if begins_warm is None or not prepared.problem.has_temperature:
        return []
    warmer = [
        f"{run.name} by {100 * rise:.2g} %"
        # the tape is padded by runs without samples
        for run, warm, rise in zip(prepared.runs, begins_warm, rises, strict=False)
        if warm and rise > MIN_INITIAL_RISE
    ]
    if not warmer:
        return []
    return [
        f"the winding is warm, and R larger, at the start of {', '.join(warmer)}: this is modelled"
    ]


def _messages(prepared: Prepared, solved: Solved, Kt_set_to_Kb: bool) -> tuple[str, ...]:
    messages = [
        f"{run.name}: the recorded {run.drive} has {prepared.input_noise[run.name]:.3g} {UNITS[run.drive]} of sensor "
        "noise that did not reach the motor: it was removed"
        for run in prepared.runs
        if run.name in prepared.input_noise
    ]
    acts = "steps between samples" if prepared.stepped else prepared.timing.what
    if acts:
        messages.append(f"the voltage {acts}: this is modelled")
    if prepared.timing.current_mean:
        messages.append("the current is a mean over the last sample interval: this is modelled")
    if prepared.averaging:
        messages.append(
            f"the speed is a mean over {AVERAGING_SPANS[prepared.averaging]}, as differences of an angle are:"
            " this is modelled"
        )
    if solved.search.interrupted:
        messages.append(f"the search was interrupted after {len(solved.search.best)} generations")
    if Kt_set_to_Kb:
        messages.append("Kt was set equal to Kb, as holds in SI units, and J and f scale with it")
    return tuple(messages)
