"""Baseline: stepwise selection as a careful engineer would write it by hand.

Forward selection with swaps by BIC, white noise assumed; every promising effect is refitted with all
constants of the motor in full nonlinear simulation (Levenberg-Marquardt, finite differences). It
has the formulas and the integrator of the generator of the data, an advantage no method has in
practice. Candidates of a round are ranked by one linear step from the current model, with shapes
on a grid, and the best few are refitted. The initial angle of each run is fitted too.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.naming.hidden import LIBRARY, Parameters
from benchmarks.naming.plant import Plant, simulate
from benchmarks.virtual_bench import SIX, Columns, paper_motor

Runs = Mapping[str, Columns]
REFITTED = 4  # candidates of each round
MIN_GAIN = 6.0  # chi-square by the linear step; BIC requires about eleven per parameter
MAX_EFFECTS = 3
SIGNED = {("constant_load", "torque_Nm"), ("current_sensor_offset", "offset_A")}
ANGLE = ("cogging_torque", "torque_ripple")


def _spring(hertz: float, damped: float = 0.1) -> Parameters:
    """A shaft with this resonance between two halves of the paper's inertia."""
    reduced, speed = 0.25 * paper_motor().J, 2.0 * math.pi * hertz
    damping = 2.0 * damped * reduced * speed
    return {"stiffness": reduced * speed**2, "damping": damping, "load_share": 0.5}


def _periodic(name: str, size: float) -> list[Parameters]:
    return [{name: size, "periods": float(n), "phase": phase} for n in range(1, 13) for phase in (0.0, 0.5 * math.pi)]


# the starts of each effect: its shapes at a small amplitude
STARTS: Mapping[str, list[Parameters]] = {
    "coulomb_friction": [{"torque_Nm": 0.01}],
    "stribeck_friction": [{"coulomb_Nm": 0.01, "static_Nm": 0.02, "speed_rad_s": speed} for speed in (5.0, 15.0)],
    "asymmetric_friction": [{"forward_Nm": 0.01, "backward_Nm": 0.02}, {"forward_Nm": 0.02, "backward_Nm": 0.01}],
    "quadratic_drag": [{"drag": 2e-7}],
    "cogging_torque": _periodic("amplitude_Nm", 0.01),
    "torque_ripple": _periodic("amplitude", 0.01),
    "constant_load": [{"torque_Nm": 0.01}],
    "shaft_compliance": [_spring(hertz) for hertz in (20.0, 45.0, 90.0)],
    "gear_backlash": [_spring(150.0, 0.4) | {"gap_rad": gap} for gap in (0.01, 0.05)],
    "brush_voltage_drop": [{"voltage_V": 0.05}],
    "resistance_heating": [{"rise_per_W": 1e-4, "time_constant_s": tau} for tau in (1.0, 4.0)],
    "torque_constant_saturation": [{"saturation": 2e-6}],
    "inductance_saturation": [{"saturation": 2e-5}],
    "input_dead_zone": [{"width_V": 0.05}],
    "speed_sensor_lag": [{"time_constant_s": 1e-3}],
    "speed_sensor_delay": [{"delay_s": 5e-4}],
    "current_sensor_offset": [{"offset_A": 0.1}],
}
FIXED = {"periods", "phase"}  # an integer; and runs have initial angles of their own


@dataclass
class Model:
    """A plant with effects, and the initial angle of each run."""

    base: dict[str, float]
    effects: dict[str, Parameters]
    angles: NDArray[np.float64]
    residual: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    bic: float = math.inf
    stderr: dict[tuple[str, str], float] = field(default_factory=dict)

    def plant(self) -> Plant:
        """All constants together."""
        plant = Plant(**self.base)
        for name, parameters in self.effects.items():
            plant = LIBRARY[name].put_into(plant, parameters)
        return plant

    def free(self) -> list[tuple[str, str]]:
        """(effect, parameter) of everything that is fitted; the motor is the effect ''."""
        found = [("", name) for name in SIX]
        for name, parameters in self.effects.items():
            found += [(name, p) for p in parameters if p not in FIXED]
        return found

    def moved(self, key: tuple[str, str], by: float) -> Model:
        """One parameter changed: relatively, or for signed ones by a share of a typical size."""
        effect, name = key
        if not effect:
            return replace(self, base=self.base | {name: self.base[name] * math.exp(by)})
        old = self.effects[effect][name]
        typical = abs(STARTS[effect][0][name])
        new = old + by * typical if key in SIGNED else old * math.exp(by)
        if name == "load_share":
            new = min(new, 0.95)
        return replace(self, effects=self.effects | {effect: self.effects[effect] | {name: new}})


