"""Excitations of the motors: the standard runs, and runs that cannot distinguish some effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks import virtual_bench as vb
from benchmarks.virtual_bench import Excitation

Excitations = dict[str, Excitation]
HOLDOUT = "drive"


def _held(levels: NDArray[np.float64], duration: float, dt: float = 1e-3) -> Excitation:
    """Each level for the same time, no load."""
    time = np.arange(round(duration / dt)) * dt
    place = (time * len(levels) / duration + 1e-6).astype(int)
    return Excitation(time, levels[place], np.zeros_like(time))


def fast_steps(rng: Generator, duration: float = 4.0, amplitude: float = 16.0) -> Excitation:
    """Levels in both directions and pauses at zero voltage, changed every 0.1 s; ends at rest."""
    levels = rng.choice([-1.0, -0.6, -0.3, 0.0, 0.0, 0.3, 0.6, 1.0], round(duration / 0.1))
    levels[:2], levels[-4:] = 0.0, 0.0
    return _held(amplitude * levels, duration)


def standard(rng: Generator) -> Excitations:
    """Six runs and a hold-out, 33,000 samples at 1 ms."""
    size = rng.uniform(0.7, 1.1)
    return {
        "staircase": vb.staircase(amplitude=18.0 * size),
        "prbs": vb.prbs(rng, amplitude=6.0 * size, offset=8.0 * size),
        "triangle": vb.slow_triangle(amplitude=6.0 * size),
        "loaded": vb.loaded(rng, amplitude=18.0 * size, load=0.8 * size),
        "load_cycles": vb.load_cycles(rng, 6.0, 1e-3, 16.0 * size, 0.8 * size, period=1.0),
        "fast_steps": fast_steps(rng, amplitude=16.0 * size),
        HOLDOUT: vb.drive(rng, amplitude=18.0 * size, load=0.6 * size),
    }


# ---------------------------------------------------------- excitations that cannot distinguish effects


def _times(rng: Generator, count: int, make: Callable[[], Excitation]) -> Excitations:
    names = [f"run_{k}" for k in range(count)] + [HOLDOUT]
    return {name: make() for name in names}


def one_way(rng: Generator) -> Excitations:
    """Forward only and never slow: all torques that oppose forward motion look the same."""

    def make() -> Excitation:
        return _held(rng.uniform(10.0, 16.0, 20), 4.0)

    return _times(rng, 4, make)


def one_speed(rng: Generator) -> Excitations:
    """Small changes about one operating point."""

    def make() -> Excitation:
        return vb.prbs(rng, duration=4.0, amplitude=0.5, offset=12.0, hold=0.05)

    return _times(rng, 4, make)


def slow_drives(rng: Generator) -> Excitations:
    """Below 1 Hz a lag looks like a delay."""

    def make() -> Excitation:
        time = np.arange(4000) * 1e-3
        phase, rate = rng.uniform(0.0, 2.0 * np.pi, 2), rng.uniform(0.3, 0.8, 2)
        waves = np.sin(2.0 * np.pi * rate * time[:, None] + phase) - np.sin(phase)
        return Excitation(time, 6.0 * waves.sum(1), np.zeros_like(time))

    return _times(rng, 4, make)


def fast_reversals(rng: Generator) -> Excitations:
    """Full speed in either direction, with fast zero crossings: they show the level of dry friction, not its shape."""

    def make() -> Excitation:
        signs = np.where(np.arange(8) % 2 == 0, 1.0, -1.0)
        return _held(signs * rng.uniform(13.0, 18.0, 8), 4.0)

    return _times(rng, 4, make)


def motoring(rng: Generator) -> Excitations:
    """Slow ramps in both directions, never braking: brushes and a dead zone reduce the voltage alike."""

    def make() -> Excitation:
        wave = vb.slow_triangle(duration=4.0, amplitude=rng.uniform(12.0, 18.0), period=8.0)
        return wave._replace(voltage=wave.voltage * float(rng.choice([-1.0, 1.0])) + 0.0)

    return _times(rng, 4, make)


def one_amplitude(rng: Generator) -> Excitations:
    """The same small square wave repeatedly: backlash and a compliant shaft ring alike."""

    def make() -> Excitation:
        return _held(np.where(np.arange(10) % 2 == 0, 3.0, 5.0), 4.0)

    return _times(rng, 4, make)


# for each excitation the effects that it cannot distinguish, of which one is hidden per case
BLIND: Mapping[str, tuple[Callable[[Generator], Excitations], tuple[str, ...]]] = {
    "one_way": (one_way, ("coulomb_friction", "constant_load", "asymmetric_friction")),
    "one_speed": (one_speed, ("coulomb_friction", "current_sensor_offset", "brush_voltage_drop")),
    "slow_drives": (slow_drives, ("speed_sensor_lag", "speed_sensor_delay")),
    "fast_reversals": (fast_reversals, ("stribeck_friction",)),
    "motoring": (motoring, ("brush_voltage_drop", "input_dead_zone")),
    "one_amplitude": (one_amplitude, ("gear_backlash", "shaft_compliance")),
}


def jittered(excitation: Excitation, rng: Generator, share: float) -> Excitation:
    """The same held inputs on an uneven clock: each time has jitter of that share of an interval."""
    if not share:
        return excitation
    interval = float(np.diff(excitation.time).mean())
    shift = interval * np.clip(share * rng.standard_normal(excitation.time.size), -0.3, 0.3)
    shift[0] = 0.0
    return excitation._replace(time=excitation.time + shift)
