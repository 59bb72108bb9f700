"""Cases by seed: a motor about the paper's, its hidden effects, runs and noise.

The suites:

    singles       each effect at clear strength; white, coloured (two correlation times), quantised noise
    strengths     each effect from 0.3 to 20 times its smallest detectable amplitude
    nulls         no effect, the four kinds of noise
    pairs         two effects at clear strength, the four kinds of noise
    formulas      an effect with another formula than the library's: the same name is expected
    outside       an effect outside the library: not_in_library or ambiguous is expected
    blind         excitation that cannot distinguish effects: only an asserted wrong name is a mistake
    noise_sweep   each effect with noise of 0.1, 0.5, 1, 2.5, 5 % of the spread of each signal
    rough         singles with PWM, an uneven clock, and different noise in every run
    foreign       no effect or one, in motors, drives and sensors of all kinds (see `foreign`)
    foreign_pairs two effects in those

Two sets of seeds: methods are tuned on `tuning`, results are reported on `report`. Both were fixed
before anything was tuned. Case k of a suite does not depend on what other cases are run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks import virtual_bench as vb
from benchmarks.naming import foreign
from benchmarks.naming.excitations import BLIND, HOLDOUT, Excitations, jittered, standard
from benchmarks.naming.hidden import FORMULAS, LIBRARY, NAMES, STRANGERS, Hidden, Parameters, log_uniform
from benchmarks.naming.plant import Plant, ornstein_uhlenbeck, simulate, substeps
from benchmarks.naming.strength import Gauge, Outputs, Response, amplitude_for, linear
from benchmarks.virtual_bench import Columns, Excitation, Noise

SETS = {"tuning": 20_251, "report": 70_912}
NOISES = ("white", "coloured_fast", "coloured_slow", "quantised")
SWEEP_PERCENT = (0.1, 0.5, 1.0, 2.5, 5.0)
VISIBLE = (0.3, 0.6, 1.0, 1.5, 2.5, 5.0, 10.0, 20.0)
# range of the baseline residual over noise; at least 1.3 in fact, for amplitudes are set approximately
CLEAR = (1.45, 20.0)
UNLOADED = {"load_torque_Nm": 0.0}


@dataclass(frozen=True)
class Case:
    """One case: the data for a method, and the truth.

    `expected` is the right answer: "named", "none_detected", "outside" (then not_in_library or
    ambiguous), or "blind" (then anything but a wrong name). `effects` are the true parameters by
    name; an effect outside the library is in `stranger` instead. `response` measures its strength.
    """

    suite: str
    index: int
    noise: str
    detail: str
    expected: str
    motor: Mapping[str, float]
    effects: Mapping[str, Parameters]
    stranger: Mapping[str, Parameters]
    response: Response | None
    runs: Mapping[str, Columns] = field(repr=False)
    holdout: Mapping[str, Columns] = field(repr=False)
    load_known: bool = True

    @property
    def key(self) -> str:
        """A name for this case, unique within its set of seeds."""
        return f"{self.suite}/{self.index}"


@dataclass(frozen=True)
class Bench:
    """How the runs are recorded: noise of sensors and torque by run, PWM, an uneven clock.

    Sensors may have noise on the voltage, round voltage and current, count the lines of an encoder, or read the angle
    by lines and no speed.
    """

    noises: Mapping[str, Noise]
    pwm_Hz: float = 0.0
    jitter: float = 0.0
    voltage_V: float = 0.0
    voltage_quantum_V: float = 0.0
    current_quantum_A: float = 0.0
    encoder_lines: float = 0.0
    angle_lines: float = 0.0


# ---------------------------------------------------------------------------------------- recording


def _disturbance(rng: Generator, samples: int, steps: int, dt: float, noise: Noise):
    """Coloured torque for every fine step (N m), or None."""
    if not noise.torque_Nm:
        return None
    torque = rng.standard_normal((samples, steps))
    ornstein_uhlenbeck(torque, math.exp(-dt / steps / noise.torque_correlation_s), noise.torque_Nm)
    return torque


def _begin(plant: Plant, rng: Generator) -> tuple[Plant, dict[str, float]]:
    """A random start of a run: anywhere in the turn, in the backlash and in the cycle of an external torque."""
    angle, twist, phase = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-0.5, 0.5), rng.uniform()
    later = plant._replace(shake_phase=plant.shake_phase + 2.0 * math.pi * phase)
    return later, {"angle": angle, "twist": twist * plant.gap_rad}


def record(plant: Plant, excitation: Excitation, rng: Generator, noise: Noise, bench: Bench):
    """Simulate the motor and measure."""
    plant, start = _begin(plant._replace(pwm_Hz=bench.pwm_Hz), rng)
    excitation = jittered(excitation, rng, bench.jitter)
    dt = float(np.median(np.diff(excitation.time)))
    steps, samples = substeps(plant, dt), excitation.time.size
    disturbance = _disturbance(rng, samples, steps, dt, noise)
    read = simulate(plant, *excitation, disturbance=disturbance, **start)
    current = read[:, 0] + noise.current_A * rng.standard_normal(samples)
    speed = read[:, 1] + noise.speed_rad_s * rng.standard_normal(samples)
    speed = _rounded(speed, noise.speed_quantum_rad_s)
    if bench.encoder_lines:
        speed = _counted(excitation.time, read[:, 2], bench.encoder_lines)
    voltage = excitation.voltage
    if bench.voltage_V:
        voltage = voltage + bench.voltage_V * rng.standard_normal(samples)
    motion = {"speed_rad_s": speed}
    if bench.angle_lines:
        motion = {"angle_rad": _rounded(read[:, 2], 2 * math.pi / bench.angle_lines)}
    return {
        "time_s": excitation.time,
        "voltage_V": _rounded(voltage, bench.voltage_quantum_V),
        "current_A": _rounded(current, bench.current_quantum_A),
        **motion,
        "load_torque_Nm": excitation.load,
    }


def _rounded(values, quantum: float):
    return quantum * np.round(values / quantum) if quantum else values


def _counted(time, angle, lines: float):
    """The speed by the count of lines from the last to the next sample."""
    count = np.floor(angle * lines / (2 * math.pi))
    return np.gradient(count, time) * 2 * math.pi / lines


def drawn_noise(rng: Generator, kind: str) -> Noise:
    """Noise of sensors within a factor of two of the usual, and further noise by kind."""
    current, speed = log_uniform(rng, 0.05, 0.2), log_uniform(rng, 0.25, 1.0)
    torque, quantum = log_uniform(rng, 0.003, 0.02), log_uniform(rng, 0.5, 3.0)
    if kind == "quantised":
        return Noise(current, 0.2 * speed, speed_quantum_rad_s=quantum)
    if kind == "white":
        return Noise(current, speed)
    memory = {"coloured_fast": 0.02, "coloured_slow": 0.2}[kind]
    return Noise(current, speed, torque_Nm=torque, torque_correlation_s=memory)


def noise_levels(plant: Plant, noise: Noise) -> tuple[float, float]:
    """Standard deviation of current and speed noise, torque noise as the linear motor passes it."""
    shaken = np.zeros((1, 2))
    if noise.torque_Nm:
        dt, n = 1e-3, 20_000
        rng = np.random.default_rng(0)
        torque = _disturbance(rng, n, 1, dt, noise)[:, 0]
        shaken = linear(plant, Excitation(np.arange(n) * dt, 0.0 * torque, torque))
    sensors = (noise.current_A, math.hypot(noise.speed_rad_s, noise.speed_quantum_rad_s / 12**0.5))
    current, speed = (math.hypot(s, float(m)) for s, m in zip(sensors, shaken.std(0), strict=True))
    return current, speed


# ---------------------------------------------------------------------------------------- strength


def _ideal(plant: Plant, excitations: Excitations) -> list[Outputs]:
    """Noise-free current and speed of every run but the hold-out, in fewer fine steps."""
    runs = [e for name, e in excitations.items() if name != HOLDOUT]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda e: simulate(plant, *e, least=5)[:, :2], runs))


@dataclass(frozen=True)
class Tuner:
    """Sets the amplitudes of hidden effects in one motor with given excitations and noise."""

    plant: Plant
    excitations: Excitations
    noise: tuple[float, float]

    def __post_init__(self):
        """Simulate the reference of all responses once."""
        training = {n: e for n, e in self.excitations.items() if n != HOLDOUT}
        object.__setattr__(self, "gauge", Gauge(self.plant, training, self.noise))
        object.__setattr__(self, "without", _ideal(self.plant, self.excitations))

    def response(self, plant: Plant) -> Response:
        """How much the outputs of the plant differ from those without effects."""
        pairs = zip(_ideal(plant, self.excitations), self.without, strict=True)
        return self.gauge([a - b for a, b in pairs])

    def tuned(self, hidden: Hidden, rng: Generator, wanted: float, of: Callable[[Response], float]) -> Parameters:
        """Parameters drawn at random, at the amplitude that makes `of` the response `wanted`."""
        drawn = hidden.draw(rng, self.plant)

        def measure(factor: float) -> float:
            return of(self.response(hidden.put_into(self.plant, hidden.at(drawn, factor))))

        return hidden.at(drawn, amplitude_for(wanted, measure, hidden.limits))


def _peak(response: Response) -> float:
    return response.peak


def _visible(response: Response) -> float:
    return response.visible


def _clear(rng: Generator, low: float = CLEAR[0], high: float = CLEAR[1]) -> float:
    """A peak response that makes the baseline residual between low and high times the noise."""
    return math.sqrt(log_uniform(rng, low, high) ** 2 - 1.0)


# ----------------------------------------------------------------------------------------- building


@dataclass(frozen=True)
class Plan:
    """The specification of one case: noise, excitation, and amplitudes of hidden effects."""

    noise: str
    expected: str
    hidden: tuple[Hidden, ...] = ()
    wanted: tuple[float, ...] = ()
    of: Callable[[Response], float] = _peak
    detail: str = ""
    drive: Callable[[Generator], Excitations] = standard
    percent: float | None = None  # noise in % of each signal, instead of random noise
    rough: bool = False
    load_known: bool = True
    plant: Plant | None = None  # instead of one about the paper's
    noises: Noise | None = None  # instead of a random one
    sensors: Mapping[str, float] = field(default_factory=dict)  # fields of `Bench`


def drawn_plant(rng: Generator) -> Plant:
    """A motor log-normally about the paper's Table 1, 25 % each."""
    motor = vb.drawn_motor(rng)
    return Plant(*(getattr(motor, name) for name in vb.SIX))


