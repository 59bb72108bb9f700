"""A speed that is a difference of angles, and so a mean over one sample or two: taken for what it is.

Where the motor speeds up or slows down within some samples such a mean is late, or rounds its motion as a soft shaft
might. The noise of the angles shows which one it is, and in case of doubt the fits to the one and to the other. The
simulation then reports the same mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...recording import OVER_BOTH, OVER_LAST, Averaging
from ...simulate import Tape
from ..likelihood import LIKELIER, negative_log_likelihood
from ..noise import quantum
from ..polish import Fit, polish
from ..prepare import Prepared

# An encoder has fewer lines, and a whole number of them
LINES, WHOLE = 2e4, 0.02
# Power in counts squared, between that of a speed that was rounded to counts, 1/12, and that of such a mean, 1/3
COUNTED = 1 / 6
# ... and the same of the mean over all high frequencies, between 1/12 and 1/4
COUNTED_IN_ALL = 1 / 7
# ... known of a run of so many samples
ENOUGH = 200
# Shares of the highest frequency about half of it, near it, and next to it; and all that are high
BANDS = ((0.4, 0.6), (0.9, 0.95), (0.98, 1.0), (0.4, 1.0))
# By how much smaller an inductance is tried, in natural logarithms
SMALLER = 3.0
# Current and speed among the outputs, and the latter alone
BOTH, SPEED = slice(None), slice(1, None)
# A mean over two samples has no more than this share of the power near the highest frequency next to it: in theory 1/40
NONE = 1 / 8


def seems_averaged(given: Prepared) -> bool:
    """Whether the speeds are counts of an encoder whose noise is that of means."""
    mean, _, counted = _mean_by_noise(given)
    return counted and mean is not None


def clearly_averaged(given: Prepared) -> Prepared:
    """The runs with their speeds taken for means over the last sample where the noise leaves no doubt that they are."""
    mean, enough, _ = _mean_by_noise(given)
    sure = mean is not None and np.isneginf(enough)
    return _averaged(without_ends(given, SPEED), mean) if sure else given


def with_averaging(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs with their speeds taken for means where that is what was recorded, and the fit to them.

    A speed that comes later than a mean would is late for another reason.

    **Arguments**: `fit`, that to the runs as they are. **Returns**: both as they are if no mean was found.
    """
    if given.averaging:
        return given, fit
    mean, enough, counted = _mean_by_noise(given)
    if mean is None:
        return given, fit
    inner = without_ends(given, SPEED)
    averaged, better = _fitted(_averaged(inner, mean), fit)
    left = negative_log_likelihood(averaged, better)
    if not negative_log_likelihood(inner, fit) - left > enough:
        return given, fit
    if not counted:
        # a mean over two samples is in time as it is, and has another noise than what is but late
        last = negative_log_likelihood(*_fitted(_averaged(inner, OVER_LAST), fit))
        if last < left or _fitted(_sooner(inner), fit)[1].fitness < fit.fitness:
            return given, fit
    return averaged, better


def as_sampled(given: Prepared) -> Prepared:
    """The runs with the speeds that were recorded as such taken for those of the moment."""
    return _averaged(given, None) if given.averaging else given


def without_ends(given: Prepared, outputs: slice = BOTH) -> Prepared:
    """The runs less what was measured of some outputs at their first and last samples, where a mean or a voltage that
    acts at another time may be of what nobody recorded."""
    tape = given.problem.tape
    weight = np.array(tape.weight)
    for k, run in enumerate(given.runs):
        first = int(np.argmax(tape.blocks_of(k)))
        for sample in (0, len(run) - 1):
            block, at = divmod(sample, weight.shape[2])
            weight[first + block, outputs, at] = 0.0
    return given.with_tape(weight=jnp.asarray(weight))


def _averaged(given: Prepared, averaging: Averaging | None) -> Prepared:
    """The runs with their speeds taken for such means, or for those of the moment."""
    runs = [
        attrs.evolve(run, averaging=averaging) if run.speed is not None and not ours else run
        for run, ours in zip(given.runs, given.differentiated, strict=True)
    ]
    laid = jax.tree.map(jnp.asarray, Tape.from_recordings(runs, follow=True))
    averaged = given.with_tape(averaging=laid.averaging, turn=laid.turn)
    return averaged._replace(runs=runs, averaging=averaging)


def _sooner(given: Prepared) -> Prepared:
    """The runs with their speeds a sample sooner."""
    runs = [
        run if run.speed is None else attrs.evolve(run, speed=np.append(run.speed[1:], np.nan))
        for run in given.runs
    ]
    laid = Tape.from_recordings(runs)
    weight = jnp.asarray(given.problem.tape.weight * laid.weight)
    return given.with_tape(measured=jnp.asarray(laid.measured), weight=weight)


