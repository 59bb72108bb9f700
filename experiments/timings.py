"""Are motors identified whose voltages are not held from sample to sample? Random motors, eight kinds of log each.

`python -m experiments.timings [--motors 10] [--first 2000]`

Motors of 1 W to 20 kW, sampled every 0.1 to 20 times L / R, three runs of each; two of three motors have a load that is
switched on and off in one run. SciPy simulates the linear motor exactly (`expm`), with voltages that are held from
sample to sample; are linear between samples; are recorded a sample late, beside their response; act a sample late; act
some fraction of a sample early or late; or are linear while the speed is the difference of encoder counts; and with
currents that are means over the last sample. In the eighth kind voltages jump at samples in some runs and are sines
and chirps in others, as in a simulation in continuous time. `identify` gets only the recordings.
"""

import argparse
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.linalg import expm

from benchmarks.virtual_bench import SIX
from pmdc_jax import Recording, identify

WAYS = (
    "held",
    "straight",
    "recorded late",
    "acts late",
    "between samples",
    "straight, counted",
    "mean current",
    "continuous",
)
EXCITATIONS = ("steps", "prbs", "chirp", "sines", "one way")
STEPPED = ("steps", "prbs")
LINES = 2048
# points of each sample of a voltage that is continuous
FINE = 32


class RandomMotor(NamedTuple):
    """A motor, its rated values and its sample time."""

    parameters: dict[str, float]
    volts: float
    amperes: float
    speed: float
    time_constant_s: float  # mechanical
    sample_time: float


def random_motor(rng: np.random.Generator) -> RandomMotor:
    """A motor of any size, by rules of thumb for its supply, speed and losses."""
    watts = 10 ** rng.uniform(0, 4.3)
    volts = np.clip(6 * watts**0.3, 3, 400) * rng.uniform(0.7, 1.4)
    speed = np.clip(900 * watts**-0.15 * rng.uniform(0.6, 1.6), 60, 1500)
    efficiency = np.clip(0.6 + 0.07 * np.log10(watts), 0.5, 0.92)
    amperes = watts / volts / efficiency
    R = volts / amperes * (1 - efficiency) * rng.uniform(0.4, 0.9)
    Kb = (volts - R * amperes) / speed
    Kt = Kb * rng.uniform(0.95, 1.03)
    time_constant_s = 10 ** rng.uniform(-2.0, -0.3)
    L = R * time_constant_s * 10 ** rng.uniform(-2, -0.7)
    f = Kt * amperes * rng.uniform(0.02, 0.15) / speed
    motor = dict(zip(SIX, (R, L, Kb, Kt, time_constant_s * Kb * Kt / R, f), strict=True))
    sample_time = max(L / R / 10 ** rng.uniform(-1.3, 0.9), time_constant_s / 200)
    return RandomMotor(motor, volts, amperes, speed, time_constant_s, float(f"{sample_time:.1g}"))


