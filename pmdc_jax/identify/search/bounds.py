"""Search bounds of the parameters, derived from the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from ...effects import AbstractEffect
from ...recordings.recording import Recording
from ..noise.sensor_noise import rms

# How far a crude estimate may be off, as a factor either way. Wide: the search is cheap.
CRUDE_FACTOR = 30.0
# The same for L where the rise of the current is sampled finely, as by an oscilloscope
CRUDE_L_FACTOR = 5.0
# Samples in a stretch that is averaged, and least number of stretches: in short runs they are shorter
STRETCH_SAMPLES, MIN_STRETCHES = 20, 30
# Back-EMF constant, V s/rad, where the recordings do not show it
TYPICAL_KB = 0.05
# How much smaller than the signals of the motor an effect may be and still show
DYNAMIC_RANGE = 1e3


def search_bounds(recordings: Sequence[Recording]) -> dict[str, tuple[float, float]]:
    """Search bounds of R, L, Kb, Kt, J and f in SI around crude estimates: a decade and a half either way for R, Kb and
    Kt, three for J, and for f from four and a half below to one above.

    R and Kb are estimated from the balance v = R i + Kb w + L di/dt over short stretches (stall current and no-load
    speed); Kt equals Kb in SI; J and f follow from typical values of torque, change of speed and speed; L follows from
    R and the time constants that the sampling can show, or from that balance if it is larger there.
    """
    R, Kb, L = _crude_armature(recordings)
    typical = _typical_magnitudes(recordings, R, Kb)
    time_constant = np.sqrt(typical.sample_time * typical.duration)
    inertia = typical.torque * time_constant / typical.speed_change
    friction = typical.torque / typical.speed
    return {
        "R": _crude_range(R),
        "L": (R * typical.sample_time / 300, max(R * time_constant, CRUDE_L_FACTOR * L)),
        "Kb": _crude_range(Kb),
        "Kt": _crude_range(Kb),
        "J": (inertia / CRUDE_FACTOR**2, inertia * CRUDE_FACTOR**2),
        "f": (friction / CRUDE_FACTOR**3, friction * CRUDE_FACTOR / 3),
    }


def crude_motor(recordings: Sequence[Recording]) -> dict[str, float]:
    """R, L, Kb, Kt, J and f, as far as equations that are linear in them tell from the measured signals: where a search
    may start. Noise and whatever the equations lack make it crude."""
    R, Kb, L = _crude_armature(recordings)
    crude = {"R": R, "Kb": Kb, "Kt": Kb, "L": L}
    return {name: value for name, value in (crude | _crude_mechanics(recordings, Kb)).items() if value > 0}


def effect_magnitudes(recordings: Sequence[Recording]) -> dict[str, float]:
    """By unit, about the largest magnitude of an effect's parameter that is to be expected: the torque, speed, voltage
    or current of the recordings. Without units of signals that were not recorded."""
    R, Kb, _ = _crude_armature(recordings)
    typical = _typical_magnitudes(recordings, R, Kb)
    volts, amperes = (_largest_rms(recordings, name) for name in ("voltage", "current"))
    largest = {
        "N m": 3 * typical.torque,
        "N m s^2/rad^2": 3 * typical.torque / typical.speed**2,
        "rad/s": typical.speed,
    }
    if volts:
        largest["V"] = volts
    if amperes:
        largest |= {"A": amperes, "1/A^2": 10 / amperes**2}
    if volts and amperes:
        largest["1/W"] = 1 / (volts * amperes)
    return largest


def effect_bounds(
    effects: Sequence[type[AbstractEffect]], recordings: Sequence[Recording]
) -> dict[str, tuple[float, float]]:
    """Search bounds of effect parameters by unit: three decades up to the `effect_magnitudes`, and time constants that
    length and sampling of the recordings can show. Parameters in other units keep the range of their table."""
    largest = effect_magnitudes(recordings)
    shortest = min(run.sample_time for run in recordings) / 5
    longest = 3 * max(run.duration for run in recordings)
    bounds = {}
    for effect in effects:
        for field, allowed in effect.ranges.items():
            low, high = allowed.lower, allowed.upper
            if allowed.unit in largest:
                high = min(high, largest[allowed.unit])
                low = max(low, high / DYNAMIC_RANGE if allowed.scale == "log" else -high)
            elif allowed.unit == "s":
                low, high = max(low, shortest), min(high, longest)
            # the range is empty if the signal of this unit is too small for the effect
            bounds[f"{effect.name}.{field}"] = (low, high) if low < high else (allowed.lower, allowed.upper)
    return bounds


def _largest_rms(recordings: Sequence[Recording], name: str) -> float:
    signals = (getattr(run, name) for run in recordings)
    return max((rms(signal) for signal in signals if signal is not None), default=0.0)


def _crude_armature(recordings: Sequence[Recording]) -> tuple[float, float, float]:
    """R, Kb and L by least squares on means over short stretches; L is zero where the recordings do not show it."""
    rows = []
    for run in recordings:
        speed = np.zeros(len(run)) if run.held else run.speed
        if run.voltage is not None and run.current is not None and speed is not None:
            columns = np.stack([run.voltage, run.current, speed])
            rows.append(_stretch_means(columns[:, ~np.isnan(columns).any(0)], run.sample_time))
    if rows:
        voltage, *inputs = np.concatenate(rows, axis=1)
        inputs = np.stack(inputs, 1)
        scale = np.linalg.norm(inputs, axis=0) + 1e-300
        R, Kb, L = np.linalg.lstsq(inputs / scale, voltage, rcond=1e-6)[0] / scale
        # a short-circuited motor shows only the ratio of R to Kb
        steady = (np.linalg.norm(voltage) or TYPICAL_KB * scale[1]) / scale
        # one that only stalls or only runs without load shows one of the two: the other is a guess
        guess = steady[1] if np.any(inputs[:, 1]) else TYPICAL_KB
        return (R if R > 0 else steady[0]), (Kb if Kb > 0 else guess), max(L, 0.0)
    volts_per_speed = [
        rms(r.voltage) / rms(r.speed) for r in recordings if r.voltage is not None and r.speed is not None
    ]
    volts_per_ampere = [
        rms(r.voltage) / rms(r.current) for r in recordings if r.voltage is not None and r.current is not None
    ]
    Kb = float(np.median(volts_per_speed)) if volts_per_speed else TYPICAL_KB
    return (float(np.median(volts_per_ampere)) / 3 if volts_per_ampere else 1.0), Kb, 0.0


def _crude_mechanics(recordings: Sequence[Recording], Kt: float) -> dict[str, float]:
    """J and f by least squares on J w + f (integral of w) = (integral of Kt i - T_load) + constant of each run; nothing
    where no run tells."""
    rows = []
    for run in recordings:
        torque = Kt * run.current if run.torque is None and run.current is not None else run.torque
        if torque is None or run.speed is None or run.held:
            continue
        driving = torque if run.load is None else torque - run.load
        speed, driving = (_without_gaps(run.time, x) for x in (run.speed, driving))
        columns = np.stack([speed, *(cumulative_trapezoid(x, run.time, initial=0.0) for x in (speed, driving))])
        rows.append(columns - columns.mean(1, keepdims=True))
    if not rows:
        return {}
    speed, angle, impulse = np.concatenate(rows, axis=1)
    J, f = np.linalg.lstsq(np.stack([speed, angle], 1), impulse)[0]
    return {"J": float(J), "f": float(f)}


def _without_gaps(time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """A signal with straight lines over its gaps, which are NaN."""
    known = ~np.isnan(signal)
    return np.interp(time, time[known], signal[known])


class _Typical(NamedTuple):
    """Typical magnitudes of the recordings, the shortest sample time and the longest duration."""

    torque: float  # N m
    speed: float  # rad/s
    speed_change: float  # rad/s
    sample_time: float  # s
    duration: float  # s


def _typical_magnitudes(recordings: Sequence[Recording], R: float, Kt: float) -> _Typical:
    torque, speed, change = [1e-9], [1e-9], [1e-9]
    for run in recordings:
        if run.torque is not None:
            torque.append(rms(run.torque))
        elif run.current is not None:
            torque.append(Kt * rms(run.current))
        elif run.voltage is not None and run.speed is not None:
            torque.append(Kt * rms(run.voltage) / R)
        if run.speed is not None:
            speed.append(rms(run.speed))
            change.append(float(np.nanstd(run.speed)))
        elif run.voltage is not None and not run.held:  # no-load speed
            speed.append(rms(run.voltage) / Kt)
            change.append(rms(run.voltage) / Kt)
    sample_time = min(run.sample_time for run in recordings)
    duration = max(run.duration for run in recordings)
    return _Typical(max(torque), max(speed), max(change), sample_time, duration)


def _crude_range(value: float) -> tuple[float, float]:
    return value / CRUDE_FACTOR, value * CRUDE_FACTOR


def _stretch_means(columns: np.ndarray, sample_time: float) -> np.ndarray:
    """Means of voltage, current and speed over short stretches, and the rate of change of the current in each, A/s."""
    length = max(2, min(STRETCH_SAMPLES, columns.shape[1] // MIN_STRETCHES))
    whole = columns.shape[1] // length
    parts = columns[:, : whole * length].reshape(len(columns), whole, length)
    change = parts[1, :, -1] - parts[1, :, 0]
    return np.vstack([parts.mean(2), change / ((length - 1) * sample_time)])