def _fitted(given: Prepared, fit: Fit) -> tuple[Prepared, Fit]:
    """The runs, and the fit to them from another one on, or with a small inductance: a large one may have made up for
    half a sample."""
    parameters, unknowns = given.problem.parameters, fit.unknowns
    starts = [fit.optimum]
    if "L" in parameters.names and given.averaging == OVER_LAST:
        L = parameters.names.index("L")
        less = jnp.maximum(unknowns.coordinates[L] - SMALLER, parameters.lower[L])
        coordinates = unknowns.coordinates.at[L].set(less)
        starts.append(fit.optimum._replace(unknowns=unknowns._replace(coordinates=coordinates)))
    ends = [polish(given.problem, start) for start in starts]
    return given, min(ends, key=lambda end: end.fitness)


def _mean_by_noise(given: Prepared) -> tuple[Averaging | None, float, bool]:
    """Of what the speeds are the mean by their noise, if of anything; how much likelier that must make them, as
    `counted_over` has it; and whether they are counts.

    A mean over the last sample is told from a delay only if the speed is counted, and from an inductance only beside
    a current.
    """
    speeds = _speeds(given)
    counts = _in_counts(speeds)
    mean, enough = counted_over(counts) if counts else differenced_over([s for s, _ in speeds])
    if mean == OVER_LAST and not given.problem.samples[0] > 0:
        mean = None
    return mean, enough, bool(counts)


def counted_over(counts: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """Of what speeds are the mean that are multiples of a count a sample, if of anything; and how much likelier that
    must make them, by the logarithm; if less than nothing, no less likely by more.

    Angles that are rounded to counts have a white noise of 1/12 count squared. Of differences over one sample it is
    four times as strong at the highest frequency, and twice at half of that; of differences over two samples, counted
    by halves, it is none at all, and four times. While a rotor turns steadily the noise is no noise but a beat, which
    may be anywhere: then it is as strong in all, and the fit must tell.
    """
    middle, high, highest, in_all = _powers(counts)
    if highest > COUNTED:
        clearly = highest > np.sqrt(2.0) * max(middle, COUNTED)
        return OVER_LAST, -np.inf if clearly else -LIKELIER
    if in_all > COUNTED_IN_ALL and not highest < NONE * high:
        return OVER_LAST, LIKELIER
    return OVER_BOTH if highest < NONE * high else None, -LIKELIER


def differenced_over(speeds: Sequence[np.ndarray]) -> tuple[Averaging | None, float]:
    """The same of other speeds: nothing of differences over two samples is at the highest frequency, but of any other
    signal with noise or steps there is as much as near it."""
    _, high, highest, _ = _powers(speeds) if speeds else (0.0, 0.0, 0.0, 0.0)
    return OVER_BOTH if highest < NONE * high else None, LIKELIER


def _powers(signals: Sequence[np.ndarray]) -> Float[np.ndarray, "bands"]:
    """The power of some signals within each of the `BANDS`, if it were the same at all frequencies.

    By second differences: what is slow is so much stronger that it would leak.
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


def _speeds(given: Prepared) -> list[tuple[np.ndarray, float]]:
    """The speeds of all runs that are long enough to show their noise, rad/s, and the time between samples, s."""
    recorded = [
        (run.speed, np.diff(run.time))
        for run, ours in zip(given.training, given.differentiated, strict=False)
        if run.speed is not None and not ours
    ]
    known = [(speed[~np.isnan(speed)], float(np.median(steps))) for speed, steps in recorded]
    return [(speed, step) for speed, step in known if len(speed) >= ENOUGH]


def _in_counts(speeds: Sequence[tuple[np.ndarray, float]]) -> list[np.ndarray]:
    """The speeds in counts a sample, of an encoder with as many lines; none, if they are no such counts."""
    counts = []
    for speed, sample_time in speeds:
        # from sample to sample a speed may leap by many counts, its values lie closer
        step = quantum(np.diff(speed)) or quantum(np.diff(np.unique(speed)))
        lines = 2 * np.pi / step / sample_time if step else np.inf
        if lines > LINES:
            return []
        in_counts = speed / step
        # by as much of it as a count may be wrong, where speeds were written with few digits
        rounded = np.quantile(np.abs(in_counts - np.round(in_counts)), 0.95)
        whole = WHOLE + lines * rounded / np.max(np.abs(in_counts))
        if abs(lines - round(lines)) > whole:
            return []
        counts.append(in_counts)
    return counts
