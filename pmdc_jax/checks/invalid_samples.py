"""Samples that are no measurements: single-sample spikes, for example from a lost telegram, values clipped at the end
of the measuring range, and values that a sensor repeated when it had failed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import attrs
import numpy as np
from jaxtyping import Bool, Float, Int

from ..recordings.noise import noise_by_differences
from ..recordings.recording import MAX_MISSING, Finding, Recording, place_of_sample
from ..recordings.resolution import quantum

RANGE = "If the values are real, sample faster and with a larger measuring range"
# Least height of a spike over the median absolute second difference of the signal
SPIKE_RATIO = 50.0
# Least height of a spike over the range of the signal (from its 2 % to its 98 % quantile)
MIN_SPIKE = 0.2
# Largest difference between the two neighbours of a spike, over its height
MAX_STEP_ASIDE = 0.2
# Largest step of the driving signal next to a spike, over the range of that signal
MAX_STEP_OF_DRIVE = 0.2
# If more than this share of all samples look like spikes, they are taken for the signal
MAX_SPIKES = 0.01
# Probability at which a run of equal values is still taken for chance
CHANCE_OF_STAY = 1e-9
# The same for the repeated values of stays at an extreme that begin and end with a leap of so many times the noise
CHANCE_OF_REPEATS, MIN_LEAP = 1e-6, 5.0
# Fewer equal values than this are no stay
MIN_STAY = 5.0
# Largest probability assumed for a value to repeat the one before, with a resolution far coarser than the noise
MAX_CHANCE_TO_REPEAT = 0.9
# Part of the range that is next to an extreme, and the least number of values there
NEAR, MIN_NEAR = 0.1, 30
# Bits of magnitude of the coarsest converter, and by how much its last code may differ from a whole number
MIN_BITS, LAST_CODE_TOLERANCE = 9, 0.1
# Least number of equal values from a failed sensor, and the least jump after them, over the noise
MIN_FROZEN, MIN_JUMP = 20, 10.0
# Least jump before and after equal values of zero, where a sensor may truly rest, over the range of the signal
MIN_JUMP_AT_ZERO = 0.05
# Largest share of neighbouring values that are equal elsewhere: a counted speed often stays at one value
MAX_REPEATS = 0.02


def without_unmeasured(runs: Sequence[Recording]) -> list[Recording]:
    """The runs with the spikes, the clipped and the frozen samples of their outputs set to NaN, and a note on each; an
    extreme at which one run was clipped is the end of the measuring range in all."""
    runs = [_without_spikes(run) for run in runs]
    clipped_at: dict[str, list[float]] = {"speed": [], "current": []}
    for run in runs:
        for name, signal in _recorded_outputs(run).items():
            clipped_at[name] += [abs(extreme) for extreme, *_ in clipped_extremes(signal)]
    return [_without_frozen(_without_clipped(run, clipped_at)) for run in runs]


def _without_spikes(run: Recording) -> Recording:
    for name, signal in _recorded_outputs(run).items():
        spikes = _spikes(signal) & _drive_is_steady(run)
        if 0 < spikes.sum() <= MAX_SPIKES * len(run):
            run = _with_missing_samples(run, name, spikes, "has a single-sample spike", RANGE)
    return run


def _without_clipped(run: Recording, clipped_at: Mapping[str, Sequence[float]]) -> Recording:
    """**Arguments**: `clipped_at`, the magnitudes at which each output was clipped in any run."""
    for name, signal in _recorded_outputs(run).items():
        extremes = np.array([np.nanmin(signal), np.nanmax(signal)])
        at_end = np.isclose(np.abs(extremes)[:, None], clipped_at[name], rtol=1e-6).any(1)
        clipped = np.isin(signal, extremes[at_end])
        if clipped.any() and np.mean(clipped | np.isnan(signal)) <= MAX_MISSING:
            run = _with_missing_samples(run, name, clipped, "looks clipped", RANGE)
    return run


def _without_frozen(run: Recording) -> Recording:
    for name, signal in _recorded_outputs(run).items():
        frozen = _frozen(signal)
        if frozen.any():
            mend = "Check the sensor and its cable"
            run = _with_missing_samples(run, name, frozen, "stays", mend)
    return run


def _recorded_outputs(run: Recording) -> dict[str, Float[np.ndarray, " samples"]]:
    """The outputs of a run that were recorded, by name."""
    names = ("speed", "current") if run.drive == "voltage" else ("speed",)
    return {name: signal for name in names if (signal := getattr(run, name)) is not None}


def _with_missing_samples(
    run: Recording, name: str, lost: Bool[np.ndarray, " samples"], how: str, mend: str
) -> Recording:
    """The run with the `lost` samples of an output set to NaN, and a note: `how` they were recognised, and a remedy."""
    signal, rows = getattr(run, name), np.flatnonzero(lost)
    others = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
    note = Finding(
        run.name,
        name,
        "note",
        f"it {how} at {signal[rows[0]]:.6g}: treated as missing",
        f"{place_of_sample(run, rows[0])}{others}",
        mend,
    )
    missing = np.where(lost, np.nan, signal)
    return attrs.evolve(run, notes=(*run.notes, note), **{name: missing})


def _spikes(signal: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    before, after = np.diff(signal)[:-1], -np.diff(signal)[1:]
    size = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    aside = np.abs(signal[2:] - signal[:-2])
    low, high = np.nanquantile(signal, [0.02, 0.98])
    bends = np.abs(np.diff(signal, 2))
    if np.isnan(bends).all():  # no three samples in a row
        return np.zeros(len(signal), bool)
    least = max(SPIKE_RATIO * np.nanmedian(bends), MIN_SPIKE * (high - low))
    return np.pad((size > least) & (aside < MAX_STEP_ASIDE * size), 1)


def _drive_is_steady(run: Recording) -> Bool[np.ndarray, " samples"]:
    """Samples around which the driving signal does not step, so that it cannot have caused a spike."""
    drive = np.asarray(getattr(run, run.drive))
    steps = np.abs(np.diff(drive, prepend=drive[0])) > MAX_STEP_OF_DRIVE * np.ptp(drive)
    return ~(steps | np.roll(steps, 1) | np.roll(steps, -1))


def clipped_extremes(values: Float[np.ndarray, " samples"]) -> Iterator[tuple[float, int, int]]:
    """Extremes at which a noisy signal stays longer than by chance, with start and length of the longest stay; or to
    which it leaps too often, to stay for only a few samples each; or that are the last code of its converter."""
    if not _is_noisy(values):
        return
    ends = np.array([np.nanmax(values), np.nanmin(values)])
    of_converter = _are_last_codes(ends, quantum(np.diff(values)))
    noise = noise_by_differences(3, values)
    repeats = np.array([_repeats_between_leaps(values, extreme, noise) for extreme in ends])
    if np.isclose(*np.abs(ends), rtol=1e-6):  # the two ends of one measuring range
        repeats[:] = repeats.sum()
    chances = np.array([_chance_to_repeat(np.append(_values_near(values, end), end), noise) for end in ends])
    leaps = chances**repeats < CHANCE_OF_REPEATS
    for extreme, leaps_there, is_last_code in zip(ends, leaps, of_converter, strict=True):
        start, length, expected = _longest_stay_at(values, extreme)
        if is_last_code or length > expected or (leaps_there and length > 1):
            yield float(extreme), start, length


def _are_last_codes(ends: Float[np.ndarray, "2"], step: float) -> Bool[np.ndarray, "2"]:
    """Whether extremes are the last codes of a converter with this step, such as 2047 and -2048 of one with 12 bits:
    what is beyond them has the same codes."""
    if not step:
        return np.zeros(2, bool)
    codes = ends / step
    counts = np.round(codes) + (ends > 0)
    powers = np.log2(np.maximum(np.abs(counts), 1.0))
    whole = np.abs(codes - np.round(codes)) < LAST_CODE_TOLERANCE
    return whole & (powers >= MIN_BITS) & (powers == np.round(powers))


def _repeats_between_leaps(values: Float[np.ndarray, " samples"], extreme: float, noise: float) -> int:
    """How many values repeat the one before in stays at an extreme that begin and end with a leap."""
    starts, ends = _stays(values)
    inside = (values[starts] == extreme) & (starts > 0) & (ends < len(values) - 1)
    starts, ends = starts[inside], ends[inside]
    leaps = np.minimum(*(np.abs(values[i] - extreme) for i in (starts - 1, ends + 1)))
    return int(np.sum((ends - starts)[leaps > MIN_LEAP * noise]))


def _values_near(values: Float[np.ndarray, " samples"], extreme: float) -> Float[np.ndarray, " near"]:
    """The values in the part of the range next to an extreme, without the ends of the range; all those without if they
    are few. The resolution of a speed from the time between two edges of an encoder depends on the speed."""
    inner = _inside_range(values)
    near = inner[np.abs(inner - extreme) < NEAR * np.ptp(values[np.isfinite(values)])]
    return near if len(near) >= MIN_NEAR else inner


def _inside_range(values: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " inner"]:
    """The values that are finite and not at an end of their range."""
    values = values[np.isfinite(values)]
    return values[(values > values.min()) & (values < values.max())]


def _chance_to_repeat(values: Float[np.ndarray, " samples"], noise: float) -> float:
    """Probability that a value repeats the one before where the signal is steady: Gaussian noise in steps of the
    sensor's resolution."""
    resolution = np.min(np.diff(np.unique(values)))
    steady = resolution / max(2 * np.sqrt(np.pi) * noise, resolution)
    return min(steady, MAX_CHANCE_TO_REPEAT)


