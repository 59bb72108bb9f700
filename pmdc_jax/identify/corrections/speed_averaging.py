"""A speed computed by differencing an angle is a mean over one or two samples: it is detected and simulated as such.

Where the speed changes within a few samples, such a mean lags, or smooths the motion as a compliant shaft might. The
noise of the angle shows which mean it is; in case of doubt, and between a mean over the last sample and one around each
instant, the fits to both decide. The simulation then reports the same mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...recordings.readings import reading_interval
from ...recordings.recording import AROUND, OVER_BOTH, OVER_LAST, Averaging
from ...recordings.resolution import quantum
from ...simulate import Tape
from ..fit.fitted_runs import FittedRuns
from ..fit.gauss_newton import TOLERANCE
from ..fit.likelihood import MIN_LOG_LIKELIHOOD_GAIN, leaves_only_noise, negative_log_likelihood
from ..fit.polish import Fit
from ..prepare import Prepared

# Most lines of an encoder
MAX_LINES = 2e4
# By how much a computed number of lines may differ from a whole one
LINES_TOLERANCE = 0.02
# Noise power in counts squared next to the Nyquist frequency: 1/12 for a speed rounded to counts, 1/3 for a mean over
# the last sample
COUNTED_AT_NYQUIST = 1 / 6
# The same averaged over all high frequencies: 1/12 and 1/4
COUNTED_IN_ALL = 1 / 7
# Shortest run, in samples, of which these powers are estimated
MIN_SAMPLES = 200
# Frequency bands as shares of the Nyquist frequency: around half of it, near it, next to it, and all that are high
BANDS = ((0.4, 0.6), (0.9, 0.95), (0.98, 1.0), (0.4, 1.0))
# How much smaller an inductance is tried, in natural logarithms
L_REDUCTION = 3.0
# The outputs in question: current and speed, or speed alone
BOTH = slice(None)
SPEED = slice(1, None)
# Power next to the Nyquist frequency over that near it, at most, for a mean over two samples: in theory 1/40
MAX_NYQUIST_RATIO = 1 / 8


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
    return _with_speeds_averaged(without_ends(prepared, SPEED), averaging)


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
    inner = without_ends(prepared, SPEED)
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


def without_ends(prepared: Prepared, outputs: slice = BOTH) -> Prepared:
    """The runs without the first and the last sample of some outputs: there a mean, or a voltage that acts at another
    time, depends on what was not recorded."""
    tape = prepared.problem.tape
    weight = np.array(tape.weight)
    for k, run in enumerate(prepared.runs):
        first = int(np.argmax(tape.blocks_of(k)))
        interval = 1 if run.speed is None else _interval(run.speed)
        for sample in (*range(interval), *range(len(run) - interval, len(run))):
            block, at = divmod(sample, weight.shape[2])
            weight[first + block, outputs, at] = 0.0
    return prepared.with_tape(weight=jnp.asarray(weight))


def _with_speeds_averaged(prepared: Prepared, averaging: Averaging | None) -> Prepared:
    """The runs with their recorded speeds treated as such means, or as instantaneous for None."""
    runs = [
        attrs.evolve(run, averaging=averaging) if run.speed is not None and not is_differentiated else run
        for run, is_differentiated in zip(prepared.runs, prepared.differentiated, strict=True)
    ]
    laid = jax.tree.map(jnp.asarray, Tape.from_recordings(runs, follow=True))
    # the grids are those of each averaging
    names = ("averaging", "span", "later", "turn", "sample_time", "drive", "grid")
    averaged = prepared.with_tape(**{name: getattr(laid, name) for name in names})
    return averaged._replace(runs=runs, averaging=averaging)


def _shifted_earlier(prepared: Prepared) -> Prepared:
    """The runs with their speeds shifted to one sample earlier, those of slow sensors by half their interval."""

    def shifted(speed: np.ndarray) -> np.ndarray:
        shift = max(_interval(speed) // 2, 1)
        return np.append(speed[shift:], np.full(shift, np.nan))

    runs = [run if run.speed is None else attrs.evolve(run, speed=shifted(run.speed)) for run in prepared.runs]
    laid = Tape.from_recordings(runs)
    weight = np.stack([prepared.problem.tape.weight[:, 0], laid.weight[:, 1]], 1)
    moved = prepared.with_tape(measured=jnp.asarray(laid.measured), weight=jnp.asarray(weight))
    return without_ends(moved, SPEED)


def refitted(prepared: Prepared, fit: Fit, inductance: float | None = None, tolerance: float = TOLERANCE) -> FittedRuns:
    """The runs, and the best fit to them that starts from `fit`, or from there with a smaller inductance: a large one
    may have compensated part of a sample of delay.

    **Arguments**: `inductance`, H, if it is known about which, to start from; `tolerance`, as of `polish`.
    """
    parameters = prepared.problem.parameters
    starts = [fit.optimum]
    if "L" in parameters.names:
        L = parameters.names.index("L")
        along_L = np.eye(len(parameters.names))[L]
        if inductance is not None:
            change = np.log(inductance) - float(fit.coordinates[L])
            starts = [fit.optimum.moved(parameters, change * along_L)]
        elif prepared.averaging == OVER_LAST or prepared.timing.current_mean:
            smaller = fit.optimum.moved(parameters, -L_REDUCTION * along_L)
            if smaller.unknowns.coordinates[L] < fit.coordinates[L]:  # not at its bound
                starts.append(smaller)
    ends = [FittedRuns.polished(prepared, start, tolerance) for start in starts]
    return min(ends, key=lambda end: end.fit.cost)


def _averaging_by_noise(prepared: Prepared) -> tuple[Averaging | None, float, bool]:
    """The mean that the noise of the speeds suggests, None if none; the gain in log-likelihood that it must bring, as
    in `averaging_of_counts`; and whether the speeds are counts.

    A mean over the last sample can be told from a delay only if the speed is counted, or where the current is such a
    mean, and from an inductance only if the current was measured.
    """
    if _is_slow(prepared):
        # with or without counts, only the fit tells
        return OVER_LAST, MIN_LOG_LIKELIHOOD_GAIN, False
    speeds = _speeds(prepared)
    counts = _in_counts(speeds)
    mean, min_gain = averaging_of_counts(counts) if counts else averaging_of_differences([s for s, _ in speeds])
    if mean is None and speeds and not counts and prepared.timing.current_mean:
        mean = OVER_LAST
    if mean == OVER_LAST and not prepared.problem.samples[0] > 0:
        mean = None
    return mean, min_gain, bool(counts)


def averaging_of_counts(counts: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The mean that speeds in counts per sample are, None if none, and the gain in log-likelihood that it must bring;
    if negative, the loss that is accepted.

    Angles rounded to counts have white noise of 1/12 count squared. In differences over one sample its power is four
    times that at the Nyquist frequency and twice that at half of it; in differences over two samples, in half counts,
    zero and four times. While the rotor turns steadily the rounding error is not noise but a beat at some frequency:
    only its total power is known then, and the fit must decide.
    """
    middle, high, highest, in_all = _band_powers(counts)
    if highest > COUNTED_AT_NYQUIST:
        clearly = highest > np.sqrt(2.0) * max(middle, COUNTED_AT_NYQUIST)
        return OVER_LAST, -np.inf if clearly else -MIN_LOG_LIKELIHOOD_GAIN
    if in_all > COUNTED_IN_ALL and not highest < MAX_NYQUIST_RATIO * high:
        return OVER_LAST, MIN_LOG_LIKELIHOOD_GAIN
    return OVER_BOTH if highest < MAX_NYQUIST_RATIO * high else None, -MIN_LOG_LIKELIHOOD_GAIN


