"""What a user should know of an identification besides its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..motor import Motor
from ..recordings.recording import AROUND, OVER_BOTH, OVER_LAST
from ..simulate import Timing
from .identification import RunFit, Search
from .noise.sensor_noise import rms
from .prepare import Prepared
from .run_fits import of_training

# Least share of the motor's torque (root mean square) from which an unknown load is worth a message
MIN_LOAD_SHARE = 0.02
# Largest difference of an unknown load between the runs, over itself, for the same
MAX_LOAD_SPREAD = 0.2
# Initial rise of a winding's resistance that is worth a message
MIN_INITIAL_RISE = 0.02
# Units of what drives a motor
UNITS = {"voltage": "V", "current": "A", "torque": "N m"}
OUTPUT_UNITS = {"current": "A", "speed": "rad/s"}
# Spans over which a speed may be averaged
AVERAGING_SPANS = {
    OVER_LAST: "the last sample interval",
    OVER_BOTH: "the last and the next sample interval",
    AROUND: "the sample interval around each instant",
}


def messages_of(
    prepared: Prepared, search: Search, motor: Motor, fit: Mapping[str, RunFit], Kt_set_to_Kb: bool
) -> tuple[str, ...]:
    """What was corrected, assumed or interrupted, and what the loads and the temperatures of the runs may be."""
    messages = _corrections(prepared)
    if search.interrupted:
        messages.append(f"the search was interrupted after {len(search.best)} generations")
    if Kt_set_to_Kb:
        messages.append("Kt was set equal to Kb, as holds in SI units, and J and f scale with it")
    return (*messages, *_unknown_load(motor, of_training(fit)), *_warm_windings(fit))


def _corrections(prepared: Prepared) -> list[str]:
    """What the sensors and the recorder did to the signals, as far as it is modelled."""
    messages = [
        f"{run}, {output}: {count} single reading{'s are' if count > 1 else ' is'} up to {largest:.3g} "
        f"{OUTPUT_UNITS[output]} off, unlike those beside: treated as missing"
        for (run, output), (count, largest) in prepared.outliers.items()
    ]
    messages += [
        f"{run.name}: the recorded {run.drive} has {prepared.input_noise[run.name]:.3g} {UNITS[run.drive]} of sensor "
        "noise that did not reach the motor: it was removed"
        for run in prepared.runs
        if run.name in prepared.input_noise
    ]
    messages += [
        f"the sensor of the {output} picks up mains hum of {amplitude:.3g} {OUTPUT_UNITS[output]}: it was removed"
        for output, amplitude in prepared.mains_hum.items()
    ]
    acts = "steps between samples" if prepared.stepped else _timing_words(prepared.timing)
    if acts:
        messages.append(f"the voltage {acts}: this is modelled")
    if prepared.timing.current_mean:
        messages.append("the current is a mean over the last sample interval: this is modelled")
    if prepared.averaging:
        span = AVERAGING_SPANS[prepared.averaging]
        if prepared.problem.tape.span is not None:
            span = "the interval from the last reading of its sensor"
        messages.append(f"the speed is a mean over {span}, as differences of an angle are: this is modelled")
    return messages


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
    return [f"the unknown load is {largest:.3g} N m in all runs: {what}. If nothing was attached, give --unloaded"]


def _warm_windings(fit: Mapping[str, RunFit]) -> list[str]:
    """The runs that begin with a winding warmer than that of the coolest one."""
    rises = {name: one.initial_rise or 0.0 for name, one in fit.items()}
    warm = [f"{name} by {100 * x:.2g} %" for name, x in rises.items() if x > MIN_INITIAL_RISE]
    if not warm:
        return []
    return [f"the winding is warm, and R larger, at the start of {', '.join(warm)}: this is modelled"]


def _timing_words(timing: Timing) -> str | None:
    """What the voltages do, if they are not held from their sample on."""
    if timing.lead == 0 and not timing.first_order_hold:
        return None
    if timing.smooth is not None:
        return "changes smoothly between its samples, except at jumps, instead of being held"
    if timing.first_order_hold:
        return "is linear between samples instead of held"
    if timing.reading is not None:
        sooner = "earlier" if timing.lead > 0 else "later"
        return f"acts {abs(timing.lead):.2g} of a sample {sooner} than it was recorded"
    if timing.lead > 0:
        return "was recorded one sample late, after it had been held instead of before"
    return "acts one sample later than it was recorded"
