"""A virtual test bench: a brushed PMDC motor that shares no code with the package's model.

    L di/dt    = v - R i - Kb w - drop(i)          R = R0 (1 + alpha Temp)
    J dw/dt    = Kt i - f w - T_load - friction(w) - disturbance(t)
    dTemp/dt   = (Rth R i^2 - Temp) / tau

Integration is RK4 in fine steps (20 or more per sample, 40 or more per electrical time constant).
Coulomb friction and the brush drop are set-valued: at zero speed (zero current) they take the value
within their level that keeps it there, and the times of entering and leaving that state are found.
Row k of a record is the state at t_k, before the voltage of row k acts; that voltage is then held
until t_(k+1). All quantities are SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

Columns = dict[str, NDArray[np.float64]]
SIX = ("R", "L", "Kb", "Kt", "J", "f")


# ------------------------------------------------------------------------------ motor and noise


@dataclass(frozen=True)
class BenchMotor:
    """The true motor: six constants, and effects that are absent by default.

    R ohm, L H, Kb V s/rad, Kt N m/A, J kg m^2, f N m s/rad.
    """

    R: float
    L: float
    Kb: float
    Kt: float
    J: float
    f: float
    coulomb_Nm: float = 0.0
    constant_load_Nm: float = 0.0  # opposes positive motion, and is in no record
    brush_drop_V: float = 0.0
    brush_onset_A: float = 0.0  # 0: set-valued; otherwise drop = brush_drop tanh(i / onset)
    copper_alpha_per_K: float = 0.0
    thermal_resistance_K_per_W: float = 0.0
    thermal_time_s: float = 60.0

    def packed(self) -> NDArray[np.float64]:
        """The constants in the order the compiled kernels unpack them."""
        sharp_drop = 0.0 if self.brush_onset_A else self.brush_drop_V
        smooth_drop = self.brush_drop_V - sharp_drop
        heat = (self.copper_alpha_per_K, self.thermal_resistance_K_per_W, self.thermal_time_s)
        drop = (sharp_drop, smooth_drop, self.brush_onset_A or 1.0)
        return np.array([*(getattr(self, n) for n in SIX), self.coulomb_Nm, *drop, *heat])


@dataclass(frozen=True)
class Noise:
    """Disturbances of the motor and its measurement: white sensor noise, coloured torque noise, a quantised speed."""

    current_A: float = 0.1
    speed_rad_s: float = 0.5
    torque_Nm: float = 0.0  # standard deviation of the Ornstein-Uhlenbeck torque
    torque_correlation_s: float = 0.02
    speed_quantum_rad_s: float = 0.0


QUIET = Noise(current_A=0.0, speed_rad_s=0.0)


class Excitation(NamedTuple):
    """Held voltage (V) and held load torque (N m) on a uniform time grid (s)."""

    time: NDArray[np.float64]
    voltage: NDArray[np.float64]
    load: NDArray[np.float64]


def paper_motor() -> BenchMotor:
    """The 24 V wheelchair motor of the paper's Table 1."""
    return BenchMotor(R=0.157378, L=0.0003137, Kb=0.0492, Kt=0.0501, J=0.000466, f=0.0002546)


def drawn_motor(rng: Generator, spread: float = 0.25, **effects: float) -> BenchMotor:
    """A motor drawn log-normally about the paper's, `spread` being the log standard deviation.

    Kt and Kb are one constant in SI, so they move together and differ as the paper's do, by 2 %.
    """
    factor = dict(zip(SIX, np.exp(spread * rng.standard_normal(6)), strict=True))
    factor["Kt"] = factor["Kb"] * math.exp(0.02 * rng.standard_normal())
    motor = paper_motor()
    return replace(motor, **{n: float(getattr(motor, n) * factor[n]) for n in SIX}, **effects)


# ------------------------------------------------------------------------- fine-step integration


@njit(cache=True)
def _slope(i, w, temp, v, load, mode_i, mode_w, p):
    """Time derivatives of current, speed and temperature; a mode of 0 means held at zero."""
    R, L, Kb, Kt, J, f, coulomb, sharp, smooth, onset, alpha, Rth, tau = p
    R = R * (1.0 + alpha * temp)
    drop = sharp * mode_i
    if smooth != 0.0:
        drop += smooth * math.tanh(i / onset)
    di = (v - R * i - Kb * w - drop) / L if mode_i != 0 else 0.0
    dw = (Kt * i - f * w - load - coulomb * mode_w) / J if mode_w != 0 else 0.0
    return di, dw, (Rth * R * i * i - temp) / tau


