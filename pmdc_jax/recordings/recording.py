"""One run of one motor in SI: time, voltage, current, speed and load, and the faults that make a run unusable."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np
from attrs import field, frozen
from attrs.converters import optional
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ..errors import InputError
from .columns import QUANTITIES
from .readings import reading_interval

Samples = Float[np.ndarray, " samples"]

MIN_SAMPLES = 10
MAX_MISSING = 0.2  # share of an output's samples, or of the readings of a slower sensor, that may be missing
# Most sample intervals that a run may last, per sample: an even clock ticks through the gaps, too, and its ticks must
# fit into memory
MAX_INTERVALS_PER_SAMPLE = 20
RECORDED_OUTPUTS = ("speed", "angle", "current")
# The simulated outputs, in the order of their axis in a tape
SIMULATED_OUTPUTS = ("current", "speed")
# Columns needed besides time: to simulate, and to identify
NEEDED_TO_SIMULATE = "voltage, current or torque"
NEEDED_TO_IDENTIFY = "voltage with current, speed or angle; or current or torque with speed or angle"


@frozen
class Finding:
    """Something about the data that a user should know before a fit.

    **Fields**: `run`; `column`, None for the run as a whole; `severity`: an "error" makes a fit meaningless, a
    "warning" may spoil it; `what` is wrong; `where`, the place in the data; `mend`, the remedy; `modelled_by`, the
    effects of a motor that make it harmless.
    """

    run: str
    column: str | None
    severity: Literal["error", "warning", "note"]
    what: str
    where: str
    mend: str
    modelled_by: tuple[str, ...] = ()


class Averaging(NamedTuple):
    """A recorded signal that is a mean over the neighbouring sample intervals, as a difference of angles is.

    **Fields**: `last` and `next`, the weights of the means over the previous and over the following interval; the rest
    of the weight is that of the instantaneous signal. `later`, by which share of a sample all this is later than the
    instant of the sample. Of a sensor slower than the log the interval is that from one reading to the next.
    """

    last: float
    next: float
    later: float = 0.0

    def with_ends_missing(self, signal: np.ndarray) -> np.ndarray:
        """`signal`, NaN at the ends whose averaging interval lies outside the record."""
        known, interval = signal.copy(), reading_interval(~np.isnan(signal))
        known[: interval if self.last else 0] = np.nan
        known[len(known) - (interval if self.next or self.later else 0) :] = np.nan
        return known

    def applied_to(self, signal: np.ndarray, interval: int = 1) -> np.ndarray:
        """What is recorded of a signal, (samples, ...), that is linear between samples, at an interval of so many of
        them from one reading to the next."""
        change = np.diff(signal, axis=0, append=signal[-1:])
        then = signal + self.later * change
        until_then = self.later * (signal + then) / 2  # the integrals over the parts of each interval
        from_then = signal + change / 2 - until_then
        last = until_then + np.concatenate([(1 - self.later) * signal[:1], from_then[:-1]])
        if interval > 1:
            last = _means_over_last(last, interval)
        coming = np.concatenate([last[interval:], np.repeat(signal[-1:], interval, axis=0)])
        return (1 - self.last - self.next) * then + self.last * last + self.next * coming


OVER_LAST, OVER_BOTH = Averaging(1.0, 0.0), Averaging(0.5, 0.5)
# from half a sample before each instant to half a sample after it
AROUND = Averaging(1.0, 0.0, 0.5)


def _samples(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, dtype=float)


@frozen(eq=False)
class Recording:
    """One run of one motor, in SI; on a linear axis, m instead of rad and N instead of N m.

    The voltage at sample k is held until sample k + 1. `load` opposes positive motion; None means unknown, not zero.
    `torque` is the known torque of the motor. Missing samples of an output are NaN.

    **Fields**: `name`, shown in results; `time`, s, (samples,), strictly increasing from any start. The following have
    the same shape, and are None where not recorded: `voltage` V, `current` A, `speed` rad/s, `load` N m, `angle` rad,
    `temperature` degrees C, `torque` N m. `held`, whether the rotor was locked; `source`, the file; `ignored`, headers
    not used; `notes`, assumptions made while reading; `resampled_from`, the original record if this one was resampled
    to an even clock, else None; `averaging`, the averaging of the speed, None for an instantaneous speed;
    `current_averaged`, whether the current is a mean over the last sample interval.

    **Raises**: `InputError` if no recorded quantity drives the motor, or the arrays are faulty (see `faults`).
    """

    name: str
    time: Samples = field(converter=_samples)
    voltage: Samples | None = field(default=None, converter=optional(_samples))
    current: Samples | None = field(default=None, converter=optional(_samples))
    speed: Samples | None = field(default=None, converter=optional(_samples))
    load: Samples | None = field(default=None, converter=optional(_samples))
    angle: Samples | None = field(default=None, converter=optional(_samples))
    temperature: Samples | None = field(default=None, converter=optional(_samples))
    torque: Samples | None = field(default=None, converter=optional(_samples))
    held: bool = field(default=False, kw_only=True)
    source: str | None = field(default=None, kw_only=True)
    ignored: tuple[str, ...] = field(default=(), kw_only=True)
    notes: tuple[Finding, ...] = field(default=(), kw_only=True)
    resampled_from: Recording | None = field(default=None, kw_only=True)
    averaging: Averaging | None = field(default=None, kw_only=True)
    current_averaged: bool = field(default=False, kw_only=True)

    def __attrs_post_init__(self) -> None:
        # the original of a resampled record has already been checked
        for fault in faults(self.columns()) if self.resampled_from is None else ():
            sample = "" if fault.row is None else f"sample {fault.row + 1}"
            column = fault.quantity and f"column {fault.quantity}"
            where = ", ".join(filter(None, (self.source or self.name, sample, column)))
            raise InputError(where, fault.what, fault.mend)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def sample_time(self) -> float:
        """Median sample interval, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.time[-1] - self.time[0])

    @property
    def has_even_clock(self) -> bool:
        """Whether its samples are those of its record, not resampled from an uneven clock."""
        return self.resampled_from is None

    @property
    def recorded(self) -> Recording:
        """The original record, before any resampling to an even clock."""
        return self if self.resampled_from is None else self.resampled_from

    @property
    def drive(self) -> Literal["voltage", "current", "torque"]:
        """The input of a simulation: the first of voltage, torque and current that was recorded."""
        if self.voltage is not None:
            return "voltage"
        return "current" if self.torque is None else "torque"

    @property
    def is_identifiable(self) -> bool:
        """Whether the recorded quantities suffice to identify a motor; see `is_identifiable_from`."""
        return is_identifiable_from(self.columns())

    @property
    def stands_still(self) -> bool:
        """Whether the rotor is locked or does not move at all while current flows; needs voltage and current."""
        if self.voltage is None or self.current is None or not np.any(np.nan_to_num(self.current)):
            return False
        motion = np.diff(self.angle) if self.speed is None and self.angle is not None else self.speed
        return self.held or (motion is not None and not np.any(np.nan_to_num(motion)))

    def columns(self) -> dict[str, np.ndarray]:
        """The recorded arrays, by quantity."""
        values = ((quantity, getattr(self, quantity)) for quantity in QUANTITIES)
        return {quantity: array for quantity, array in values if array is not None}