def _typical(bench: Bench) -> Noise:
    """The noise of all runs together, as root mean squares."""

    def mean(name: str) -> float:
        return math.sqrt(np.mean([getattr(n, name) ** 2 for n in bench.noises.values()]))

    some = next(iter(bench.noises.values()))
    return replace(some, current_A=mean("current_A"), speed_rad_s=mean("speed_rad_s"))


def _spread(outputs: list[Outputs]) -> tuple[float, float]:
    current, speed = np.concatenate(outputs).std(0)
    return float(current), float(speed)


def _bench(plan: Plan, rng: Generator, plant: Plant, excitations: Excitations) -> Bench:
    """The noise of every run, and how it is recorded."""
    if plan.percent is not None:
        current, speed = _spread(_ideal(plant, excitations))
        share = plan.percent / 100.0
        return Bench(dict.fromkeys(excitations, Noise(share * current, share * speed)))
    noise = plan.noises or drawn_noise(rng, plan.noise)
    if not plan.rough:
        return Bench(dict.fromkeys(excitations, noise), **plan.sensors)
    noises = {
        name: replace(noise, current_A=noise.current_A * c, speed_rad_s=noise.speed_rad_s * s)
        for name in excitations
        for c, s in [np.exp(0.4 * rng.standard_normal(2))]
    }
    return Bench(noises, pwm_Hz=float(rng.choice([2000.0, 4000.0])), jitter=0.05)


