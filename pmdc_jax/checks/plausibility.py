"""Checks of signs and units against the motor's equations.

Integrated over a window of the record, the linear motor's equations hold exactly and need no
derivative of noisy data:

    mean v = R mean i + Kb mean w + L (i_end - i_start) / T
    T_load = Kt mean i - f mean w - J (w_end - w_start) / T
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..recordings.angle import unwrapped
from ..recordings.recording import Finding, Recording

MAX_WINDOWS = 4000
MIN_WINDOWS = 20
WINDOW_LENGTHS = (1, 4, 16)  # times the shortest: rates of noisy channels need long ones
UNSIGNED = ("current", "speed")  # channels of which some sensors give no sign
MAX_UNEXPLAINED = 0.2  # share of the voltage that these may leave, if they are given its sign
MAX_NEGATIVE = 0.02  # share of its range to which a channel that has no sign may be negative
# Least share of the variance that the equations explain where something is concluded from them: of what drives the
# motor, without a current to balance it, of the angle's rate, and of the load
MIN_EXPLAINED_DRIVE, MIN_EXPLAINED_ANGLE, MIN_EXPLAINED_LOAD = 0.7, 0.98, 0.8
# How far the ratio of the angle's rate to the speed, relative to what it should be, may be off, and that of Kt to Kb
ANGLE_RATIO_TOLERANCE, KT_OVER_KB_FACTOR = 0.1, 1.25
MIN_CLARITY = 3.0  # a term is seen when it moves the fit by this many residuals
RPM_PER_RAD_S = 30 / np.pi
DEGREES_PER_RAD = 180 / np.pi
MAX_SPEED = 6000.0  # rad/s, 57,000 rpm: no brushed motor turns faster
MAX_VOLTAGE = 3000.0  # V, of the largest traction motors
KB_RANGE = (5e-5, 200.0)  # V s/rad, a factor of 20 beyond what is built
MIN_R = 5e-4  # ohm, below that of any brushes
# What Kt / Kb, in SI about 1, comes out as if a column is in another unit than it is read in
KT_OVER_KB_IF_MISREAD = {
    RPM_PER_RAD_S: ("speed", "rpm", "rad/s"),
    DEGREES_PER_RAD: ("speed", "deg/s", "rad/s"),
    1e3: ("load", "mN*m", "N m"),
    1e-3: ("current", "mA", "A"),
}


class Term(NamedTuple):
    """One coefficient of a regression; `clarity` is its effect over the residual, both rms."""

    value: float
    clarity: float

    @property
    def negative(self) -> bool:
        return self.value < 0 and self.clarity > MIN_CLARITY

    @property
    def positive(self) -> bool:
        return self.value > 0 and self.clarity > MIN_CLARITY


def reversed_signs(run: Recording) -> Iterator[Finding]:
    """Channels wired or defined the other way round."""
    for column, what in _reversed_channels(run):
        mend = f"Reverse the sign of the {column} column (--column {column}=HEADER:-UNIT), or swap its wires"
        yield Finding(run.name, column, "warning", what, "whole run", mend)


def lost_signs(run: Recording) -> Iterator[Finding]:
    """Unsigned channels: many sensors report a magnitude without a sign."""
    w = _windows(run)
    if run.drive != "voltage" or not {"current", "speed"} <= set(w):
        return
    if not np.quantile(w["voltage"], 0.05) < 0 < np.quantile(w["voltage"], 0.95):
        return

    def unexplained(*unsigned: str) -> float:
        """Share of the voltage that R i + Kb w does not explain, if some have the sign of the voltage."""
        sign = np.sign(w["voltage"])
        terms = {name: w[name] * (sign if name in unsigned else 1.0) for name in UNSIGNED}
        return 1 - regress(w["voltage"], terms, intercept=False)[1]

    positive = [name for name in UNSIGNED if np.min(w[name]) > -MAX_NEGATIVE * np.max(w[name])]
    least, lost = min(
        ((unexplained(*some), some) for k in (1, 2) for some in combinations(positive, k)), default=(1.0, ())
    )
    as_recorded = unexplained()
    if least < min(MAX_UNEXPLAINED, as_recorded / 2) and as_recorded > MAX_UNEXPLAINED / 2:
        for column in lost:
            what = "it is never negative although the voltage is: its sign is missing"
            mend = "Record it with its sign, or run the motor in one direction only"
            yield Finding(run.name, column, "warning", what, "whole run", mend)


def _reversed_channels(run: Recording) -> Iterator[tuple[str, str]]:
    w = _windows(run)
    if run.drive == "voltage" and {"current", "speed"} <= set(w):
        R, Kb = _electrical_balance(w)
        if R.negative and Kb.negative:
            yield "voltage", "its sign is opposite to that of current and speed"
        elif Kb.negative and R.value > 0:
            yield "speed", "its sign is opposite to that of the voltage"
        elif R.negative and Kb.value > 0:
            yield "current", "its sign is opposite to that of the voltage"
    elif any(_falls_when_driven(run, longer) for longer in WINDOW_LENGTHS):
        yield "speed", f"it falls where the {run.drive} should make it rise: one sign is wrong"


def _falls_when_driven(run: Recording, longer: int) -> bool:
    """Whether inertia comes out negative from what drives and how the speed changes."""
    w = _windows(run, longer)
    if not {run.drive, "speed"} <= set(w):
        return False
    regressors = {k: w[k] for k in ("speed", "speed_rate", "direction", "load") if k in w}
    fit, explained = regress(w[run.drive], regressors)
    # a voltage is balanced by the back-EMF too, which has the same sign
    drag = run.drive != "voltage" or fit["speed"].value < 0
    return explained > MIN_EXPLAINED_DRIVE and fit["speed_rate"].negative and drag


def _electrical_balance(w: Mapping[str, np.ndarray]) -> tuple[Term, Term]:
    """R and Kb. No intercept: at a constant voltage a varying load shows them."""
    balance = {k: w[k] for k in ("current", "speed", "current_rate")}
    fit, _ = regress(w["voltage"], balance, intercept=False)
    return fit["current"], fit["speed"]


def angle_against_speed(run: Recording) -> Iterator[Finding]:
    """Speed that is not the derivative of the angle."""
    w = _windows(run)
    if "angle_rate" not in w or run.speed is None:
        return
    fit, explained = regress(w["angle_rate"], {"speed": w["speed"]})
    ratio = fit["speed"].value
    if explained < MIN_EXPLAINED_ANGLE or abs(ratio - 1) < ANGLE_RATIO_TOLERANCE:
        return
    reasons = {
        1 / RPM_PER_RAD_S: ", as if the speed were in rpm",
        1 / DEGREES_PER_RAD: ", as if the speed were in deg/s",
        DEGREES_PER_RAD: ", as if the angle were in degrees",
        1 / (2 * np.pi): ", as if the angle were in turns",
        -1.0: ", as if one of them had the wrong sign",
    }
    why = next((why for k, why in reasons.items() if abs(ratio / k - 1) < ANGLE_RATIO_TOLERANCE), "")
    what = f"the angle changes {ratio:.4g} times as fast as the recorded speed{why}".strip()
    mend = "Correct the unit, in the header or with --column, or the sign"
    yield Finding(run.name, "angle", "warning", what, "whole run", mend)


def implausible_units(runs: Sequence[Recording]) -> Iterator[Finding]:
    """Columns in another unit than they are read in, such as a speed in rpm that passes as rad/s.

    In SI the torque constant equals that of the back-EMF. Kt shows where the load is known and
    varies, within a run or from run to run.
    """
    wrong = [finding for run in runs for finding in _impossible_values(run)]
    yield from wrong
    names = ", ".join(run.name for run in runs if run.load is not None)
    constants = max((_constants(runs, longer) for longer in WINDOW_LENGTHS), key=lambda c: c.explained)
    Kb, Kt = constants.Kb, constants.Kt
    if constants.explained < MIN_EXPLAINED_LOAD or not (constants.R.positive and Kb.positive):
        return
    if Kt.negative:
        what = "the load rises where the current falls: its sign is reversed"
        mend = (
            "A load that opposes positive motion is positive: reverse the sign of the column"
            " (--column load=HEADER:-UNIT)"
        )
        yield Finding(names, "load", "warning", what, "all loaded runs", mend)
    if not Kt.positive:
        return
    ratio, has_wrong_voltage = Kt.value / Kb.value, any(finding.column == "voltage" for finding in wrong)
    for scale, (column, unit, read) in KT_OVER_KB_IF_MISREAD.items():
        if 1 / KT_OVER_KB_FACTOR < ratio / scale < KT_OVER_KB_FACTOR and not has_wrong_voltage:
            what = f"Kt is {ratio:.3g} times Kb, as if the {column} were in {unit}, not {read}"
            mend = f"If so, write [{unit}] in the header, or use --column {column}=HEADER:{unit}"
            yield Finding(names, column, "warning", what, "all loaded runs", mend)


class _Constants(NamedTuple):
    R: Term
    Kb: Term
    Kt: Term
    explained: float  # share of the variance of the load


def _constants(runs: Sequence[Recording], longer: int) -> _Constants:
    """What the runs with a known load say together."""
    needed = {"voltage", "current", "speed", "load"}
    loaded = [w for w in (_windows(run, longer) for run in runs) if needed <= set(w)]
    if not loaded:
        return _Constants(*[Term(0.0, 0.0)] * 3, explained=0.0)
    names = (*needed, "current_rate", "speed_rate", "direction")
    w = {k: np.concatenate([one[k] for one in loaded]) for k in names}
    torques = {k: w[k] for k in ("current", "speed", "speed_rate", "direction")}
    mechanical, explained = regress(w["load"], torques)
    return _Constants(*_electrical_balance(w), mechanical["current"], explained)


def _impossible_values(run: Recording) -> Iterator[Finding]:
    """Values, and what they make of R and Kb, that no brushed motor has."""
    w = _windows(run)

    def wrong(column: str, what: str, units: str) -> Finding:
        mend = f"Check the unit: write {units} in the header, or map the column with --column"
        return Finding(run.name, column, "warning", what, "whole run", mend)

    largest = {name: float(np.max(np.abs(w[name]))) for name in ("speed", "voltage") if name in w}
    if largest.get("voltage", 0.0) > MAX_VOLTAGE:
        yield wrong("voltage", f"{largest['voltage']:.4g} V is too high for a brushed motor", "[mV]")
    elif largest.get("speed", 0.0) > MAX_SPEED:
        what = f"{largest['speed']:.4g} rad/s is too fast for a brushed motor"
        yield wrong("speed", what, "[rpm] or [deg/s]")
    elif {"voltage", "current", "speed"} <= set(w):
        R, Kb = _electrical_balance(w)
        if Kb.positive and not KB_RANGE[0] < Kb.value < KB_RANGE[1]:
            what = f"with the voltage it gives Kb = {Kb.value:.3g} V s/rad, unlike any real motor"
            yield wrong("speed", what, "[rpm] or [deg/s]")
        if R.positive and R.value < MIN_R:
            what = f"with the voltage it gives R = {R.value:.3g} ohm, less than any real motor has"
            yield wrong("current", what, "[mA]")


def regress(
    y: np.ndarray, regressors: Mapping[str, np.ndarray], intercept: bool = True
) -> tuple[dict[str, Term], float]:
    """Least squares.

    **Arguments**: `y` and each of `regressors`, (windows,); `intercept`, whether to fit a constant.

    **Returns**: a `Term` for each regressor, and the share of the variance of y explained.
    """
    X = np.stack(list(regressors.values()), axis=1)
    largest, rounding = np.max(np.abs(X), axis=0), 1e-9 * np.max(np.abs(y)) + 1e-300
    if intercept:
        X, y = X - X.mean(axis=0), y - y.mean()
    scale = np.sqrt(np.mean(X**2, axis=0))
    scale[scale <= 1e-12 * largest] = np.inf  # a constant column has no effect
    U, s, Vt = np.linalg.svd(X / scale, full_matrices=False)
    s = np.maximum(s, 1e-8 * s[0] + 1e-150)  # whose square is a number still
    coefficients = Vt.T @ (U.T @ y / s)
    residual = y - X / scale @ coefficients
    # rms of what only this regressor can explain
    own = 1 / np.sqrt(len(y) * np.sum((Vt.T / s) ** 2, axis=1))
    rms = np.sqrt(np.mean(residual**2)) + rounding
    terms = {
        name: Term(float(c / size), float(abs(c) * o / rms))
        for name, c, size, o in zip(regressors, coefficients, scale, own, strict=True)
    }
    return terms, float(1 - np.mean(residual**2) / (np.mean(y**2) + 1e-300))


def _windows(run: Recording, longer: int = 1) -> dict[str, np.ndarray]:
    """Means and rates over windows of the record, each (windows,); empty if there are too few.

    `longer` stretches the windows, against noise. Keys: the quantities, `current_rate`,
    `speed_rate`, `angle_rate` and `direction`, the mean sign of the speed.
    """
    size = longer * max(4, len(run) // MAX_WINDOWS)
    if len(run) <= MIN_WINDOWS * size:
        return {}
    count = (len(run) - 1) // size
    ends = np.arange(count + 1) * size
    steps = np.diff(run.time[: ends[-1] + 1])
    length = np.diff(run.time[ends])

    def mean(values: np.ndarray) -> np.ndarray:
        return (values * steps).reshape(count, size).sum(1) / length

    def mean_of_line(values: np.ndarray) -> np.ndarray:
        """The mean of a signal that is linear between samples instead of held."""
        return mean((values[1 : ends[-1] + 1] + values[: ends[-1]]) / 2)

    speed = speed_of(run)
    means: dict[str, np.ndarray] = {}
    for name in ("voltage", "torque", "load"):  # held from sample to sample
        if (values := getattr(run, name)) is not None:
            means[name] = mean(values[: ends[-1]])
    for name, values in (("current", run.current), ("speed", speed)):
        if values is not None:
            means |= {name: mean_of_line(values), f"{name}_rate": np.diff(values[ends]) / length}
    if speed is not None:
        means["direction"] = mean_of_line(np.sign(speed))
    if run.angle is not None:
        means["angle_rate"] = np.diff(unwrapped(run.angle)[0][ends]) / length
    good = (length < 1.5 * np.median(length)) & np.isfinite(sum(means.values()))
    return {k: values[good] for k, values in means.items()} if good.sum() >= MIN_WINDOWS else {}


def speed_of(run: Recording) -> np.ndarray | None:
    """Speed in rad/s, (samples,), from the angle where it was not recorded; None without either."""
    if run.speed is None and run.angle is not None:
        return np.gradient(unwrapped(run.angle)[0], run.time)
    return run.speed
