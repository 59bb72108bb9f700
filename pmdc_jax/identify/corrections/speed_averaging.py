"""A speed computed by differencing an angle is a mean over one or two samples: it is detected and simulated as such.

Where the speed changes within a few samples, such a mean lags, or smooths the motion as a compliant shaft might. The
noise of the angle shows which mean it is; in case of doubt, and between a mean over the last sample and one around each
instant, the fits to both decide. The simulation then reports the same mean.
"""

from __future__ import annotations

import attrs
import jax.numpy as jnp
import numpy as np

from ...recordings.readings import reading_interval
from ...recordings.recording import AROUND, OVER_LAST, Averaging
from ...simulate import Tape
from ..fit.fitted_runs import FittedRuns, refitted
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, leaves_only_noise, negative_log_likelihood
from ..prepare import SPEED, Prepared
from .averaging_by_noise import averaging_of_counts, averaging_of_differences, in_counts

# Shortest run, in samples, that shows the noise of its speed
MIN_SAMPLES = 200


def seems_averaged(prepared: Prepared) -> bool:
    """Whether the speeds are encoder counts with the noise of a mean."""
    mean, _, counted = _averaging_by_noise(prepared)
    return counted and mean is not None


def with_evident_averaging(prepared: Prepared) -> Prepared:
    """The runs with their speeds treated as means over the last sample where the noise leaves no doubt of it, and
    nothing else is known of them."""
    if prepared.averaging:
        return prepared
    mean, min_gain, _ = _averaging_by_noise(prepared)
    if mean is None or not np.isneginf(min_gain):
        return prepared
    return with_means(prepared, mean)


def with_means(prepared: Prepared, averaging: Averaging) -> Prepared:
    """The runs with their recorded speeds treated as such means, without those at their ends."""
    return _with_speeds_averaged(prepared.without_ends(SPEED), averaging)


def with_averaging(fitted: FittedRuns, beside_more: bool = False) -> FittedRuns:
    """The runs with their speeds treated as means, where that is what was recorded, and the fit to them.

    A speed that lags more than a mean would is late for another reason.

    **Arguments**: `beside_more`, whether a mean around each instant is found even if more than noise is then left.

    **Returns**: both unchanged if no other mean was found.
    """
    prepared, fit = fitted
    if prepared.averaging == OVER_LAST and not _is_slow(prepared):
        return _or_around(fitted, beside_more)
    if prepared.averaging:
        return fitted
    mean, min_gain, counted = _averaging_by_noise(prepared)
    if mean is None:
        return fitted
    inner = prepared.without_ends(SPEED)
    instantaneous = FittedRuns(inner, fit)
    averaged = refitted(_with_speeds_averaged(inner, mean), fit)
    unlikeliness = negative_log_likelihood(averaged)
    if not negative_log_likelihood(instantaneous) - unlikeliness > min_gain:
        around = _or_around(instantaneous, beside_more) if counted and mean == OVER_LAST else instantaneous
        return fitted if around is instantaneous else around
    if not counted:
        # a mean over the last and the next sample has no lag: a speed that fits better a sample earlier, or as a mean
        # over the last sample, is merely late
        last = negative_log_likelihood(refitted(_with_speeds_averaged(inner, OVER_LAST), fit))
        other = averaged.fit if mean == OVER_LAST else fit
        if last < unlikeliness or refitted(_shifted_earlier(inner), fit).fit.cost < other.cost:
            return fitted
    return averaged


def _or_around(other: FittedRuns, beside_more: bool) -> FittedRuns:
    """The runs with their speeds treated as means around each instant, if these are clearly likelier than as they are
    treated now and leave nothing but noise, unless `beside_more`, and the fit to them; otherwise both unchanged."""
    around = refitted(_with_speeds_averaged(other.prepared, AROUND), other.fit)
    gain = negative_log_likelihood(other) - negative_log_likelihood(around)
    return around if gain > MIN_LOG_LIKELIHOOD_GAIN and (beside_more or leaves_only_noise(around)) else other


def without_averaging(prepared: Prepared) -> Prepared:
    """The runs with their recorded speeds treated as instantaneous again."""
    return _with_speeds_averaged(prepared, None) if prepared.averaging else prepared


def _with_speeds_averaged(prepared: Prepared, averaging: Averaging | None) -> Prepared:
    """The runs with their recorded speeds treated as such means, or as instantaneous for None."""
    runs = [
        attrs.evolve(run, averaging=averaging) if run.speed is not None and not is_differentiated else run
        for run, is_differentiated in zip(prepared.runs, prepared.differentiated, strict=True)
    ]
    # the grids are those of each averaging
    fields = ("averaging", "span", "later", "turn", "sample_time", "drive", "grid")
    return prepared.with_tape_of(runs, *fields, follow=True)._replace(runs=runs, averaging=averaging)


def _shifted_earlier(prepared: Prepared) -> Prepared:
    """The runs with their speeds shifted to one sample earlier, those of slow sensors by half their interval."""

    def shifted(speed: np.ndarray) -> np.ndarray:
        shift = max(_interval(speed) // 2, 1)
        return np.append(speed[shift:], np.full(shift, np.nan))

    runs = [run if run.speed is None else attrs.evolve(run, speed=shifted(run.speed)) for run in prepared.runs]
    laid = Tape.from_recordings(runs)
    weight = np.stack([prepared.problem.tape.weight[:, 0], laid.weight[:, 1]], 1)
    moved = prepared.with_tape(measured=jnp.asarray(laid.measured), weight=jnp.asarray(weight))
    return moved.without_ends(SPEED)


def _averaging_by_noise(prepared: Prepared) -> tuple[Averaging | None, float, bool]:
    """The mean that the noise of the speeds suggests, None if none; the gain in log-likelihood that it must bring, as
    in `averaging_of_counts`; and whether the speeds are counts.

    A mean over the last sample can be told from a delay only if the speed is counted, or where the current is such a
    mean, and from an inductance only if the current was measured, unless the noise leaves no doubt.
    """
    if _is_slow(prepared):
        # with or without counts, only the fit tells
        return OVER_LAST, MIN_LOG_LIKELIHOOD_GAIN, False
    speeds = _speeds(prepared)
    counts = in_counts(speeds)
    mean, min_gain = averaging_of_counts(counts) if counts else averaging_of_differences([s for s, _ in speeds])
    if mean is None and speeds and not counts and prepared.timing.current_mean:
        mean = OVER_LAST
    if mean == OVER_LAST and not prepared.problem.samples[0] > 0 and not np.isneginf(min_gain):
        mean = None
    return mean, min_gain, bool(counts)


def _is_slow(prepared: Prepared) -> bool:
    """Whether the sensor of the speed is slower than the log."""
    return any(run.speed is not None and _interval(run.speed) > 1 for run in prepared.training)


def _interval(speed: np.ndarray) -> int:
    """The samples from one reading of a speed to the next."""
    return reading_interval(~np.isnan(speed))


def _speeds(prepared: Prepared) -> list[tuple[np.ndarray, float]]:
    """The readings of the speeds, rad/s, of all training runs long enough to show their noise, and the time from one to
    the next, s."""
    recorded = [
        (run.speed, run.time)
        for run, is_differentiated in zip(prepared.training, prepared.differentiated, strict=False)
        if run.speed is not None and not is_differentiated
    ]
    known = [(speed[~np.isnan(speed)], time[~np.isnan(speed)]) for speed, time in recorded]
    return [(speed, float(np.median(np.diff(time)))) for speed, time in known if len(speed) >= MIN_SAMPLES]