def build(suite: str, index: int, plan: Plan, rng: Generator) -> Case:
    """Draw the motor, set the amplitudes, run and measure."""
    plant = plan.plant or drawn_plant(rng)
    excitations = plan.drive(rng)
    bench = _bench(plan, rng, plant, excitations)
    levels = noise_levels(plant, _typical(bench))
    drawn: list[Parameters] = []
    complete, response = plant, None
    if plan.hidden:
        tuner = Tuner(plant, excitations, levels)
        for hidden, wanted in zip(plan.hidden, plan.wanted, strict=True):
            drawn.append(tuner.tuned(hidden, rng, wanted, plan.of))
            complete = hidden.put_into(complete, drawn[-1])
        response = tuner.response(complete)
    records = {name: record(complete, e, rng, bench.noises[name], bench) for name, e in excitations.items()}
    if not plan.load_known:
        records = {n: {k: c[k] for k in c if k not in UNLOADED} for n, c in records.items()}
    found = list(zip(plan.hidden, drawn, strict=True))
    return Case(
        suite=suite,
        index=index,
        noise=plan.noise,
        detail=plan.detail,
        expected=plan.expected,
        motor={name: getattr(plant, name) for name in vb.SIX},
        effects={h.name: p for h, p in found if h.name},
        stranger={h.label: p for h, p in found if not h.name},
        response=response,
        runs={n: c for n, c in records.items() if n != HOLDOUT},
        holdout={HOLDOUT: records[HOLDOUT]},
        load_known=plan.load_known,
    )