def place_of_sample(run: Recording, row: int | np.integer) -> str:
    """The place of a sample for messages, which count samples from 1; `row` counts from 0."""
    return f"sample {row + 1} ({run.time[row]:.6g} s)"


class Fault(NamedTuple):
    """Why a recording cannot be used; `row` counts from 0 and is None for the whole column."""

    quantity: str | None
    row: int | None
    what: str
    mend: str


def faults(columns: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Every fault that makes these columns unusable, the most basic first."""
    if not is_driven(columns):
        what = f"no input column, only {', '.join(columns)}"
        yield Fault(None, None, what, f"Needed besides time: {NEEDED_TO_SIMULATE}")
    time = columns["time"]
    for quantity, values in columns.items():
        if values.ndim != 1 or len(values) != len(time):
            what = f"shape {values.shape}, but time has shape {time.shape}"
            yield Fault(quantity, None, what, "Give every column one value per sample")
            return
    if len(time) < MIN_SAMPLES:
        what = f"{len(time)} samples, at least {MIN_SAMPLES} are needed"
        yield Fault(None, None, what if len(time) else "it has no rows", "Record a longer run")
        return
    for quantity, values in columns.items():
        yield from _faults_of_values(quantity, values, columns)
    yield from _faults_of_time(time)


def is_driven(columns: Mapping[str, object]) -> bool:
    return any(drive in columns for drive in ("voltage", "current", "torque"))


def is_identifiable_from(columns: Mapping[str, object]) -> bool:
    moves = "speed" in columns or "angle" in columns
    if "voltage" in columns:
        return moves or "current" in columns
    return moves and ("current" in columns or "torque" in columns)


def _faults_of_values(quantity: str, values: np.ndarray, columns: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    bad = ~np.isfinite(values)
    if not bad.any():
        return
    first, count = int(np.argmax(bad)), int(bad.sum())
    infinite = np.isinf(values)
    if infinite.any():
        first = int(np.argmax(infinite))
        what = f"{infinite.sum()} infinite values, the first here"
        yield Fault(quantity, first, what, "Leave cells without a measurement empty")
    # the current is an input if neither voltage nor torque was recorded
    output = quantity in RECORDED_OUTPUTS and (quantity != "current" or "voltage" in columns or "torque" in columns)
    if not output and quantity != "temperature":
        what = f"{count} of {len(values)} values are missing (empty or NaN), the first here"
        yield Fault(quantity, first, what, "Inputs must be complete: fill the gaps, or cut the run")
    elif output and (len(values) - count) * reading_interval(~bad) < (1 - MAX_MISSING) * len(values):
        what = f"{count} of {len(values)} values are missing (empty or NaN), the first here"
        mend = f"Up to {MAX_MISSING:.0%} of those that come regularly may be missing: cut the run, or remove the column"
        yield Fault(quantity, first, what, mend)


def _faults_of_time(time: np.ndarray) -> Iterator[Fault]:
    steps = np.diff(time)
    if (steps > 0).all():
        yield from _long_gaps(steps)
        return
    row = int(np.argmax(~(steps > 0))) + 1
    before, now = (f"{value:.9g}" for value in time[row - 1 : row + 1])
    if steps[row - 1] < 0:
        what = f"time goes backwards, from {before} s to {now} s"
        mend = "A file holds one run: split it, or sort the lines"
    else:
        others = int(np.sum(steps == 0)) - 1
        what = f"the time stamp {now} s is repeated" + (f", as are {others} more" if others else "")
        mend = "Export time with more digits, or delete repeated lines"
    yield Fault("time", row, what, mend)


def _long_gaps(steps: np.ndarray) -> Iterator[Fault]:
    typical, longest = np.median(steps), int(np.argmax(steps))
    limit = MAX_INTERVALS_PER_SAMPLE * (len(steps) + 1)
    if np.sum(steps) > limit * typical:
        what = (
            f"a gap of {steps[longest]:.4g} s in time before it, where most steps are {typical:.4g} s: on an even"
            f" clock the run would have more than {limit} samples"
        )
        mend = "Correct the time stamp, or split the run at its gaps"
        yield Fault("time", longest + 1, what, mend)


def _means_over_last(signal: np.ndarray, count: int) -> np.ndarray:
    """The mean of each sample and those before it, `count` in all; before the first one they are like that."""
    total = np.cumsum(np.concatenate([np.repeat(signal[:1], count, axis=0), signal]), axis=0)
    return (total[count:] - total[:-count]) / count


def jumps_of(signal: Float[np.ndarray, " samples"], ratio: float, share: float) -> Int[np.ndarray, " jumps"]:
    """The samples at which a signal jumps: from the one before it changes by more than `ratio` times what it does in
    the samples beside, and by more than this `share` of its range."""
    size = np.abs(np.diff(signal))
    padded = np.pad(size, 1)
    beside = np.maximum(padded[:-2], padded[2:])
    return np.flatnonzero(size > np.maximum(ratio * beside, share * np.ptp(signal))) + 1