def voltage(kind: str, motor: RandomMotor, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An excitation of the given kind, V."""
    volts, time_constant_s = motor.volts, motor.time_constant_s
    if kind == "steps":
        return volts * rng.uniform(-1, 1, 8)[np.minimum(8 * time / time[-1], 7).astype(int)]
    if kind == "prbs":
        hold = max(0.7 * time_constant_s, 3 * motor.sample_time)
        return 0.8 * volts * (2 * rng.integers(0, 2, int(time[-1] / hold) + 2) - 1)[(time / hold).astype(int)]
    if kind == "chirp":
        return 0.7 * volts * np.sin((0.2 + 1.4 * time / time[-1]) * time / time_constant_s)
    sines = np.sin(np.geomspace(0.05, 2.5, 6) * time[:, None] / time_constant_s + rng.uniform(0, 6, 6)).sum(1)
    return volts * (0.25 * sines if kind == "sines" else 0.5 + 0.08 * sines)


def motion(motor: RandomMotor, v: np.ndarray, load: np.ndarray, straight: bool, read_after: float) -> np.ndarray:
    """Current, speed, angle and charge from rest, (samples, 4), read after this share of each sample."""
    R, L, Kb, Kt, J, f = (motor.parameters[name] for name in SIX)
    # of current, speed, angle, charge, voltage, load and the slope of the voltage
    rates = np.zeros((7, 7))
    rates[0, [0, 1, 4]] = -R / L, -Kb / L, 1 / L
    rates[1, [0, 1, 5]] = Kt / J, -f / J, -1 / J
    rates[2, 1] = rates[3, 0] = rates[4, 6] = 1.0
    after, until_read = (expm(rates * share * motor.sample_time)[:4] for share in (1.0, read_after))
    rise = np.diff(v, append=v[-1]) / motor.sample_time * straight
    state, seen = np.zeros(4), np.zeros((len(v), 4))
    for k, inputs in enumerate(zip(v, load, rise, strict=True)):
        seen[k] = until_read @ np.concatenate([state, inputs])
        state = after @ np.concatenate([state, inputs])
    return seen


def log(motor: RandomMotor, way: str, lead: float, kind: str, loaded: bool, rng: np.random.Generator) -> Recording:
    """One run, with this kind of log; between samples the voltage acts this share of one earlier than recorded."""
    samples = int(np.clip(rng.uniform(20, 60) * motor.time_constant_s / motor.sample_time, 600, 8000))
    time = motor.sample_time * np.arange(samples)
    fine = motor._replace(sample_time=motor.sample_time / FINE)
    v_fine = voltage(kind, motor, fine.sample_time * np.arange(FINE * samples), rng)
    v = v_fine[::FINE]
    torque = motor.parameters["Kt"] * motor.amperes * rng.uniform(0.3, 0.7)
    load = torque * loaded * (np.sin(19 * time / time[-1]) > 0)
    lead = {"between samples": lead, "acts late": -1.0}.get(way, 0.0)
    if way == "continuous" and kind not in STEPPED:
        seen = motion(fine, v_fine, np.repeat(load, FINE), straight=True, read_after=0.0)[::FINE]
    else:
        seen = motion(motor, v, load, "straight" in way, read_after=lead % 1)
    if way == "mean current":
        seen[:, 0] = np.diff(seen[:, 3], prepend=0.0) / motor.sample_time
    noise = np.array([motor.amperes, motor.speed]) * 10 ** rng.uniform([-3.3, -3.7], [-1.7, -2.0])
    current, speed = (seen[:, :2] + noise * rng.standard_normal((samples, 2))).T
    if "counted" in way:
        count = 2 * np.pi / LINES
        speed = np.diff(count * np.round(seen[:, 2] / count), prepend=0.0) / motor.sample_time
    before, after = slice(None, -1), slice(1, None)
    driven = after if lead < 0 else before
    measured = after if way == "recorded late" else before
    return Recording(kind, time[before], v[driven], current[measured], speed[measured], load[before])


def errors(seed: int, way: str) -> tuple[float, float]:
    """The largest error of the identified parameters in standard errors, and of those but f in per cent."""
    rng = np.random.default_rng(seed)
    motor = random_motor(rng)
    loaded = rng.random() < 2 / 3
    kinds, lead = rng.choice(EXCITATIONS, 3, replace=False), rng.uniform(-1, 1)
    runs = [log(motor, way, lead, kind, loaded and kind == kinds[1], rng) for kind in kinds]
    found = {n: e for n, e in identify(runs).parameters.items() if e.status == "identified"}
    error = {name: e.value - motor.parameters[name] for name, e in found.items()}
    return (
        max(abs(error[name]) / e.stderr for name, e in found.items()),
        max(100 * abs(error[name]) / motor.parameters[name] for name in found if name != "f"),
    )


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=10)
    parser.add_argument("--first", type=int, default=2000, help="seed of the first motor")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.motors)
    progress = Console(stderr=True)
    found = {(seed, way): errors(seed, way) for seed in track(seeds, console=progress, transient=True) for way in WAYS}
    shown = Table("motor", *WAYS, title="Largest error in standard errors (and in %, but for f)")
    for seed in seeds:
        cells = (found[seed, way] for way in WAYS)
        shown.add_row(str(seed), *(f"{sure:.1f} ({percent:.2f})" for sure, percent in cells))
    medians = (np.median([found[seed, way] for seed in seeds], axis=0) for way in WAYS)
    shown.add_row("median", *(f"{sure:.1f} ({percent:.2f})" for sure, percent in medians))
    Console(width=140).print(shown)


if __name__ == "__main__":
    main()
