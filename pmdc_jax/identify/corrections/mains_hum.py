"""Mains hum that a sensor picked up: an oscillation at the frequency of the mains and its harmonics, removed from the
signal of the sensor.

A torque or a voltage that oscillates moves speed and current alike. If only one of them oscillates, its sensor, or the
wires from it, pick up the hum.
"""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np
from jaxtyping import Complex, Float

from ...motor import Motor
from ...recordings.readings import reading_interval
from ...recordings.recording import SIMULATED_OUTPUTS, Recording
from ..fit.fitted_runs import FittedRuns
from ..noise.spectral_lines import common_line, spectrum

# Frequencies of the mains in Hz, and how far they may be off
MAINS, TOLERANCE = (50.0, 60.0), 0.5
# Harmonics that are removed, up to this share of half the sampling rate
HARMONICS, MAX_SHARE = range(1, 6), 0.95
# Frequencies per resolution of the longest run among which the best one is sought
REFINEMENT = 10
# A torque or a voltage that oscillates leaves at most this share of the squares of the other output's oscillation
MAX_LEFT = 0.5


def without_mains_hum(fitted: FittedRuns) -> FittedRuns:
    """The runs without the hum of their sensors, and the fit to them; both unchanged where none is found."""
    hums = dict(_hums(fitted))
    if not hums:
        return fitted
    prepared, fit = fitted
    residuals = [fitted.residuals(k) for k in range(len(prepared.runs))]
    runs, removed = list(prepared.runs), dict(prepared.mains_hum)
    for output, frequency in hums.items():
        name = SIMULATED_OUTPUTS[output]
        for k, run in enumerate(runs):
            if getattr(run, name) is not None:
                runs[k], amplitude = _without(run, name, residuals[k][:, output], frequency)
                if k in prepared.training_indices:
                    removed[name] = max(removed.get(name, 0.0), amplitude)
    quiet = prepared.with_tape_of(runs, "measured")._replace(runs=runs, mains_hum=removed)
    return FittedRuns.polished(quiet, fit.optimum)


def _hums(fitted: FittedRuns) -> Iterator[tuple[int, float]]:
    """The outputs that hum, 0 for the current and 1 for the speed, with the frequency in Hz."""
    prepared = fitted.prepared
    both = [k for k in prepared.training_indices if _shows_hum(prepared.runs[k])]
    if not both:
        return
    runs, residuals = [prepared.runs[k] for k in both], [np.nan_to_num(fitted.residuals(k)) for k in both]
    motor = prepared.problem.parameters(fitted.fit.coordinates)
    for output in (0, 1):
        spectra = [
            spectrum(residual[:, [output]], np.asarray(run.voltage)[:, None], run.sample_time)
            for run, residual in zip(runs, residuals, strict=True)
        ]
        line = common_line(spectra)
        if line is None or not any(line.low - TOLERANCE < mains < line.high + TOLERANCE for mains in MAINS):
            continue
        frequency = _refined((line.low + line.high) / 2, runs, [r[:, output] for r in residuals])
        waves = np.array(
            [[_phasor(run, x, frequency) for x in residual.T] for run, residual in zip(runs, residuals, strict=True)]
        )
        if _is_of_sensor(motor, waves, output, frequency):
            yield output, frequency


def _shows_hum(run: Recording) -> bool:
    """Whether a run has voltage, current and speed, without a sensor slower than the log: the rate of its readings may
    be that of the mains."""
    outputs = [x for x in (run.current, run.speed) if x is not None and reading_interval(~np.isnan(x)) == 1]
    return run.voltage is not None and len(outputs) == 2


def _refined(frequency: float, runs: list[Recording], residuals: list[Float[np.ndarray, " samples"]]) -> float:
    """The frequency in Hz next to a given one at which the residuals of all runs oscillate most."""
    resolution = 1 / max(run.duration for run in runs)
    near = frequency + resolution * np.linspace(-2, 2, 4 * REFINEMENT + 1)

    def power(f: float) -> float:
        return sum(abs(_phasor(run, r, f)) ** 2 * len(r) for run, r in zip(runs, residuals, strict=True))

    return float(max(near, key=power))


def _phasor(run: Recording, signal: Float[np.ndarray, " samples"], frequency: float) -> complex:
    """The amplitude of a signal's oscillation, with its phase at the time zero of its run."""
    return complex(2 * np.mean(signal * np.exp(-2j * np.pi * frequency * run.time)))


def _is_of_sensor(motor: Motor, waves: Complex[np.ndarray, "runs 2"], output: int, frequency: float) -> bool:
    """Whether one output oscillates alone: neither a voltage nor a torque that oscillates explains the other one.

    **Arguments**: `waves`, the oscillation of current and speed in each run.
    """
    A, B = (np.asarray(x) for x in motor.state_space())
    by_source = np.linalg.solve(2j * np.pi * frequency * np.eye(2) - A, B)  # of a voltage, and of a torque
    seen, other = waves[:, output], waves[:, 1 - output]
    expected = seen[:, None] * by_source[1 - output] / by_source[output]
    left = np.square(np.abs(other[:, None] - expected)).sum(0)
    return bool(left.min() > MAX_LEFT * np.square(np.abs(other)).sum())


def _without(
    run: Recording, name: str, residual: Float[np.ndarray, " samples"], frequency: float
) -> tuple[Recording, float]:
    """A run with the hum removed from one of its outputs, and the amplitude of that hum."""
    orders = [k for k in HARMONICS if k * frequency * 2 * run.sample_time < MAX_SHARE]
    if not orders:  # sampled too slowly to show it
        return run, 0.0

    def waves(time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "samples waves"]:
        angles = 2 * np.pi * frequency * time[:, None] * np.array(orders)
        return np.concatenate([np.cos(angles), np.sin(angles)], 1)

    known = ~np.isnan(residual)
    coefficients = np.linalg.lstsq(waves(run.time)[known], residual[known])[0]
    record = run.recorded
    quiet = {name: getattr(run, name) - waves(run.time) @ coefficients}
    if not run.has_even_clock:
        clean = getattr(record, name) - waves(record.time) @ coefficients
        quiet["resampled_from"] = attrs.evolve(record, **{name: clean})
    return attrs.evolve(run, **quiet), float(np.hypot(coefficients[0], coefficients[len(orders)]))
