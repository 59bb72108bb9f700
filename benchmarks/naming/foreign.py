"""Motors, drives and sensors of all kinds, far from the paper's: 6 to 48 V, 3 to 80 A, samples of 0.2 to 5 ms.

Effects are drawn relative to their motor. Few runs, some of a speed loop with a noisy voltage that acts on the motor;
sensors that count, round, measure only the angle, or add noise to the recorded voltage, which does not act on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.naming.excitations import HOLDOUT, Excitations
from benchmarks.naming.hidden import LIBRARY, Hidden, Parameters, log_uniform
from benchmarks.naming.plant import Plant
from benchmarks.virtual_bench import Excitation, Noise

SENSORS = ("ordinary", "encoder", "noisy_voltage", "converter", "angle")
# an encoder has neither
OF_SPEED_SENSOR = ("speed_sensor_lag", "speed_sensor_delay")
WITHOUT_SPEED_SENSOR = ("encoder", "angle")
LINE_SHARE = 0.01  # of the largest speed is one line of an encoder per sample
SAMPLE_TIMES = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3)
Voltage = Callable[[Generator, "Size", NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Size:
    """Scales of a motor: its largest speed, current and torque, and its time constant."""

    volt: float
    speed: float  # without load, rad/s
    current: float  # at standstill, A
    torque: float  # at standstill, N m
    mechanical_s: float  # time constant

    @classmethod
    def of(cls, plant: Plant) -> Size:
        """The scales of a motor at its supply voltage."""
        stall = plant.bus_V / plant.R
        slow = plant.J * plant.R / plant.Kb / plant.Kt
        return cls(plant.bus_V, plant.bus_V / plant.Kb, stall, plant.Kt * stall, slow)


def motor(rng: Generator) -> Plant:
    """A motor of any size."""
    volt = float(rng.choice([6.0, 12.0, 24.0, 48.0]))
    Kb = volt / log_uniform(rng, 100.0, 900.0)
    stall = log_uniform(rng, 3.0, 80.0)
    Kt = Kb * math.exp(0.01 * rng.standard_normal())
    slow, fast = log_uniform(rng, 0.01, 0.15), log_uniform(rng, 2e-4, 3e-3)
    R = volt / stall
    f = rng.uniform(0.005, 0.03) * Kt * stall * Kb / volt
    J = slow * Kb * Kt / R
    return Plant(R, min(fast, slow / 4) * R, Kb, Kt, J, f, bus_V=volt)


def sample_time(rng: Generator, plant: Plant, kind: str) -> float:
    """A reasonable sample time for the motor: the speed of an encoder is a mean over two samples."""
    longest = Size.of(plant).mechanical_s / (32 if kind == "encoder" else 8)
    return float(f"{min(rng.choice(SAMPLE_TIMES), longest):.1g}")


# -------------------------------------------------------------------------------------- excitations


def _steps(rng: Generator, size: Size, time):
    levels, held = _held(rng, size, time)
    return 0.8 * size.volt * rng.uniform(-1.0, 1.0, levels)[held]


def _two_levels(rng: Generator, size: Size, time):
    levels, held = _held(rng, size, time)
    return 0.3 * size.volt * (1.0 + rng.choice([-1.0, 1.0], levels)[held])


def _held(rng: Generator, size: Size, time) -> tuple[int, NDArray[np.int64]]:
    """The number of levels, and the index of the level at each sample."""
    hold = max(2.0 * time[1], size.mechanical_s * rng.uniform(0.3, 1.5))
    held = (time / hold + 1e-6).astype(int)
    return int(held[-1]) + 1, held


def _chirp(rng: Generator, size: Size, time):
    turns = 0.01 * time / size.mechanical_s + time**2 / (2 * time[-1] * size.mechanical_s)
    return 0.7 * size.volt * np.sin(2 * math.pi * turns)


def _sines(rng: Generator, size: Size, time):
    parts = [
        np.sin(2 * math.pi * log_uniform(rng, 0.02, 1.5) * time / size.mechanical_s + phase)
        for phase in rng.uniform(0.0, 2 * math.pi, 8)
    ]
    return np.clip(size.volt / 6 * np.sum(parts, axis=0), -size.volt, size.volt)


def _trapezoid(rng: Generator, size: Size, time):
    return 0.7 * size.volt * np.clip(3 * np.sin(4 * math.pi * time / time[-1]), -1.0, 1.0)


def _staircase(rng: Generator, size: Size, time):
    tread = np.floor(16 * time / time[-1])
    return 0.8 * size.volt * np.interp(tread, [0, 4, 12, 16], [0.0, 1.0, -1.0, 0.0])


def _speed_loop(rng: Generator, size: Size, time):
    """The voltage of a PI loop around a first-order motor, which reacts to a noisy speed."""
    dt, per_speed = time[1], size.volt / size.speed
    wanted = 0.6 * size.speed * _eight_levels(rng, len(time))
    speed, sum_of_errors, voltage = 0.0, 0.0, np.empty(len(time))
    for k, noise in enumerate(0.002 * size.speed * rng.standard_normal(len(time))):
        error = wanted[k] - speed - noise
        asked = 2 * per_speed * (error + sum_of_errors / size.mechanical_s)
        voltage[k] = np.clip(asked, -size.volt, size.volt)
        sum_of_errors += error * dt * (voltage[k] == asked)
        speed += (voltage[k] / per_speed - speed) * -math.expm1(-dt / size.mechanical_s)
    return voltage


def _eight_levels(rng: Generator, samples: int) -> NDArray[np.float64]:
    """Eight random levels between -1 and 1, one after another."""
    return np.repeat(rng.uniform(-1.0, 1.0, 8), -(-samples // 8))[:samples]


VOLTAGES: tuple[Voltage, ...] = (_steps, _two_levels, _chirp, _sines, _trapezoid, _staircase, _speed_loop)
HELD_OUT: tuple[Voltage, ...] = (_steps, _two_levels, _sines)


def excitations(rng: Generator, plant: Plant, kind: str) -> Excitations:
    """One to five runs and a hold-out, the first and the last loaded, for a kind of sensors."""
    size, dt = Size.of(plant), sample_time(rng, plant, kind)
    samples = int(np.clip(40 * size.mechanical_s / dt, 1500, 8000))
    time = np.arange(samples) * dt
    chosen = [VOLTAGES[k] for k in rng.permutation(len(VOLTAGES))[: rng.integers(1, 6)]]
    held_out = HELD_OUT[rng.integers(len(HELD_OUT))]

    def excitation(voltage: Voltage, loaded: bool) -> Excitation:
        load = np.zeros(samples)
        if loaded:
            load = 0.25 * size.torque * _eight_levels(rng, samples)
        return Excitation(time, voltage(rng, size, time), load)

    runs = {v.__name__[1:]: excitation(v, k == 0) for k, v in enumerate(chosen)}
    return runs | {HOLDOUT: excitation(held_out, True)}


# ------------------------------------------------------------------------------------------ sensors


def noise(rng: Generator, plant: Plant, kind: str) -> Noise:
    """Noise of good sensors, or the rounding of an encoder, and in every third case torque noise."""
    size = Size.of(plant)
    of_speed = LINE_SHARE / math.sqrt(6.0) if kind == "encoder" else 0.002
    shaken = 0.006 * size.torque * float(rng.random() < 1 / 3)
    memory = size.mechanical_s * log_uniform(rng, 0.1, 1.0)
    good = {"torque_Nm": shaken, "torque_correlation_s": memory}
    return Noise(0.003 * size.current, of_speed * size.speed, **good)


def sensors(kind: str, plant: Plant, driven: Excitation) -> dict[str, float]:
    """Further properties of a kind of sensors, as fields of `Bench`."""
    size, dt = Size.of(plant), float(driven.time[1])
    return {
        "ordinary": {},
        "encoder": {"encoder_lines": round(math.pi / (LINE_SHARE * size.speed * dt))},
        "angle": {"angle_lines": 4096.0},
        "noisy_voltage": {"voltage_V": 0.004 * size.volt},
        "converter": {"voltage_quantum_V": size.volt / 1024, "current_quantum_A": size.current / 256},
    }[kind]


# ------------------------------------------------------------------------------------------ effects


def _share(field: str, low: float, high: float, of: Callable[[Size], float]):
    """A field drawn between two shares of a scale of the motor."""
    return lambda rng, plant: {field: log_uniform(rng, low, high) * of(Size.of(plant))}


def _torque(size: Size) -> float:
    return size.torque


def _stribeck(rng: Generator, plant: Plant) -> Parameters:
    size, dry = Size.of(plant), log_uniform(rng, 0.02, 0.05)
    static = dry * rng.uniform(1.8, 3.0)
    speed = log_uniform(rng, 0.02, 0.06) * size.speed
    return {"coulomb_Nm": dry * size.torque, "static_Nm": static * size.torque, "speed_rad_s": speed}


def _asymmetric(rng: Generator, plant: Plant) -> Parameters:
    dry, other = log_uniform(rng, 0.02, 0.05), rng.uniform(1.5, 3.0)
    pair = rng.permutation([dry, dry * other]) * Size.of(plant).torque
    return {"forward_Nm": float(pair[0]), "backward_Nm": float(pair[1])}


def _periodic(field: str, low: float, high: float, of: Callable[[Size], float]):
    def draw(rng: Generator, plant: Plant) -> Parameters:
        amplitude = log_uniform(rng, low, high) * of(Size.of(plant))
        phase = rng.uniform(0.0, 2 * math.pi)
        return {field: amplitude, "periods": float(rng.integers(3, 13)), "phase": phase}

    return draw


def _heating(rng: Generator, plant: Plant) -> Parameters:
    size = Size.of(plant)
    rise = log_uniform(rng, 1.0, 3.0) / (size.volt * size.current)
    return {"rise_per_W": rise, "time_constant_s": size.mechanical_s * log_uniform(rng, 5.0, 20.0)}


def _shaft(rng: Generator, plant: Plant) -> Parameters:
    """A shaft whose resonance most of the sample times resolve."""
    rate = 2 * math.pi * log_uniform(rng, 0.6, 2.0) / Size.of(plant).mechanical_s
    share = rng.uniform(0.3, 0.7)
    reduced = plant.J * share * (1 - share)
    damping = 2 * log_uniform(rng, 0.03, 0.2) * reduced * rate
    return {"stiffness": reduced * rate**2, "damping": damping, "load_share": share}


def _signed(draw: Callable[[Generator, Plant], Parameters]):
    def either_way(rng: Generator, plant: Plant) -> Parameters:
        sign = float(rng.choice([-1.0, 1.0]))
        return {field: sign * x for field, x in draw(rng, plant).items()}

    return either_way


_DRAWS: Mapping[str, Callable[[Generator, Plant], Parameters]] = {
    "coulomb_friction": _share("torque_Nm", 0.02, 0.05, _torque),
    "stribeck_friction": _stribeck,
    "asymmetric_friction": _asymmetric,
    "quadratic_drag": _share("drag", 0.05, 0.15, lambda s: s.torque / s.speed**2),
    "cogging_torque": _periodic("amplitude_Nm", 0.02, 0.06, _torque),
    "torque_ripple": _periodic("amplitude", 0.05, 0.2, lambda s: 1.0),
    "constant_load": _signed(_share("torque_Nm", 0.02, 0.05, _torque)),
    "shaft_compliance": _shaft,
    "gear_backlash": LIBRARY["gear_backlash"].draw,
    "brush_voltage_drop": _share("voltage_V", 0.02, 0.06, lambda s: s.volt),
    "resistance_heating": _heating,
    "torque_constant_saturation": _share("saturation", 0.5, 2.0, lambda s: 1 / s.current**2),
    "inductance_saturation": _share("saturation", 2.0, 10.0, lambda s: 1 / s.current**2),
    "input_dead_zone": _share("width_V", 0.02, 0.06, lambda s: s.volt),
    "speed_sensor_lag": _share("time_constant_s", 0.05, 0.2, lambda s: s.mechanical_s),
    "speed_sensor_delay": _share("delay_s", 0.05, 0.15, lambda s: s.mechanical_s),
    "current_sensor_offset": _signed(_share("offset_A", 0.01, 0.03, lambda s: s.current)),
}
EFFECTS: dict[str, Hidden] = {name: replace(LIBRARY[name], draw=draw) for name, draw in _DRAWS.items()}
# beyond that hardly any inductance would remain
EFFECTS["inductance_saturation"] = replace(EFFECTS["inductance_saturation"], limits=(1e-4, 1.0))
