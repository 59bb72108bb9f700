"""Recordings held against the motor's equations: signs, units and clocks that cannot be right.

Integrated over a window of the record, the linear motor's equations hold exactly and need no
derivative of noisy data:

    mean v = R mean i + Kb mean w + L (i_end - i_start) / T
    T_load = Kt mean i - f mean w - J (w_end - w_start) / T
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .recording import Finding, Recording

MAX_WINDOWS = 4000
MIN_WINDOWS = 20
CLEAR = 3.0  # a term is seen when it moves the fit by this many residuals
RPM, DEGREES = 30 / np.pi, 180 / np.pi  # numbers per rad/s or rad
TOP_SPEED = 6000.0  # rad/s, 57,000 rpm: no brushed motor turns faster
KB_RANGE = (5e-5, 200.0)  # V s/rad, a factor of 20 beyond what is built
REACH = 20  # samples, the largest shift between channels that is tried
BEFORE, AFTER = 40, 100  # samples about a voltage edge


class Term(NamedTuple):
    """One coefficient of a regression; `clarity` is its effect over the residual, both rms."""

    value: float
    clarity: float

    @property
    def negative(self) -> bool:
        return self.value < 0 and self.clarity > CLEAR

    @property
    def positive(self) -> bool:
        return self.value > 0 and self.clarity > CLEAR


def signs(run: Recording) -> Iterator[Finding]:
    """Channels wired or defined the other way round."""
    for column, what in _reversed(run):
        mend = f"Turn the sign of the {column} column, or swap its wires"
        yield Finding(run.name, column, "warning", what, "whole run", mend)


def _reversed(run: Recording) -> Iterator[tuple[str, str]]:
    w = _windows(run)
    if run.drive == "voltage" and {"current", "speed"} <= set(w):
        fit, _ = regress(w["voltage"], {k: w[k] for k in ("current", "speed", "current_rate")})
        R, Kb = fit["current"], fit["speed"]
        if R.negative and Kb.negative:
            yield "voltage", "its sign is opposite to that of current and speed"
        elif Kb.negative and R.value > 0:
            yield "speed", "its sign is opposite to that of the voltage"
        elif R.negative and Kb.value > 0:
            yield "current", "its sign is opposite to that of the voltage"
    elif "speed" in w:
        # both outputs and drive known: inertia and back-EMF or friction have the same sign
        regressors = {k: w[k] for k in ("speed", "speed_rate", "direction", "load") if k in w}
        fit, explained = regress(w[run.drive], regressors)
        inertia, drag = fit["speed_rate"], fit["speed"]
        against = inertia.negative and drag.value < 0
        if run.drive != "voltage":
            against = inertia.negative
        if against and explained > 0.7:
            yield "speed", f"it falls where the {run.drive} should make it rise"


def angle_against_speed(run: Recording) -> Iterator[Finding]:
    """Speed that is not the derivative of the angle."""
    w = _windows(run)
    if "angle_rate" not in w or run.speed is None:
        return
    fit, explained = regress(w["angle_rate"], {"speed": w["speed"]})
    ratio = fit["speed"].value
    if explained < 0.98 or 0.9 < ratio < 1.1:
        return
    reasons = {
        1 / RPM: "as if the speed were in rpm",
        1 / DEGREES: "as if the speed were in deg/s",
        DEGREES: "as if the angle were in degrees",
        1 / (2 * np.pi): "as if the angle were in turns",
        -1.0: "as if one of them had the wrong sign",
    }
    why = next((why for k, why in reasons.items() if abs(ratio / k - 1) < 0.1), "")
    what = f"the angle changes {ratio:.4g} times as fast as the speed says {why}".strip()
    mend = "Correct the unit or the sign in the header or by --column"
    yield Finding(run.name, "angle", "warning", what, "whole run", mend)


def plain_units(runs: Sequence[Recording]) -> Iterator[Finding]:
    """Speeds in rpm or deg/s that pass as rad/s.

    In SI the torque constant equals that of the back-EMF. Kt shows where the load is known and
    varies, within a run or from run to run.
    """
    for run in runs:
        yield from _too_fast(run)
    loaded = [w for w in map(_windows, runs) if {"voltage", "current", "speed", "load"} <= set(w)]
    if not loaded:
        return
    w = {k: np.concatenate([one[k] for one in loaded]) for k in loaded[0] if k != "angle_rate"}
    electrical, _ = regress(w["voltage"], {k: w[k] for k in ("current", "speed", "current_rate")})
    torques = {k: w[k] for k in ("current", "speed", "speed_rate", "direction")}
    mechanical, explained = regress(w["load"], torques)
    Kb, Kt = electrical["speed"], mechanical["current"]
    names = ", ".join(run.name for run in runs if run.load is not None)
    if explained < 0.8 or not Kb.positive or not (Kt.positive or Kt.negative):
        return
    if Kt.negative:
        what = "the load rises where the current falls: its sign is reversed"
        mend = "A load that opposes positive motion is positive: turn the sign of the column"
        yield Finding(names, "load", "warning", what, "all loaded runs", mend)
    ratio = Kt.value / Kb.value
    for scale, unit in ((RPM, "rpm"), (DEGREES, "deg/s")):
        if 0.8 < ratio / scale < 1.25:
            what = f"Kt is {ratio:.3g} times Kb, as if the speed were in {unit}, not rad/s"
            mend = f"If it is, write [{unit}] into the header, or --column speed=HEADER:{unit}"
            yield Finding(names, "speed", "warning", what, "all loaded runs", mend)


def _too_fast(run: Recording) -> Iterator[Finding]:
    mend = "Check the unit: write [rpm] or [deg/s] into the header, or map it by --column"
    w = _windows(run)
    if "speed" not in w:
        return
    top = float(np.max(np.abs(w["speed"])))
    if top > TOP_SPEED:
        what = f"{top:.4g} rad/s is faster than brushed motors turn"
        yield Finding(run.name, "speed", "warning", what, "whole run", mend)
    elif {"voltage", "current"} <= set(w):
        fit, _ = regress(w["voltage"], {k: w[k] for k in ("current", "speed", "current_rate")})
        Kb = fit["speed"]
        if Kb.positive and not KB_RANGE[0] < Kb.value < KB_RANGE[1]:
            what = f"with the voltage it makes Kb = {Kb.value:.3g} V s/rad, unlike any motor"
            yield Finding(run.name, "speed", "warning", what, "whole run", mend)


def alignment(run: Recording) -> Iterator[Finding]:
    """Current or speed recorded later or earlier than the rest."""
    edge = _edges(run)
    if edge is None:
        return
    v, i, w = edge
    late = _best_shift(lambda s: _electrical_misfit(v, i, w, s))
    behind_speed = _best_shift(lambda s: _mechanical_misfit(i, w, s))
    mend = "Undo it in the data, or record all channels with one clock and one filter"
    if late and abs(late - behind_speed) < 2:
        column, what, shift = "current", "the current comes", late
    elif behind_speed and not late:
        column, what, shift = "speed", "the speed comes", -behind_speed
    elif late and not behind_speed:
        column, what, shift = "voltage", "current and speed come", late
    else:
        return
    when = "late" if shift > 0 else "early"
    size = f"{abs(shift)} samples ({abs(shift) * run.sample_time:.3g} s) {when}"
    yield Finding(run.name, column, "warning", f"{what} about {size}", "at voltage edges", mend)


def sampling(run: Recording) -> Iterator[Finding]:
    """Sampling too slow to see the current rise."""
    edge = _edges(run)
    if edge is None:
        return
    current = edge[1][BEFORE:] - edge[1][BEFORE]
    if abs(current[1]) > 0.9 * np.max(np.abs(current)):
        what = f"the current settles within one sample ({run.sample_time:.3g} s): L is hardly seen"
        mend = "Sample faster than L / R to identify the inductance"
        yield Finding(run.name, "current", "note", what, "at voltage edges", mend)


def regress(y: np.ndarray, regressors: Mapping[str, np.ndarray]) -> tuple[dict[str, Term], float]:
    """Least squares with an intercept.

    **Arguments**: `y` and each of `regressors`, (windows,).

    **Returns**: a `Term` for each regressor, and the share of the variance of y explained.
    """
    X = np.stack([x - x.mean() for x in regressors.values()], axis=1)
    rounding = 1e-9 * np.max(np.abs(y)) + 1e-300
    y = y - y.mean()
    scale = X.std(axis=0)
    scale[scale == 0] = np.inf  # a constant column has no effect
    coefficients, *_ = np.linalg.lstsq(X / scale, y, rcond=1e-8)
    residual = y - X / scale @ coefficients
    # rms of what only this regressor can explain
    own = 1 / np.sqrt(np.maximum(np.diag(np.linalg.pinv((X / scale).T @ X / scale)), 1e-300))
    own = np.where(np.isfinite(scale), own, 0.0) / np.sqrt(len(y))
    rms = np.sqrt(np.mean(residual**2)) + rounding
    terms = {
        name: Term(float(c / s), float(abs(c) * o / rms))
        for name, c, s, o in zip(regressors, coefficients, scale, own, strict=True)
    }
    return terms, float(1 - np.mean(residual**2) / (np.mean(y**2) + 1e-300))


def _windows(run: Recording) -> dict[str, np.ndarray]:
    """Means and rates over windows of the record, each (windows,); empty if there are too few.

    Keys: the quantities, `current_rate`, `speed_rate`, `angle_rate` and `direction`, the mean sign
    of the speed.
    """
    size = max(4, len(run) // MAX_WINDOWS)
    count = (len(run) - 1) // size
    ends = np.arange(count + 1) * size
    steps = np.diff(run.time[: ends[-1] + 1])
    length = np.diff(run.time[ends])

    def mean(values: np.ndarray) -> np.ndarray:
        return (values * steps).reshape(count, size).sum(1) / length

    def middle(values: np.ndarray) -> np.ndarray:
        return mean((values[1 : ends[-1] + 1] + values[: ends[-1]]) / 2)

    speed = _speed(run)
    found: dict[str, np.ndarray] = {}
    for name in ("voltage", "torque", "load"):  # held from sample to sample
        if (values := getattr(run, name)) is not None:
            found[name] = mean(values[: ends[-1]])
    for name, values in (("current", run.current), ("speed", speed)):
        if values is not None:
            found |= {name: middle(values), f"{name}_rate": np.diff(values[ends]) / length}
    if speed is not None:
        found["direction"] = middle(np.sign(speed))
    if run.angle is not None:
        found["angle_rate"] = np.diff(run.angle[ends]) / length
    good = (length < 1.5 * np.median(length)) & np.isfinite(sum(found.values()))
    return {k: values[good] for k, values in found.items()} if good.sum() >= MIN_WINDOWS else {}


def _speed(run: Recording) -> np.ndarray | None:
    if run.speed is None and run.angle is not None:
        return np.gradient(run.angle, run.time)
    return run.speed


def _edges(run: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Voltage, current and speed about an edge of the voltage, averaged over edges.

    The motor's equations are linear, so that such averages obey them, with less noise.

    **Returns**: three arrays (BEFORE + AFTER,), the edge first felt at BEFORE; None if there is no
    edge or a channel is absent.
    """
    speed = _speed(run)
    if run.voltage is None or run.current is None or speed is None:
        return None
    jumps = np.diff(run.voltage)
    rows = np.flatnonzero(np.abs(jumps) > 0.25 * np.ptp(run.voltage)) + 1
    rows = rows[(rows >= BEFORE) & (rows <= len(run) - AFTER)]
    rows = rows[:: len(rows) // 2000 + 1]
    about = rows[:, None] + np.arange(-BEFORE, AFTER)
    channels = np.stack([run.voltage[about], run.current[about], speed[about]])
    spans = run.time[rows + AFTER - 1] - run.time[rows - BEFORE]
    steady = spans < 1.1 * (BEFORE + AFTER - 1) * run.sample_time
    good = np.isfinite(channels).all((0, 2)) & steady
    if not good.any():
        return None
    weight = jumps[rows[good] - 1]
    v, i, w = np.einsum("e,cet->ct", weight, channels[:, good]) / np.sum(weight**2)
    return v, i, w


def _electrical_misfit(v: np.ndarray, i: np.ndarray, w: np.ndarray, shift: int) -> float:
    """What v = R i + Kb w + L di/dt leaves with current and speed taken `shift` samples later."""
    rows = np.arange(REACH, len(v) - REACH - 1)
    later = rows + shift
    # two neighbouring currents span R i + L di/dt for any ratio of L / R to the step
    return _misfit(v[rows], [i[later], i[later + 1], w[later]])


def _mechanical_misfit(i: np.ndarray, w: np.ndarray, shift: int) -> float:
    """What J dw/dt = Kt i - f w leaves with the current taken `shift` samples later."""
    rows = np.arange(REACH, len(w) - REACH - 1)
    later = rows + shift
    # integrated once, so that the noise of the speed is not differentiated
    pushes = [np.cumsum(i[later]), np.cumsum(i[later + 1]), np.cumsum(w[rows])]
    return _misfit(w[rows], [*pushes, rows.astype(float)])


def _misfit(y: np.ndarray, regressors: list[np.ndarray]) -> float:
    terms, explained = regress(y, dict(zip("abcd", regressors, strict=False)))
    del terms
    return float(np.sqrt(max(1 - explained, 0.0)))


def _best_shift(misfit) -> int:
    """The smallest shift with about the least misfit, if clearly better than none; else 0."""
    shifts = sorted(range(-REACH, REACH + 1), key=abs)
    left = {shift: misfit(shift) for shift in shifts}
    unshifted = min(left[-1], left[0], left[1])
    least = min(left.values())
    if unshifted < 0.01 or least > 0.3 * unshifted:
        return 0
    return next(shift for shift in shifts if left[shift] < 1.5 * least)
