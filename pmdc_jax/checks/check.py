"""Checks of recordings before a fit: only clear faults are reported."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..recordings.angle import unwrapped
from ..recordings.clock import GAP, is_evenly_sampled
from ..recordings.noise import noise_by_differences
from ..recordings.readings import reading_interval
from ..recordings.recording import Finding, Recording, place_of_sample
from .alignment import shifted_channels, slow_sampling
from .invalid_samples import clipped_extremes
from .plausibility import angle_against_speed, implausible_units, lost_signs, reversed_signs, speed_of

MAX_JITTER = 0.02  # of a step, root mean square
MISSING_ROW = 1.5  # longer steps, in typical ones of an even clock, lack a row
MAX_MISSING_AS_NOTE = 0.05  # share of missing samples beyond which they are worth a warning
MAX_JUMP = 0.2  # from sample to sample, of the range of a current that drives


def check(recordings: Sequence[Recording]) -> tuple[Finding, ...]:
    """Look through recordings for what would spoil an identification.

    **Arguments**: `recordings`, all runs of one motor.

    **Returns**: findings, run by run, what was assumed on reading first. Only what makes a fit
    meaningless is an "error".
    """
    findings: list[Finding] = []
    for recording in recordings:
        findings += recording.notes
        for check_run in CHECKS_OF_A_RUN:
            findings += check_run(recording)
    findings += implausible_units(recordings)
    findings += excitation(recordings)
    return tuple(findings)


def gaps(run: Recording) -> Iterator[Finding]:
    """Steps of time much longer than the others, or of several samples where the clock is otherwise even."""
    steps, typical = np.diff(run.time), run.sample_time
    _, deviation = _clock(run)
    rows = np.flatnonzero(steps > (MISSING_ROW if deviation <= MAX_JITTER else GAP) * typical)
    if len(rows):
        longest = rows[np.argmax(steps[rows])]
        yield Finding(
            run.name,
            "time",
            "warning" if steps[longest] > GAP * typical else "note",
            f"{_count(len(rows), 'gap')} in time, the longest {steps[longest]:.4g} s "
            f"against a sample interval of {typical:.4g} s",
            place_of_sample(run, int(longest)),
            "The voltage is assumed constant during a gap. If it was not, split the run at its gaps",
        )


def jitter(run: Recording) -> Iterator[Finding]:
    """Time stamps that scatter about a uniform grid."""
    interval, deviation = _clock(run)
    if deviation > MAX_JITTER:
        samples = "the stamps are used as the sampling times"
        if is_evenly_sampled(run):
            samples = "the signals were sampled evenly, so an even time grid is used"
        worst = int(np.argmax(np.abs(np.diff(run.time) - interval)))
        yield Finding(
            run.name,
            "time",
            "note",
            f"time stamps jitter by {deviation:.1%} of the sample interval of {interval:.4g} s; {samples}",
            f"worst near {place_of_sample(run, worst)}",
            "If the stamps are not the sampling times, export the time of the sampling clock",
        )


def _clock(run: Recording) -> tuple[float, float]:
    """The sample interval, s, and the jitter, in intervals: the root mean square scatter of the time stamps."""
    steps = np.diff(run.time)
    steps = steps[steps <= GAP * run.sample_time]
    samples = np.ones(len(steps))
    if not is_evenly_sampled(run):  # else a step of two samples only has stamps rounded so
        samples = np.maximum(np.rint(steps / run.sample_time), 1.0)
    interval = np.sum(steps) / np.sum(samples)
    # scatter from step to step, not of the stamps, so that a slowly drifting clock is no jitter
    return float(interval), float(np.sqrt(np.mean((steps / interval - samples) ** 2) / 2))


def missing_samples(run: Recording) -> Iterator[Finding]:
    """Samples without a value, and sensors that are read more slowly than the log."""
    for quantity, values in run.columns().items():
        absent = np.isnan(values)
        every = reading_interval(~absent)
        if every > 1:
            what = f"its sensor is read only every {every} samples: what the log repeats in between is not used"
            yield Finding(run.name, quantity, "note", what, "", "")
        elif absent.any():
            yield Finding(
                run.name,
                quantity,
                "warning" if absent.mean() > MAX_MISSING_AS_NOTE else "note",
                f"{absent.sum()} of {len(values)} values are missing",
                f"first at {place_of_sample(run, int(np.argmax(absent)))}",
                "They are left out of the fit",
            )


def clipping(run: Recording) -> Iterator[Finding]:
    """A flat top: the extreme value many times in a row in a channel that is otherwise noisy.

    The voltage is left out: a controller may truly hold it at the limit of its supply.
    """
    for quantity in ("current", "speed"):
        values = getattr(run, quantity)
        for extreme, start, length in [] if values is None else clipped_extremes(values):
            yield Finding(
                run.name,
                quantity,
                "warning",
                f"it looks clipped at {extreme:.6g}: {length} equal values in a row",
                f"from {place_of_sample(run, start)}",
                "Record with a larger measuring range, or leave the cells of these samples empty",
            )


def wrapped_angle(run: Recording) -> Iterator[Finding]:
    """An angle that starts again after each turn."""
    if run.angle is None:
        return
    _, wraps = unwrapped(run.angle)
    if len(wraps):
        yield Finding(
            run.name,
            "angle",
            "note",
            f"the angle wraps after each turn, {_count(len(wraps), 'time')}: it is unwrapped",
            f"first at {place_of_sample(run, int(wraps[0]))}",
            "If these are not wraps, give an unwrapped angle, for example from numpy.unwrap",
        )


def constant_load(run: Recording) -> Iterator[Finding]:
    """A load column with one value that is not zero."""
    if run.load is not None and run.load[0] != 0 and (run.load == run.load[0]).all():
        yield Finding(
            run.name,
            "load",
            "note",
            f"the load column is constant: used as a known load of {run.load[0]:.6g} N m",
            "whole run",
            "If the load was not measured, remove the column",
        )


def unused_torque(run: Recording) -> Iterator[Finding]:
    """A torque beside a voltage: only one of them can drive."""
    if run.torque is not None and run.drive == "voltage":
        yield Finding(
            run.name,
            "torque",
            "note",
            "this column is not used: the voltage is the input",
            "whole run",
            "To use the torque as the input of the mechanical equation, remove the voltage column",
        )


def current_jumps(run: Recording) -> Iterator[Finding]:
    """Jumps of a current that drives the model: its course between two samples is unknown."""
    if run.drive != "current" or run.current is None:
        return
    steps = np.abs(np.diff(run.current))
    row = int(np.argmax(steps))
    if steps[row] > MAX_JUMP * np.ptp(run.current) and steps[row] > 10 * noise_by_differences(3, run.current):
        yield Finding(
            run.name,
            "current",
            "note",
            f"the current jumps by up to {steps[row]:.3g} A between samples: its course there is unknown and may look"
            " like a missing effect",
            place_of_sample(run, row),
            "Sample faster, or record the voltage as well",
        )


def excitation(runs: Sequence[Recording]) -> Iterator[Finding]:
    """Runs, or all runs together, in which nothing moves."""
    still = [run for run in runs if not any(_moves(y) for y in _driven_signals(run).values())]
    turning = [run for run in runs if _moves(_driven_signals(run).get("speed"))]
    for run in runs:
        speed = _driven_signals(run).get("speed")
        if run in still:
            yield Finding(
                run.name,
                None,
                "error" if len(still) == len(runs) else "note",
                f"no signal varies by more than its noise: {', '.join(_driven_signals(run))}",
                "whole run",
                "Record voltage steps, with the motor starting and stopping",
            )
        elif run.stands_still:
            yield Finding(
                run.name,
                "speed",
                "note" if turning else "warning",
                "the rotor never moves: used as a locked-rotor run, for R and L only",
                "whole run",
                "Record the motor turning as well. If only friction held the rotor, leave out this run",
            )
        elif speed is not None and np.nanstd(speed) <= np.sqrt(2) * noise_by_differences(3, speed):
            noise = noise_by_differences(3, speed)
            what = f"it varies less than its noise of {noise:.3g}" if noise else "it never changes"
            yield Finding(
                run.name,
                "speed",
                "note" if turning and run not in turning else "warning",
                f"{what}: Kb, Kt, J and f are poorly determined",
                "whole run",
                "Record the motor starting and stopping, with larger voltage steps",
            )


CHECKS_OF_A_RUN = (
    gaps,
    jitter,
    missing_samples,
    clipping,
    wrapped_angle,
    constant_load,
    current_jumps,
    unused_torque,
    reversed_signs,
    lost_signs,
    angle_against_speed,
    shifted_channels,
    slow_sampling,
)


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" + "s" * (number > 1)


def _driven_signals(run: Recording) -> dict[str, np.ndarray]:
    # without a voltage the current is what drives
    outputs = {"current": run.current if run.voltage is not None else None, "speed": speed_of(run)}
    return {quantity: values for quantity, values in outputs.items() if values is not None}


def _moves(values: np.ndarray | None) -> bool:
    """Whether means over parts of the run differ by more than noise makes them."""
    if values is None:
        return False
    values = values[np.isfinite(values)]
    size = max(len(values) // 50, 1)
    means = values[: len(values) // size * size].reshape(-1, size).mean(1)
    rounding = 1e-9 * float(np.max(np.abs(values), initial=0.0))
    return bool(np.std(means) > 2 * noise_by_differences(3, values) / np.sqrt(size) + rounding)
