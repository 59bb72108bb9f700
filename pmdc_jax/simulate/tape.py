"""Several runs laid end to end in blocks of samples: one array shape, one solve, whatever the runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.base import LONGEST_STEP
from ..motor import Drive
from ..recordings.readings import reading_interval
from ..recordings.recording import OVER_LAST
from .between_samples import mean_and_rise, value_on_line
from .timing import ZERO_ORDER_HOLD, Timing

if TYPE_CHECKING:
    from ..recordings.recording import Recording

# on the host as laid out, or on the device
Samples = Array | np.ndarray

# Samples in a block. A population is simulated block after block, one motor in all blocks in parallel: long enough that
# the influence of a block's start has mostly decayed at its end, short enough that padding the last one costs little.
BLOCK = 128
# Samples without a reading of the speed are a gap if there are more than so many intervals between two readings
MAX_GAP = 1.5


class Tape(eqx.Module):
    """Runs laid end to end; a run begins with a new block, and its last block is padded with samples of weight 0.

    Empty runs and blocks follow, so that recordings that differ in number or length have the same array shapes and
    share compiled programs.

    A sample time, a drive (voltage, current or torque) and a rotor that is free or held make a *grid*; blocks of
    one grid share the exact step. The drive and the load of sample k hold until sample k + 1; a drive with a `rise`
    varies linearly until then.
    """

    value: Float[Samples, "blocks samples"]  # mean of the drive over each sample: V, A or N m
    load: Float[Samples, "blocks samples"]  # N m, zero where unknown
    measured: Float[Samples, "blocks 2 samples"]  # current A, speed rad/s; where missing, the last known
    weight: Float[Samples, "blocks 2 samples"]  # 1 where measured, else 0
    run: Int[Samples, " blocks"]
    begins: Bool[Samples, " blocks"]
    grid: Int[Samples, " blocks"]
    sample_time: Float[Samples, " grids"]  # s
    drive: Drive  # each Float[Samples, " grids"]
    initial: Float[Samples, "runs 2"]  # first guess of current A and speed rad/s
    load_unknown: Bool[Samples, " runs"]
    angle: Float[Samples, " runs"]  # rad at the start, zero where unknown
    angle_known: Bool[Samples, " runs"]
    # angle in rad over each sample by the measured speed, where the simulated rotor is to follow it; else NaN
    turn: Float[Samples, "blocks samples"]
    # bound of the sample times in s: 1 ms where none is longer, else infinite. It decides whether programs are compiled
    # that divide samples into steps
    longest: float = eqx.field(static=True)
    # change of the drive over each sample; None if all drives are held
    rise: Float[Samples, "blocks samples"] | None = None
    # shares in the reported speed of its means over the last sample and over the next, and in the reported current of
    # its mean over the last sample, which is not combined with a `reading`; None if nothing is a mean
    averaging: Float[Samples, "runs 3"] | None = None
    # samples from one reading of the speed to the next, over which its means extend; None if it is read at each sample
    span: Int[Samples, " runs"] | None = None
    # by which share of a sample the speeds that are means are later than their samples; None if none is
    later: Float[Samples, " grids"] | None = None
    # share of each sample, between 0 and 1, after which its outputs are read; None if they are read at its start
    reading: Float[Samples, ""] | None = None

    @classmethod
    def from_recordings(
        cls,
        recordings: Sequence[Recording],
        unloaded: bool = False,
        follow: bool = False,
        timing: Timing = ZERO_ORDER_HOLD,
    ) -> Tape:
        """Lay recordings end to end.

        **Arguments**: `recordings`, each with an even sample time (see `pmdc_jax.simulate.on_even_clock`);
        `unloaded` declares the load of runs without a load column to be zero instead of unknown; `follow` makes
        the rotor turn by the measured speed where there is one, so that torques that depend on its angle stay in phase
        with the real ones, which a free run would lose after a few turns; `timing`, how voltages and torques go on
        from one sample to the next, and when the outputs are read; its `lead` in whole samples is not applied.
        """
        runs = [_Run(recording, timing) for recording in recordings]
        rises = timing.first_order_hold or not all(recording.has_even_clock for recording in recordings)
        averaged = any(r.averaging is not None or r.current_averaged for r in recordings)
        grids = list(dict.fromkeys(run.grid for run in runs))
        sample_times, drives, free, later = (np.array(each) for each in zip(*grids, strict=True))
        empty_runs = _power_of_two(len(runs)) - len(runs)

        def padded(values: Iterable[float | Sequence[float]]) -> np.ndarray:
            known = np.array(list(values))
            return np.append(known, np.zeros((empty_runs, *known.shape[1:]), known.dtype), axis=0)

        voltage, current, torque = (np.where(drives == kind, 1.0, 0.0) for kind in Drive._fields[:3])
        slow = averaged and max(run.span for run in runs) > 1
        return cls(
            **_laid_in_blocks(runs, grids, empty_runs, rises, follow),
            sample_time=sample_times,
            drive=Drive(voltage, current, torque, free=np.where(free, 1.0, 0.0)),
            initial=padded(run.initial for run in runs),
            averaging=padded(map(_averaging_shares, recordings)) if averaged else None,
            span=np.maximum(padded(run.span for run in runs), 1) if slow else None,
            later=later if np.any(later) else None,
            load_unknown=padded(r.load is None and not unloaded and not r.held for r in recordings),
            angle=padded(_first(r.angle) for r in recordings),
            angle_known=padded(r.angle is not None for r in recordings),
            reading=None if timing.reading is None else np.asarray(timing.reading),
            longest=LONGEST_STEP if sample_times.max() <= (1 + 1e-6) * LONGEST_STEP else math.inf,
        )

    @property
    def runs(self) -> int:
        """Number of runs, including the empty ones."""
        return self.initial.shape[0]

    @property
    def block_sample_time(self) -> Float[Array | np.ndarray, " blocks"]:
        """The sample time of each block, s."""
        return jnp.asarray(self.sample_time)[self.grid]

    @property
    def block_drive(self) -> Drive:
        """The drive of each block."""
        return jax.tree.map(lambda share: jnp.asarray(share)[self.grid], self.drive)

    def of_runs(self, runs: Sequence[int]) -> Tape:
        """The tape of some runs, padded to one of few array shapes."""
        blocks = np.flatnonzero(np.isin(np.asarray(self.run), runs))
        return self._of_blocks(blocks, _round_up(len(blocks)))

    def parts(self, count: int) -> list[tuple[Tape, int]]:
        """The tape cut between runs into at most `count` parts of similar length, padded to one array shape; and the
        number of blocks of each, without the padding."""
        run, blocks = np.asarray(self.run), self.value.shape[0]
        begins = np.unique(run, return_index=True)[1]
        even = np.arange(1, count) * blocks / count
        cuts = begins[np.argmin(np.abs(begins[:, None] - even), axis=0)]
        ends = np.unique([0, *cuts, blocks])
        longest = _round_up(int(np.diff(ends).max()))
        return [(self._of_blocks(np.arange(first, end), longest), int(end - first)) for first, end in pairwise(ends)]

    def _of_blocks(self, blocks: Int[np.ndarray, " _"], size: int) -> Tape:
        """The tape of some blocks, padded to `size` by the last one, with weight 0."""
        padded = np.pad(blocks, (0, size - len(blocks)), mode="edge")
        is_padding = np.arange(size) >= len(blocks)
        names = ("value", "load", "measured", "weight", "run", "begins", "grid", "turn", "rise")
        signals = {name: getattr(self, name) for name in names}
        taken = replace(self, **{n: None if s is None else np.asarray(s)[padded] for n, s in signals.items()})
        return replace(
            taken, weight=np.where(is_padding[:, None, None], 0.0, taken.weight), begins=taken.begins | is_padding
        )

    def drive_at(self, share: float) -> Samples:
        """The drive after this share of each sample, V, A or N m."""
        return value_on_line(self.value, self.rise, share)

    def blocks_of(self, run: int) -> Bool[np.ndarray, " blocks"]:
        """Mask of the blocks of one run."""
        return np.asarray(self.run) == run

    def samples_of(
        self, run: int, signal: Float[Samples, "blocks *outputs samples"], length: int
    ) -> Float[np.ndarray, "length *outputs"]:
        """The `length` samples of one run, cut out of a signal laid out like the tape."""
        part = np.moveaxis(np.asarray(signal)[self.blocks_of(run)], -1, 1)
        return part.reshape(-1, *part.shape[2:])[:length]

    def set_samples_of(
        self,
        run: int,
        signal: Float[np.ndarray, "blocks *outputs samples"],
        values: Float[np.ndarray, "length *outputs"],
    ) -> None:
        """Set the samples of one run in a signal laid out like the tape."""
        blocks = self.blocks_of(run)
        part = np.moveaxis(signal[blocks], -1, 1)
        in_time = part.reshape(-1, *part.shape[2:])
        in_time[: len(values)] = values
        signal[blocks] = np.moveaxis(in_time.reshape(part.shape), 1, -1)

    def grid_of(self, run: int) -> int:
        """The grid of one run."""
        return int(np.asarray(self.grid)[self.blocks_of(run)][0])

    def span_of(self, run: int) -> int:
        """Samples from one reading of the speed of one run to the next, where that is a mean."""
        return 1 if self.span is None else int(self.span[run])

    def drive_of(self, run: int) -> Drive:
        """The drive of one run."""
        return Drive(*(float(np.asarray(share)[self.grid_of(run)]) for share in self.drive))

    def sample_time_of(self, run: int) -> float:
        """Sample time of one run, s."""
        return float(self.sample_time[self.grid_of(run)])


# Sample time in s, what drives the motor, whether the rotor is free, and `Averaging.later` of its speed
Grid = tuple[float, str, bool, float]


class _Run:
    """One recording as the tape needs it: drive, load, measurements and initial state."""

    def __init__(self, recording: Recording, timing: Timing) -> None:
        self.length = len(recording.time)
        self.blocks = -(-self.length // BLOCK)
        missing = np.full(self.length, np.nan)
        self.load = np.zeros(self.length) if recording.load is None else recording.load
        self.current, self.speed = missing, missing
        self.averaging = recording.averaging
        if recording.speed is not None:
            self.speed = recording.speed
        self.span = reading_interval(~np.isnan(self.speed))
        if self.averaging is not None:
            self.speed = self.averaging.with_ends_missing(self.speed)
        drive = recording.drive
        if drive == "voltage" and recording.current is not None:
            self.current = recording.current
            if recording.current_averaged:
                self.current = OVER_LAST.with_ends_missing(self.current)
        self.value, self.rise = mean_and_rise(recording, timing)
        # rounded: two runs of one clock must share a grid even if their time stamps differ in the last bits
        later = self.averaging.later if self.averaging else 0.0
        self.grid: Grid = (float(f"{recording.sample_time:.9g}"), drive, not recording.held, later)
        self.initial = (_first(self.current), _first(self.speed))

    def turn(self) -> np.ndarray:
        """Angle over each sample in rad, NaN where the speed is not known."""
        read = np.flatnonzero(~np.isnan(self.speed))
        if not len(read):
            return self.speed
        last, coming, later = self.averaging or (0.0, 0.0, 0.0)
        # the samples to which the readings belong: means to the middle of their interval
        at = read + self.span * (later + (coming - last) / 2)
        middle = np.arange(self.length) + 0.5
        # the end of the run has no reading after it, and is no gap
        around = np.concatenate([[at[0] - self.span], at, [at[-1] + self.span]])
        after = np.clip(np.searchsorted(around, middle), 1, len(around) - 1)
        gap = np.diff(around)[after - 1] > MAX_GAP * self.span
        gap |= (middle < around[0]) | (middle > around[-1])
        sample_time, *_ = self.grid
        return np.where(gap, np.nan, sample_time * np.interp(middle, at, self.speed[read]))

    def to_blocks(self, samples: np.ndarray, hold: bool = False) -> np.ndarray:
        padding = self.blocks * BLOCK - self.length
        return np.pad(samples, (0, padding), mode="edge" if hold else "constant").reshape(-1, BLOCK)


def _laid_in_blocks(
    runs: Sequence[_Run], grids: Sequence[Grid], empty_runs: int, rises: bool, follow: bool
) -> dict[str, Any]:
    """The fields of a tape that have a row for each block: the runs, `empty_runs` of one block, then padding."""
    blocks = _round_up(sum(run.blocks for run in runs) + empty_runs)
    value, load = np.zeros((2, blocks, BLOCK))
    measured, weight = np.zeros((2, blocks, 2, BLOCK))
    turn = np.full((blocks, BLOCK), np.nan)
    rise = np.zeros((blocks, BLOCK)) if rises else None
    of_run = np.full(blocks, len(runs) + empty_runs - 1)
    begins = np.zeros(blocks, bool)
    of_grid = np.full(blocks, grids.index(runs[-1].grid))
    first = 0
    for index, run in enumerate(runs):
        part = slice(first, first + run.blocks)
        value[part] = run.to_blocks(run.value, hold=True)
        load[part] = run.to_blocks(run.load, hold=True)
        for channel, samples in enumerate((run.current, run.speed)):
            missing = np.isnan(samples)
            measured[part, channel] = run.to_blocks(_last_known(samples))
            weight[part, channel] = run.to_blocks(np.where(missing, 0.0, 1.0))
        if rise is not None:
            rise[part] = run.to_blocks(run.rise)
        if follow:
            turn[part] = run.to_blocks(run.turn(), hold=True)
        of_run[part], of_grid[part] = index, grids.index(run.grid)
        begins[first] = True
        first += run.blocks
    of_run[first : first + empty_runs] = np.arange(len(runs), len(runs) + empty_runs)
    # every block of padding begins anew, so that joining the blocks never waits for it
    begins[first:], turn[first:] = True, 0.0
    return {
        "value": value,
        "load": load,
        "measured": measured,
        "weight": weight,
        "turn": turn,
        "rise": rise,
        "run": of_run,
        "begins": begins,
        "grid": of_grid,
    }


def _averaging_shares(recording: Recording) -> tuple[float, float, float]:
    last, coming, _ = recording.averaging or (0.0, 0.0, 0.0)
    return last, coming, float(recording.current_averaged)


def _first(samples: np.ndarray | None) -> float:
    known = samples[~np.isnan(samples)] if samples is not None else np.empty(0)
    return float(known[0]) if len(known) else 0.0


def _last_known(samples: np.ndarray) -> np.ndarray:
    """The samples, where they are missing those before; zero before the first one."""
    row = np.maximum.accumulate(np.where(np.isnan(samples), -1, np.arange(len(samples))))
    return np.where(row < 0, 0.0, samples[row])


def _round_up(blocks: int) -> int:
    """Up to a power of two from 8 to 32; then to a multiple of 32, or of 1/16 of the next power of two if larger."""
    power = max(8, _power_of_two(blocks))
    step = min(power, max(32, power // 16))
    return -(-blocks // step) * step


def _power_of_two(least: int) -> int:
    return 1 << (least - 1).bit_length()