def _is_noisy(values: np.ndarray) -> bool:
    """Whether the channel carries noise, unlike a simulation, whether in full precision or rounded to a few digits."""
    inner = _inside_range(values)
    if len(inner) < 100 or noise_by_differences(3, inner) < 1e-5 * np.ptp(values[np.isfinite(values)]):
        return False
    third = np.diff(inner, 3)
    return bool(np.mean(third[1:] * third[:-1] < 0) > 0.5)  # 0.77 for white noise, 0 for motion


def _longest_stay_at(values: np.ndarray, extreme: float) -> tuple[int, int, float]:
    """Start and length of the longest stay at the extreme value, and the length that chance may explain."""
    if extreme == 0:  # a motor at rest, or a sensor of one direction only
        return 0, 0, np.inf
    padded = np.concatenate(([False], values == extreme, [False])).astype(np.int8)
    starts, ends = (np.flatnonzero(np.diff(padded) == sign) for sign in (1, -1))
    later = starts > 0  # a filter or a delay may hold the first value
    if not later.any():
        return 0, 0, np.inf
    starts, ends = starts[later], ends[later]
    longest = int(np.argmax(ends - starts))
    inner = _inside_range(values)
    repeats = max((np.count_nonzero(np.diff(x) == 0) + 1) / len(x) for x in (inner, _values_near(values, extreme)))
    expected = 1 + np.log(CHANCE_OF_STAY / len(values)) / np.log(min(repeats, 0.999))
    # a speed in encoder counts stays at one value whenever the motor turns steadily
    elsewhere = 2.0 * _second_longest_stay(inner[inner != 0])
    return int(starts[longest]), int(ends[longest] - starts[longest]), max(float(expected), elsewhere, MIN_STAY)


