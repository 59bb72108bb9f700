"""How each run is reproduced: what was measured beside what was simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..recordings.recording import SIMULATED_OUTPUTS, Recording
from ..simulate import RunUnknowns, Tape
from .identification import Role, RunFit
from .noise.sensor_noise import ratio_to_noise, rms

# Residuals this many times their white noise are reported
MAX_RESIDUAL_RATIO = 2.0


def run_fits(
    runs: Sequence[Recording], roles: Sequence[Role], tape: Tape, simulated: np.ndarray, run_unknowns: RunUnknowns
) -> dict[str, RunFit]:
    """The fit of each run: what was measured beside what was `simulated`, the outputs in the blocks of the tape."""
    # as fitted: a speed corrected for what the sensor added, and both without samples that do not count
    fitted = np.where(np.asarray(tape.weight) > 0, tape.measured, np.nan)
    fits = {}
    for index, (run, role) in enumerate(zip(runs, roles, strict=True)):
        current, speed = tape.samples_of(index, simulated, len(run)).T
        i, w = tape.samples_of(index, fitted, len(run)).T
        driven = run.drive == "voltage"
        i = i if driven and run.current is not None else None
        w = w if run.speed is not None else None
        fits[run.name] = RunFit(
            role=role,
            current_rmse=_rmse(i, current),
            speed_rmse=_rmse(w, speed),
            current_fit_percent=_fit_percent(i, current),
            speed_fit_percent=_fit_percent(w, speed),
            load_offset=float(run_unknowns.load_offset[index]) if tape.load_unknown[index] else None,
            initial_rise=float(run_unknowns.resistance_rise[index]) or None,  # exactly zero where it was not fitted
            time=run.time,
            voltage=run.voltage,
            current=i if driven else run.current,
            current_simulated=current if driven else None,
            speed=w,
            speed_simulated=speed,
            load=run.load,
        )
    return fits


def _rmse(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    return None if measured is None else rms(measured - simulated)


def _fit_percent(measured: np.ndarray | None, simulated: np.ndarray) -> float | None:
    if measured is None:
        return None
    spread = np.sqrt(np.nansum(np.square(measured - np.nanmean(measured))))
    error = np.sqrt(np.nansum(np.square(measured - simulated)))
    return float(100 * (1 - error / spread)) if spread > 0 else None


def large_residuals(fit: Mapping[str, RunFit]) -> dict[str, float]:
    """RMS of the residuals over the white noise of the runs, for the outputs for which that exceeds
    `MAX_RESIDUAL_RATIO`."""
    ratios = {name: ratio_to_noise(measured_and_residuals(fit, name)) for name in SIMULATED_OUTPUTS}
    return {name: ratio for name, ratio in ratios.items() if ratio > MAX_RESIDUAL_RATIO}


def measured_and_residuals(fit: Mapping[str, RunFit], name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """An output as measured and its residuals, in every training run that has it."""
    pairs = [(getattr(f, name), f.residual(name)) for f in of_training(fit)]
    return [(measured, residual) for measured, residual in pairs if residual is not None]


def of_training(fit: Mapping[str, RunFit]) -> list[RunFit]:
    return [one for one in fit.values() if one.role == "train"]
