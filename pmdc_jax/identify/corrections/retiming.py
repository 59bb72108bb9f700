"""Runs with voltages of another timing than that of their record."""

from __future__ import annotations

import attrs
import numpy as np
from jaxtyping import Float, Int

from ...recordings.recording import Recording
from ...simulate import Tape, Timing, on_even_clock
from ..fit.polish import Fit
from ..prepare import Prepared
from ..problem import Problem


def with_timing(prepared: Prepared, timing: Timing) -> Prepared:
    """The runs with voltages of this timing."""
    tape = prepared.problem.tape
    runs = [
        attrs.evolve(on_even_clock(_retimed(run, k, tape, timing)), current_averaged=timing.current_mean)
        for k, run in enumerate(prepared.runs)
    ]
    fields = ("value", "load", "rise", "reading", "averaging", "span")
    acting = prepared.with_tape_of(runs, *fields, timing=timing)._replace(runs=runs, timing=timing)
    # what acts during the first sample was not recorded: without outputs there, the initial state makes up for it
    return acting.without_ends() if timing.ahead < 0 or timing.current_mean else acting


def electrical_rate(problem: Problem, fit: Fit) -> float:
    """R / L of the motor fitted, 1/s."""
    motor = problem.parameters(fit.coordinates)
    return float(motor.R / motor.L)


def _retimed(run: Recording, k: int, tape: Tape, timing: Timing) -> Recording:
    """The record of a run with its voltages, and its loads if the timing says so, moved to the samples where they act.

    Voltages of an even clock, held or straight, are taken from the tape, where their noise may have been removed.
    """
    recorded = run.recorded
    if run.drive != "voltage":
        return recorded
    voltage = tape.samples_of(k, tape.drive_at(0.0), len(run)) if run.has_even_clock else recorded.voltage
    voltage = np.asarray(voltage)[_rows_ahead(len(recorded), timing.ahead)]
    load = None if recorded.load is None else _mean_load(recorded.load, timing)
    return attrs.evolve(recorded, voltage=voltage, load=load)


def _mean_load(load: Float[np.ndarray, " samples"], timing: Timing) -> Float[np.ndarray, " samples"]:
    """The means of a load from one change of the voltages to the next: it varies slowly enough to be held at them."""
    ahead = timing.load_ahead
    if ahead is None:  # at its own samples: some time passes until the next one, the reading
        at, later, share = 0, -1, timing.reading or 0.0
    else:
        at, later, share = ahead, ahead + 1, 0.5 * timing.first_order_hold
    first, second = (load[_rows_ahead(len(load), k)] for k in (at, later))
    return first + share * (second - first)


def _rows_ahead(samples: int, ahead: int) -> Int[np.ndarray, " samples"]:
    """The rows so many samples ahead of each, within the run."""
    return np.clip(np.arange(samples) + ahead, 0, samples - 1)