# ------------------------------------------------------------------------------------------- suites


def _cycled(values, index: int):
    """The value at this index when cycling through them, and the number of complete cycles before."""
    values = tuple(values)
    return values[index % len(values)], index // len(values)


def _single(index: int, rng: Generator) -> Plan:
    name, turn = _cycled(NAMES, index)
    noise, _ = _cycled(NOISES, turn)
    return Plan(noise, "named", (LIBRARY[name],), (_clear(rng),), detail=name)


def _strength(index: int, rng: Generator) -> Plan:
    name, turn = _cycled(NAMES, index)
    visible, turn = _cycled(VISIBLE, turn)
    noise, _ = _cycled(("white", "coloured_fast"), turn)
    detail = f"{name} x{visible:g}"
    return Plan(noise, "named", (LIBRARY[name],), (visible,), _visible, detail)


def _null(index: int, rng: Generator) -> Plan:
    return Plan(_cycled(NOISES, index)[0], "none_detected")


# pairs that are not two effects: one contains or replaces the other, or both are the same spring
NO_PAIRS = (
    {"coulomb_friction", "stribeck_friction"},
    {"coulomb_friction", "asymmetric_friction"},
    {"stribeck_friction", "asymmetric_friction"},
    {"constant_load", "asymmetric_friction"},
    {"shaft_compliance", "gear_backlash"},
)


def _two_names(rng: Generator) -> tuple[str, ...]:
    while True:
        names = tuple(rng.choice(NAMES, 2, replace=False).tolist())
        if set(names) not in NO_PAIRS:
            return names


def _pair(index: int, rng: Generator) -> Plan:
    noise, _ = _cycled(NOISES, index)
    names = _two_names(rng)
    wanted = tuple(_clear(rng, 1.5, 8.0) for _ in names)
    hidden = tuple(LIBRARY[n] for n in names)
    return Plan(noise, "named", hidden, wanted, detail=" + ".join(names))