@njit(cache=True)
def _rk4(i, w, temp, v, load, mode_i, mode_w, h, p):
    """One classical Runge-Kutta step of length h in fixed modes."""
    a = _slope(i, w, temp, v, load, mode_i, mode_w, p)
    g = 0.5 * h
    b = _slope(i + g * a[0], w + g * a[1], temp + g * a[2], v, load, mode_i, mode_w, p)
    c = _slope(i + g * b[0], w + g * b[1], temp + g * b[2], v, load, mode_i, mode_w, p)
    d = _slope(i + h * c[0], w + h * c[1], temp + h * c[2], v, load, mode_i, mode_w, p)
    s = h / 6.0
    return (
        i + s * (a[0] + 2.0 * (b[0] + c[0]) + d[0]),
        w + s * (a[1] + 2.0 * (b[1] + c[1]) + d[1]),
        temp + s * (a[2] + 2.0 * (b[2] + c[2]) + d[2]),
    )


@njit(cache=True)
def _leaves_mode(x, drive, level, mode):
    """Whether a dry element has left its mode: crossed zero, or been driven beyond its level."""
    if level == 0.0:
        return False
    return abs(drive) > level if mode == 0 else x * mode < 0.0


@njit(cache=True)
def _settle(x, drive, level, mode):
    """State and mode of a dry element just after its mode ended."""
    if not _leaves_mode(x, drive, level, mode):
        return x, mode
    if abs(drive) <= level:
        return 0.0, 0
    return 0.0, 1 if drive > 0.0 else -1


@njit(cache=True)
def _advance(i, w, temp, v, load, mode_i, mode_w, h, p):
    """One fine step, broken where a dry element starts or stops slipping."""
    Kb, Kt, coulomb, sharp = p[2], p[3], p[6], p[7]
    for _ in range(16):  # more events than occur in one fine step
        i1, w1, temp1 = _rk4(i, w, temp, v, load, mode_i, mode_w, h, p)
        if not (_leaves_mode(i1, v - Kb * w1, sharp, mode_i) or _leaves_mode(w1, Kt * i1 - load, coulomb, mode_w)):
            break
        before, after = 0.0, h
        for _ in range(45):  # bisection to the last digits; events are rare
            middle = 0.5 * (before + after)
            i1, w1, temp1 = _rk4(i, w, temp, v, load, mode_i, mode_w, middle, p)
            if _leaves_mode(i1, v - Kb * w1, sharp, mode_i) or _leaves_mode(w1, Kt * i1 - load, coulomb, mode_w):
                after = middle
            else:
                before = middle
        i, w, temp = _rk4(i, w, temp, v, load, mode_i, mode_w, after, p)
        i, mode_i = _settle(i, v - Kb * w, sharp, mode_i)
        w, mode_w = _settle(w, Kt * i - load, coulomb, mode_w)
        h -= after
        i1, w1, temp1 = i, w, temp
    return i1, w1, temp1, mode_i, mode_w


@njit(cache=True)
def _first_mode(x, drive, level):
    """The mode in which a dry element starts."""
    if x != 0.0 or level == 0.0:
        return 1 if x >= 0.0 else -1
    if abs(drive) <= level:
        return 0
    return 1 if drive > 0.0 else -1


@njit(cache=True)
def _simulate(voltage, load, disturbance, dt, start, p):
    """States at each sample, shape (samples, 3); disturbance has shape (samples, substeps)."""
    samples, substeps = disturbance.shape
    states = np.empty((samples, 3))
    i, w, temp = start[0], start[1], start[2]
    mode_i = _first_mode(i, voltage[0] - p[2] * w, p[7])
    mode_w = _first_mode(w, p[3] * i - load[0] - disturbance[0, 0], p[6])
    h = dt / substeps
    for k in range(samples):
        states[k, 0], states[k, 1], states[k, 2] = i, w, temp
        for j in range(substeps):
            torque = load[k] + disturbance[k, j]
            i, w, temp, mode_i, mode_w = _advance(i, w, temp, voltage[k], torque, mode_i, mode_w, h, p)
    return states