def rough_noise(measured: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """From third differences, in which a smooth signal vanishes; the median is robust to steps."""
    steps = np.concatenate([np.diff(m, 3, axis=0) for m in measured])
    return np.maximum(np.median(np.abs(steps), axis=0) / 0.6745 / math.sqrt(20.0), 1e-3)


class Bench:
    """The recordings, and residuals of models relative to white noise of unknown size."""

    def __init__(self, runs: Runs, noise: NDArray[np.float64] | None = None):
        self.runs = list(runs.values())
        self.measured = [np.column_stack([c["current_A"], c["speed_rad_s"]]) for c in self.runs]
        self.samples = [len(m) for m in self.measured]
        self.noise = rough_noise(self.measured) if noise is None else noise

    def _one(self, job: tuple[Plant, Columns, float, NDArray]) -> NDArray[np.float64]:
        plant, c, angle, measured = job
        load = c.get("load_torque_Nm", np.zeros_like(c["time_s"]))
        columns = (c["time_s"], c["voltage_V"], load)
        # teeth are stiffer than the winding
        steps = 8 if plant.gap_rad else 2
        start = {"speed": float(measured[:3, 1].mean()), "current": float(measured[0, 0])}
        if abs(start["speed"]) < 5.0 * self.noise[1]:
            start = {}  # at rest
        out = simulate(plant, *columns, angle=angle, steps=steps, **start)
        return (measured - out[:, :2]) / self.noise

    def residual(self, model: Model) -> NDArray[np.float64]:
        """Measured minus simulated over noise, of all runs and both channels, flattened."""
        plant = model.plant()
        jobs = [(plant, c, angle, m) for c, angle, m in zip(self.runs, model.angles, self.measured, strict=True)]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            flat = np.concatenate([r.ravel() for r in pool.map(self._one, jobs)])
        return np.clip(np.nan_to_num(flat, nan=1e6), -1e6, 1e6)

    def bic(self, residual: NDArray[np.float64], parameters: int) -> float:
        """Bayesian information criterion for white noise of unknown variance in each channel."""
        channels = residual.reshape(-1, 2)
        n = len(channels)
        return n * float(np.log((channels**2).mean(0)).sum()) + parameters * math.log(2 * n)

    def by_run(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """One column for each run, zero in the others."""
        blocks = np.zeros((column.size, len(self.samples)))
        edges = 2 * np.cumsum([0, *self.samples])
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            blocks[a:b, k] = column[a:b]
        return blocks


# ------------------------------------------------------------------------------------------ fitting


def _turns(model: Model) -> bool:
    return any(name in model.effects for name in ANGLE)


def jacobian(bench: Bench, model: Model) -> NDArray[np.float64]:
    """Columns of the residual's derivatives: free parameters, then each run's angle."""
    step = 1e-4
    columns = [(bench.residual(model.moved(k, step)) - model.residual) / step for k in model.free()]
    if _turns(model):
        turned = replace(model, angles=model.angles + step)
        column = (bench.residual(turned) - model.residual) / step
        return np.column_stack([*columns, bench.by_run(column)])
    return np.column_stack(columns)


def _stepped(bench: Bench, model: Model, by: NDArray[np.float64]) -> Model:
    free = model.free()
    for key, change in zip(free, by, strict=False):
        model = model.moved(key, float(np.clip(change, -1.0, 1.0)) if key not in SIGNED else change)
    turned = by[len(free) :]
    model = replace(model, angles=model.angles + turned if turned.size else model.angles)
    return replace(model, residual=bench.residual(model))


def fit(bench: Bench, model: Model, steps: int = 8) -> Model:
    """Levenberg-Marquardt; the model with its residual, BIC and standard errors."""
    model = replace(model, residual=bench.residual(model))
    damping, cost = 1e-3, float(model.residual @ model.residual)
    for _ in range(steps):
        J = jacobian(bench, model)
        normal, gradient = J.T @ J, J.T @ model.residual
        gained = 0.0
        for _ in range(5):
            scaled = normal + np.diag(damping * np.diag(normal) + 1e-12)
            tried = _stepped(bench, model, -np.linalg.solve(scaled, gradient))
            gained = cost - float(tried.residual @ tried.residual)
            if gained > 0:
                model, cost, damping = tried, cost - gained, damping * 0.1
                break
            damping *= 10.0
        if gained < 0.5:
            break
    return _judged(bench, model)


def _judged(bench: Bench, model: Model) -> Model:
    J = jacobian(bench, model)
    variance = np.diag(np.linalg.pinv(J.T @ J)) * float(np.mean(model.residual**2))
    free = model.free()
    stderr = dict(zip(free, np.sqrt(np.abs(variance)), strict=False))
    return replace(model, bic=bench.bic(model.residual, J.shape[1]), stderr=stderr)


def baseline(bench: Bench) -> Model:
    """The motor without effects, fitted from the paper's."""
    base = {name: getattr(paper_motor(), name) for name in SIX}
    return fit(bench, Model(base, {}, np.zeros(len(bench.runs))), steps=40)


# ---------------------------------------------------------------------------------------- selecting


def _periods_pairs(name: str) -> Iterator[list[Parameters]]:
    """Starts that are judged together: sine and cosine of the same periods; others one by one."""
    starts = STARTS[name]
    yield from ((starts[k : k + 2] for k in range(0, len(starts), 2)) if name in ANGLE else ([s] for s in starts))


def screened(bench: Bench, model: Model) -> list[tuple[float, str, Model]]:
    """Every further effect at its start of largest gain, in order of the gain."""
    q, _ = np.linalg.qr(jacobian(bench, model))
    left = model.residual - q @ (q.T @ model.residual)

    def gain(name: str, starts: Sequence[Parameters]) -> tuple[float, Model]:
        tried = [replace(model, effects=model.effects | {name: s}) for s in starts]
        columns = [bench.residual(t) - model.residual for t in tried]
        if name in ANGLE:
            columns = [c for column in columns for c in bench.by_run(column).T]
        d = np.column_stack(columns)
        d -= q @ (q.T @ d)
        by, *_ = np.linalg.lstsq(d, -left, rcond=None)
        if name in ANGLE:
            return float(-left @ d @ by), _turned(tried[0], name, by)
        return float(-left @ d @ by), _sized(model, name, starts[0], float(by[0]))

    best = []
    for name in STARTS.keys() - model.effects.keys():
        found = [gain(name, starts) for starts in _periods_pairs(name)]
        best.append((*max(found, key=lambda g: g[0]), name))
    return sorted(((g, n, m) for g, m, n in best), key=lambda row: (-row[0], row[1]))


def _sized(model: Model, name: str, start: Parameters, size: float) -> Model:
    """The start at the amplitude of the linear step, within limits."""
    row = LIBRARY[name]
    signed = any((name, p) in SIGNED for p in start)
    size = size if signed else float(np.clip(size, 0.1, 100.0))
    if row.inverse or name == "gear_backlash":
        size = 1.0
    return replace(model, effects=model.effects | {name: row.at(start, size)})


def _turned(model: Model, name: str, by: NDArray[np.float64]) -> Model:
    """Amplitude and each run's angle from its sine and cosine parts (phase 0 and a quarter)."""
    sine, cosine = np.split(by, 2)
    drawn = model.effects[name]
    size = float(np.clip(np.median(np.hypot(sine, cosine)), 0.1, 100.0))
    angles = np.arctan2(cosine, sine) / drawn["periods"]
    sized = LIBRARY[name].at(drawn, size)
    return replace(model, effects=model.effects | {name: sized}, angles=angles)


def forward(bench: Bench, model: Model) -> Model:
    """Add effects while the BIC falls."""
    while len(model.effects) < MAX_EFFECTS:
        starts = [start for gain, _, start in screened(bench, model)[:REFITTED] if gain > MIN_GAIN]
        best = min((fit(bench, start) for start in starts), key=lambda m: m.bic, default=model)
        if best.bic >= model.bic:
            break
        model = best
    return model


def swapped(bench: Bench, model: Model, bare: Model) -> Model:
    """Replace each effect in turn by the best others; keep replacements that lower the BIC."""
    for name in tuple(model.effects) if len(model.effects) > 1 else ():
        others = {n: p for n, p in model.effects.items() if n != name}
        less = fit(bench, replace(model, effects=others))
        tried = [fit(bench, start) for _, _, start in screened(bench, less)[:2]]
        model = min([model, less, *tried], key=lambda m: m.bic)
    return model if model.bic < bare.bic else bare


# ---------------------------------------------------------------------------------------- answering


def _parameters(model: Model, name: str) -> dict[str, Any]:
    def interval(parameter: str, value: float) -> list[float]:
        error = 1.96 * model.stderr.get((name, parameter), 0.0)
        if (name, parameter) in SIGNED:
            size = error * abs(STARTS[name][0][parameter])
            return [value - size, value + size]
        return [value * math.exp(-error), value * math.exp(min(error, 50.0))]

    return {p: {"value": v, "ci95": interval(p, v)} for p, v in model.effects[name].items() if p not in FIXED}


def _holdout_rms(holdout: Runs, noise: NDArray[np.float64], model: Model) -> float:
    """Residual over noise in the hold-outs, each from its best initial angle."""
    bench = Bench(holdout, noise)
    angles = np.linspace(0.0, 2.0 * np.pi, 48 if _turns(model) else 1, endpoint=False)
    tried = (replace(model, angles=np.full(len(bench.runs), a)) for a in angles)
    return min(float(np.sqrt(np.mean(bench.residual(t) ** 2))) for t in tried)


def stepwise(runs: Runs, holdout: Runs) -> dict[str, Any]:
    """The answer, as `pmdc diagnose --json` writes it."""
    bench = Bench(runs)
    bare = baseline(bench)
    model = swapped(bench, forward(bench, bare), bare)
    noise = bench.noise * np.sqrt((model.residual.reshape(-1, 2) ** 2).mean(0))
    gap = {"before": _holdout_rms(holdout, noise, bare), "after": _holdout_rms(holdout, noise, model), "floor": 1.0}
    effects = [{"name": name, "parameters": _parameters(model, name), "also_possible": []} for name in model.effects]
    verdict = "named" if effects else "none_detected"
    return {"verdict": verdict, "effects": effects, "gap": {"holdout": gap}}