def _formula(index: int, rng: Generator) -> Plan:
    label, turn = _cycled(FORMULAS, index)
    noise, _ = _cycled(NOISES, turn)
    return Plan(noise, "named", (FORMULAS[label],), (_clear(rng, CLEAR[0], 10.0),), detail=label)


def _outside(index: int, rng: Generator) -> Plan:
    label, turn = _cycled(STRANGERS, index)
    noise, _ = _cycled(NOISES, turn)
    return Plan(noise, "outside", (STRANGERS[label],), (_clear(rng, CLEAR[0], 10.0),), detail=label)


_BLIND_ROWS = tuple((label, drive, name) for label, (drive, names) in BLIND.items() for name in names)


def _blind(index: int, rng: Generator) -> Plan:
    (label, drive, name), turn = _cycled(_BLIND_ROWS, index)
    noise, _ = _cycled(NOISES, turn)
    detail, hidden = f"{label}: {name}", (LIBRARY[name],)
    return Plan(noise, "blind", hidden, (_clear(rng, 1.1, 5.0),), detail=detail, drive=drive)


def _noise_sweep(index: int, rng: Generator) -> Plan:
    percent, turn = _cycled(SWEEP_PERCENT, index)
    name, _ = _cycled(NAMES, turn)
    share = 100.0 * log_uniform(rng, 0.01, 0.05) / percent  # of the signal, in noise
    detail = f"{name} {percent:g} %"
    return Plan("white", "named", (LIBRARY[name],), (share,), detail=detail, percent=percent)


def _rough(index: int, rng: Generator) -> Plan:
    return replace(_single(index, rng), rough=True)


def _foreign(index: int, rng: Generator) -> Plan:
    name, turn = _cycled((None, *NAMES), index)
    kind, _ = _cycled(foreign.SENSORS, index + turn)
    return _in_foreign(rng, kind, (name,) if name else ())


def _foreign_pair(index: int, rng: Generator) -> Plan:
    kind, _ = _cycled(foreign.SENSORS, index)
    return _in_foreign(rng, kind, _two_names(rng))


def _in_foreign(rng: Generator, kind: str, names: tuple[str, ...]) -> Plan:
    """Effects in a foreign motor with a kind of sensors, or with ordinary ones if the effects need them."""
    if kind in foreign.WITHOUT_SPEED_SENSOR and set(names) & set(foreign.OF_SPEED_SENSOR):
        kind = foreign.SENSORS[0]
    plant = foreign.motor(rng)
    excited = foreign.excitations(rng, plant, kind)
    return Plan(
        kind,
        "named" if names else "none_detected",
        tuple(foreign.EFFECTS[name] for name in names),
        tuple(_clear(rng, 2.0, 8.0) for _ in names),
        detail=" + ".join(names),
        drive=lambda rng: excited,
        plant=plant,
        noises=foreign.noise(rng, plant, kind),
        sensors=foreign.sensors(kind, plant, excited[HOLDOUT]),
    )


SUITES: Mapping[str, Callable[[int, Generator], Plan]] = {
    "singles": _single,
    "strengths": _strength,
    "nulls": _null,
    "pairs": _pair,
    "formulas": _formula,
    "outside": _outside,
    "blind": _blind,
    "noise_sweep": _noise_sweep,
    "rough": _rough,
    "foreign": _foreign,
    "foreign_pairs": _foreign_pair,
}


def case(suite: str, index: int, seeds: str = "tuning") -> Case:
    """Case `index` of a suite."""
    rng = np.random.default_rng([SETS[seeds], list(SUITES).index(suite), index])
    return build(suite, index, SUITES[suite](index, rng), rng)


def dump(made: Case, folder: Path) -> None:
    """Write the runs and the hold-out as CSV files, for the command line."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, columns in (*made.runs.items(), *made.holdout.items()):
        vb.write_csv(folder / f"{name}.csv", columns)