def _frozen(values: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Where a noisy signal that otherwise hardly repeats a value stays at one for long, and then leaps back to what it
    should be. The first of these values may be measured."""
    frozen = np.zeros(len(values), bool)
    if not _is_noisy(values):
        return frozen
    starts, ends = _stays(values)
    long = ends - starts >= MIN_FROZEN
    others = values[~np.repeat(long, ends - starts + 1) & np.isfinite(values)]
    if not long.any() or np.mean(np.diff(others) == 0) > MAX_REPEATS:
        return frozen
    noise = noise_by_differences(3, others)
    for start, end in zip(starts[long], ends[long], strict=True):
        if start == 0 or end + 1 == len(values):
            continue
        before, after = np.abs(values[[start - 1, end + 1]] - values[start])
        leaps = after > MIN_JUMP * noise
        if values[start] == 0:
            leaps = min(before, after) > MIN_JUMP_AT_ZERO * np.ptp(others)
        frozen[start + 1 : end + 1] = leaps
    return frozen


def _second_longest_stay(values: Float[np.ndarray, " samples"]) -> int:
    """Length of the second longest stay of a signal at one value."""
    starts, ends = _stays(values)
    lengths = np.sort(ends - starts + 1)
    return int(lengths[-2]) if len(lengths) > 1 else 0


def _stays(values: Float[np.ndarray, " samples"]) -> tuple[Int[np.ndarray, " stays"], Int[np.ndarray, " stays"]]:
    """First and last sample of each stay of a signal at one value; one after the other they make up the signal."""
    ends = np.flatnonzero(np.diff(values, append=np.nan) != 0)
    return np.append(0, ends[:-1] + 1), ends