def averaging_of_differences(speeds: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The same for speeds that are no counts: differences over two samples have no power at the Nyquist frequency, any
    other signal with noise or steps has as much there as near it."""
    _, high, highest, _ = _band_powers(speeds) if speeds else (0.0, 0.0, 0.0, 0.0)
    return OVER_BOTH if highest < MAX_NYQUIST_RATIO * high else None, MIN_LOG_LIKELIHOOD_GAIN


def _band_powers(signals: Sequence[np.ndarray]) -> Float[np.ndarray, "bands"]:
    """Mean power of the signals in each of the `BANDS`, scaled as the variance of white noise with that power.

    Computed from second differences, since the much stronger low frequencies would leak into the high ones.
    """
    powers = []
    for signal in signals:
        bends = np.diff(signal, 2)
        window = np.hanning(len(bends) + 1)[:-1]
        power = np.abs(np.fft.rfft((bends - bends.mean()) * window)) ** 2 / (window @ window)
        share = np.fft.rfftfreq(len(bends), 0.5)[1:]
        white = power[1:] / (2 * np.sin(np.pi * share / 2)) ** 4
        powers.append([white[(low < share) & (share < high)].mean() for low, high in BANDS])
    return np.mean(powers, axis=0)


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


def _in_counts(speeds: Sequence[tuple[np.ndarray, float]]) -> list[np.ndarray]:
    """The speeds in counts per sample of an encoder with a whole number of lines; empty if they are no such counts."""
    counts = []
    for speed, sample_time in speeds:
        # a speed may jump by many counts from sample to sample, but its sorted values lie closer together
        step = quantum(np.diff(speed)) or quantum(np.diff(np.unique(speed)))
        lines = 2 * np.pi / step / sample_time if step else np.inf
        if lines > MAX_LINES:
            return []
        in_counts = speed / step
        # the tolerance grows with the error of a count where speeds were written with few digits
        rounded = np.quantile(np.abs(in_counts - np.round(in_counts)), 0.95)
        whole = LINES_TOLERANCE + lines * rounded / np.max(np.abs(in_counts))
        if abs(lines - round(lines)) > whole:
            return []
        counts.append(in_counts)
    return counts