@njit(cache=True)
def _ornstein_uhlenbeck(white, decay, sd):
    """Turn white unit noise, in place, into a stationary torque that decays by `decay` a step."""
    flat = white.reshape(-1)
    kick = sd * math.sqrt(1.0 - decay * decay)
    x = sd * flat[0]
    for k in range(flat.size):
        flat[k], x = x, decay * x + kick * flat[k]


def _substeps(motor: BenchMotor, dt: float) -> int:
    """Fine steps per sample: at least 20, and at least 40 per electrical time constant.

    Four times as many when the current sweeps through a smooth, hence narrow, brush onset.
    """
    finer = 4 if motor.brush_drop_V and motor.brush_onset_A else 1
    return finer * max(20, math.ceil(40.0 * dt * motor.R / motor.L))


def simulate(
    motor: BenchMotor,
    excitation: Excitation,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    disturbance: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """True current (A), speed (rad/s), winding temperature rise (K) at every sample, (N, 3)."""
    time, voltage, load = (np.ascontiguousarray(c, float) for c in excitation)
    dt = float((time[-1] - time[0]) / (time.size - 1))
    if disturbance is None:
        disturbance = np.zeros((time.size, _substeps(motor, dt)))
    load = load + motor.constant_load_Nm
    return _simulate(voltage, load, disturbance, dt, np.asarray(start, float), motor.packed())


def torque_noise(motor: BenchMotor, excitation: Excitation, rng: Generator, noise: Noise) -> NDArray[np.float64]:
    """Ornstein-Uhlenbeck torque (N m) for every fine step, shape (samples, substeps)."""
    dt = float(excitation.time[1] - excitation.time[0])
    substeps = _substeps(motor, dt)
    torque = np.zeros((excitation.time.size, substeps))
    if noise.torque_Nm:
        torque = rng.standard_normal(torque.shape)
        decay = math.exp(-dt / substeps / noise.torque_correlation_s)
        _ornstein_uhlenbeck(torque, decay, noise.torque_Nm)
    return torque


def record(
    motor: BenchMotor,
    excitation: Excitation,
    rng: Generator,
    noise: Noise = Noise(),
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    load_known: bool = True,
) -> Columns:
    """Run the bench and measure: the columns of one record, by their canonical names."""
    disturbance = torque_noise(motor, excitation, rng, noise)
    states = simulate(motor, excitation, start, disturbance)
    current = states[:, 0] + noise.current_A * rng.standard_normal(len(states))
    speed = states[:, 1] + noise.speed_rad_s * rng.standard_normal(len(states))
    if noise.speed_quantum_rad_s:
        speed = noise.speed_quantum_rad_s * np.round(speed / noise.speed_quantum_rad_s)
    columns = {"time_s": excitation.time, "voltage_V": excitation.voltage, "current_A": current, "speed_rad_s": speed}
    return columns | ({"load_torque_Nm": excitation.load} if load_known else {})


def write_csv(path: Path | str, columns: Mapping[str, NDArray], decimals: int = 9) -> None:
    """Write one record; the keys are the headers, values are rounded to `decimals` places."""
    rows = zip(*(np.round(column, decimals).tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(f"{x + 0.0:.12g}" for x in row) for row in rows)]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


# ------------------------------------------------------------------------------------ excitations


def _clock(duration: float, dt: float) -> NDArray[np.float64]:
    return np.arange(round(duration / dt)) * dt


def _held(levels: NDArray[np.float64], time: NDArray[np.float64], hold: float) -> NDArray:
    """Each level held for `hold` seconds, starting again when they run out."""
    # the small shift is for samples that rounding puts just before their step
    return levels[((time - time[0]) / hold + 1e-6).astype(int) % len(levels)]


def staircase(duration: float = 5.0, dt: float = 1e-3, amplitude: float = 18.0) -> Excitation:
    """Twenty levels: from 0 up to +amplitude, down to -amplitude and back, no load."""
    time = _clock(duration, dt)
    tread = np.arange(20)
    levels = amplitude * np.interp(tread, [0, 5, 15, 20], [0.0, 1.0, -1.0, 0.0])
    return Excitation(time, _held(levels, time, duration / 20), np.zeros_like(time))


def prbs(
    rng: Generator,
    duration: float = 4.0,
    dt: float = 1e-3,
    amplitude: float = 6.0,
    offset: float = 8.0,
    hold: float = 0.01,
) -> Excitation:
    """offset +- amplitude at random every `hold` seconds, no load."""
    time = _clock(duration, dt)
    signs = rng.integers(0, 2, math.ceil(duration / hold)) * 2 - 1
    return Excitation(time, offset + amplitude * _held(signs, time, hold), np.zeros_like(time))


def slow_triangle(duration: float = 6.0, dt: float = 1e-3, amplitude: float = 6.0, period: float = 6.0) -> Excitation:
    """A triangle between +-amplitude that creeps through standstill, no load."""
    time = _clock(duration, dt)
    corners = np.array([0.0, 0.25, 0.75, 1.0]) * period
    voltage = np.interp(time % period, corners, [0.0, amplitude, -amplitude, 0.0])
    return Excitation(time, voltage, np.zeros_like(time))


def loaded(
    rng: Generator,
    duration: float = 4.0,
    dt: float = 1e-3,
    amplitude: float = 18.0,
    load: float = 0.8,
    hold: float = 0.25,
) -> Excitation:
    """Random voltage levels in both directions, each with its own known braking torque (N m)."""
    time = _clock(duration, dt)
    count = math.ceil(duration / hold)
    levels = amplitude * rng.uniform(0.3, 1.0, count) * rng.choice([-1.0, 1.0], count)
    brake = load * rng.uniform(0.0, 1.0, count) * np.sign(levels)
    return Excitation(time, _held(levels, time, hold), _held(brake, time, hold))


def load_cycles(
    rng: Generator,
    duration: float = 60.0,
    dt: float = 1e-2,
    amplitude: float = 16.0,
    load: float = 0.8,
    period: float = 4.0,
) -> Excitation:
    """The same load cycle again and again, long enough to warm the winding.

    A quarter of each period is free, then half, full and half load; the voltage moves moderately
    (75 to 100 % of the amplitude) eight times a period.
    """
    time = _clock(duration, dt)
    torque = load * _held(np.array([0.0, 0.5, 1.0, 0.5]), time, period / 4)
    levels = amplitude * rng.uniform(0.75, 1.0, math.ceil(8 * duration / period))
    return Excitation(time, _held(levels, time, period / 8), torque)


def drive(
    rng: Generator, duration: float = 4.0, dt: float = 1e-3, amplitude: float = 18.0, load: float = 0.6
) -> Excitation:
    """A smooth mixed drive for hold-out: slow and fast swings, both directions, a moving load."""
    time = _clock(duration, dt)
    rates = np.array([0.35, 0.9, 2.3, 6.1])  # Hz
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, rates.size))
    waves = np.sin(2.0 * np.pi * rates * time[:, None] + phases[0])
    voltage = amplitude * waves @ np.array([0.5, 0.25, 0.15, 0.1])
    torque = load * np.sin(2.0 * np.pi * rates[:3] * time[:, None] + phases[1, :3]).mean(1)
    return Excitation(time, voltage, torque)


# ------------------------------------------------------------------------------ the standard case


def standard_excitations(rng: Generator, all_at_1_ms: bool = False) -> dict[str, Excitation]:
    """Seven runs, 33,000 samples in all; `drive` is meant for hold-out.

    The load cycles last 60 s sampled every 10 ms, or 6 s when all runs are to be at 1 ms.
    """
    cycles = {"duration": 6.0, "dt": 1e-3, "period": 1.0} if all_at_1_ms else {}
    return {
        "staircase": staircase(),
        "prbs": prbs(rng),
        "triangle": slow_triangle(),
        "loaded_a": loaded(rng),
        "loaded_b": loaded(rng, hold=0.1, load=0.5),
        "load_cycles": load_cycles(rng, **cycles),
        "drive": drive(rng),
    }


def standard_runs(
    rng: Generator, motor: BenchMotor | None = None, noise: Noise = Noise(), all_at_1_ms: bool = False
) -> dict[str, Columns]:
    """The standard case recorded from `motor` (the paper's if none is given)."""
    motor = motor or paper_motor()
    excitations = standard_excitations(rng, all_at_1_ms)
    return {name: record(motor, e, rng, noise) for name, e in excitations.items()}
