"""Runs with voltages of another timing than that of their record."""

from __future__ import annotations

import attrs
import numpy as np

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
    if run.drive != "voltage":
        return run.recorded
    even = run.has_even_clock
    voltage = tape.samples_of(k, tape.drive_at(0.0), len(run)) if even else run.recorded.voltage
    run, last = run.recorded, len(run.recorded) - 1
    rows = np.clip(np.arange(len(run)) + timing.ahead, 0, last)
    run = attrs.evolve(run, voltage=np.asarray(voltage)[rows])
    if not timing.moves_load or run.load is None:
        return run
    # a load varies slowly enough to be held at its means instead of going straight
    ahead = np.minimum(rows + 1, last) if timing.first_order_hold else rows
    return attrs.evolve(run, load=(run.load[rows] + run.load[ahead]) / 2)
