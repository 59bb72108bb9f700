"""Baseline: sparse regression on the equations (SINDy), with pysindy's STLSQ.

    di/dt = a v + b i + c w + electrical terms,      dw/dt = d i + e w + g T_load + mechanical terms

Both are integrated over short windows, so that noise is not differentiated and steps of the
voltage cause no errors (the weak form); the angle is the integral of the speed. Every term is scaled
to unit size, so that one threshold applies to all. Effects without a term in an equation of the
motor alone (lag, delay, compliant shaft, backlash) cannot be named. S. Brunton, J. Proctor, J. N. Kutz, PNAS
113 (2016) 3932, doi:10.1073/pnas.1517384113.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.virtual_bench import Columns

Runs = Mapping[str, Columns]
Terms = dict[str, NDArray[np.float64]]
THRESHOLD = 0.01  # of the spread of the change
WINDOW = 10  # samples over which the equations are integrated
WARMING_S = 2.0
PERIODS = range(1, 13)


def _held(x: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Integral over windows of a signal that is held between samples."""
    total = np.concatenate([[0.0], np.cumsum(x) * dt])
    return (total[WINDOW:] - total[:-WINDOW])[:-1]


def _integral(x: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Integral over windows of a smooth signal, by the trapezoidal rule."""
    return _held(0.5 * (x + np.append(x[1:], x[-1])), dt)


def _change(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return x[WINDOW:] - x[:-WINDOW]


def terms(c: Columns) -> tuple[Terms, Terms]:
    """Columns of the electrical and of the mechanical equation; `name:part` belongs to an effect.

    The column `change` is the regressand: the change of current or speed in a window.
    """
    dt = float(np.median(np.diff(c["time_s"])))
    v, i, w = c["voltage_V"], c["current_A"], c["speed_rad_s"]
    load, one = c.get("load_torque_Nm", np.zeros_like(i)), np.ones_like(i)
    angle, share = np.cumsum(w) * dt, dt / WARMING_S
    warmth = lfilter([share], [1.0, share - 1.0], i**2)
    smooth = {"i": i, "w": w}
    electrical = {"current_sensor_offset": one, "brush_voltage_drop": np.sign(i), "resistance_heating": warmth * i}
    mechanical = {
        "constant_load": one,
        "coulomb_friction": np.sign(w),
        "stribeck_friction": np.sign(w) * np.exp(-((w / 10.0) ** 2)),
        "quadratic_drag": w * np.abs(w),
        "torque_constant_saturation": i**3,
    }
    for n in PERIODS:
        for part, wave in (("sin", np.sin(n * angle)), ("cos", np.cos(n * angle))):
            mechanical[f"cogging_torque:{part}{n}"] = wave
            mechanical[f"torque_ripple:{part}{n}"] = wave * i

    def integrated(columns: Terms) -> Terms:
        return {name: _integral(column, dt) for name, column in columns.items()}

    volts = {"v": _held(v, dt), "input_dead_zone": _held(np.sign(v), dt)}
    stored = {"change": _change(i), "inductance_saturation": _change(i**3)}
    pushed = {"change": _change(w), "load": _held(load, dt)}
    return stored | volts | integrated(smooth | electrical), pushed | integrated(smooth | mechanical)


def selected(equations: list[Terms]) -> dict[str, float]:
    """Effects of one equation, over all runs, with the largest scaled coefficient of each."""
    import pysindy

    joint = {n: np.concatenate([e[n] for e in equations]) for n in equations[0]}
    change = joint.pop("change")
    # load columns are zero if no run has a load
    joint = {n: c for n, c in joint.items() if np.any(c)}
    spread = np.array([np.sqrt(np.mean(c**2)) for c in joint.values()])
    matrix = np.column_stack(list(joint.values())) / spread
    target = (change / change.std())[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optimizer = pysindy.STLSQ(threshold=THRESHOLD, alpha=1e-6).fit(matrix, target)
    found: dict[str, float] = {}
    for name, size in zip(joint, np.abs(np.ravel(optimizer.coef_)), strict=True):
        effect = name.split(":")[0]
        if size > 0 and "_" in effect:
            found[effect] = max(found.get(effect, 0.0), float(size))
    return found


def sparse(runs: Runs, holdout: Runs) -> dict[str, Any]:
    """The answer, as `pmdc diagnose --json` writes it; no parameters and no hold-out."""
    pairs = [terms(c) for c in runs.values()]
    found = selected([e for e, _ in pairs]) | selected([m for _, m in pairs])
    effects = [{"name": name, "parameters": {}, "also_possible": []} for name in sorted(found, key=lambda n: -found[n])]
    return {"verdict": "named" if effects else "none_detected", "effects": effects}
