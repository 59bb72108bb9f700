"""Candidates: for each effect, the shapes that are tried and the regression columns that test for them.

An effect is linear in its amplitudes. Its other parameters (a Stribeck speed, a number of periods) are tried on a
grid that the recordings set. Effects that are no small perturbation (a lag, a shaft) are tried at finite sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

Values = dict[str, float]


class Scales(NamedTuple):
    """Sizes that are typical of the recordings."""

    current: float  # A
    speed: float  # rad/s
    slow_speed: float  # rad/s, below which the motion is for a twentieth of its time
    voltage: float  # V
    torque: float  # N m
    inertia: float  # kg m^2
    sample_time: float  # s
    duration: float  # s
    travel: float  # rad, the largest range of rotor angles in one run


class Candidate(NamedTuple):
    """One shape of one effect.

    `columns` are settings of the effect, each with one small amplitude; the response to each, divided by its unit in
    `units`, is one column of the regression. `build` turns the coefficients found, and the Coulomb friction (N m) that
    the model has already, into the effect's parameters; None where their signs are unphysical. With `own_phase`, every
    run has its own coefficients.
    """

    effect: str
    columns: tuple[Values, ...]
    units: tuple[float, ...]
    build: Callable[[np.ndarray, float], Values | None]
    amplitude: str | None = None  # the field that the last coefficient is, if it is one field
    own_phase: bool = False
    # the response is from a simulation with the whole setting, not to first order
    full_simulation: bool = False

    @property
    def width(self) -> int:
        """How many coefficients it has (in one run, with `own_phase`)."""
        return len(self.columns)

    @property
    def unit(self) -> float:
        """The amplitude at a last coefficient of one: one unit, or the whole size of an effect tried at finite size."""
        if self.amplitude is None or self.units[-1] != 1.0:
            return 1.0
        return self.columns[-1][self.amplitude]

    @property
    def min_amplitude(self) -> float:
        """Lower limit of the amplitude: that to which a finite size may be scaled; none of an effect that is linear."""
        return self.unit / MAX_SCALING if self.units[-1] == 1.0 else 0.0

    @property
    def max_amplitude(self) -> float:
        """Upper limit of the amplitude: the scale itself, which no real motor exceeds; infinite at finite sizes."""
        return np.inf if self.units[-1] == 1.0 else self.units[-1] / SMALL


# Makes the candidates of an effect from its name and the scales of the recordings
MakeCandidates = Callable[[str, Scales], list[Candidate]]

# A small amplitude, as a share of its scale: the response to it is practically a derivative
SMALL = 1e-4
# A finite size may be scaled by this factor, up or down
MAX_SCALING = 5.0
# An amplitude in SI units that stands for zero where it must be positive
TINY = 1e-12
# Numbers of periods per turn that are tried for effects of the rotor angle
PERIODS = (*range(1, 17), 18, 20, 21, 22, 24, 26, 28, 30, 32, 36, 40, 42, 48)
# The Stribeck speeds that are tried, as shares of `Scales.speed`
STRIBECK_SPEEDS = (0.01, 0.016, 0.025, 0.04, 0.06, 0.1, 0.15, 0.25)
# Resonances of a compliant shaft that are tried, Hz; so dense because one far from the true one explains little
RESONANCES = (6.0, 9.0, 12.0, 18.0, 25.0, 35.0, 50.0, 70.0, 100.0, 140.0, 200.0, 280.0, 400.0)
# ... and the share of the inertia that is then behind the shaft
LOAD_SHARE = 0.5


def amplitude_candidates(
    field: str, size: Callable[[Scales], float], signed: bool = False, **grids: Callable[[Scales], Iterable[float]]
) -> MakeCandidates:
    """An effect with one amplitude, tried at `SMALL` of its `size`; `grids` of its other fields."""

    def make(name: str, scales: Scales) -> list[Candidate]:
        small = SMALL * size(scales)
        shapes = [{}]
        for other, grid in grids.items():
            shapes = [{**shape, other: x} for shape in shapes for x in grid(scales)]

        def candidate(shape: Values) -> Candidate:
            def build(c: np.ndarray, coulomb_torque: float) -> Values | None:
                return {field: float(c[0]), **shape} if signed or c[0] > 0 else None

            return Candidate(name, ({field: small, **shape},), (small,), build, field)

        return [candidate(shape) for shape in shapes]

    return make


def finite_candidates(field: str, grid: Callable[[Scales], Sequence[float]]) -> MakeCandidates:
    """An effect tried at finite sizes; the coefficient scales each size, by a factor of `MAX_SCALING` at most."""

    def make(name: str, scales: Scales) -> list[Candidate]:
        def candidate(size: float) -> Candidate:
            def build(c: np.ndarray, coulomb_torque: float) -> Values | None:
                scaling = float(np.clip(c[0], 1 / MAX_SCALING, MAX_SCALING))
                return {field: size * scaling} if c[0] > 0 else None

            return Candidate(name, ({field: size},), (1.0,), build, field)

        return [candidate(size) for size in grid(scales)]

    return make


def combined(*ways: MakeCandidates) -> MakeCandidates:
    """An effect tried in several ways."""
    return lambda name, scales: [c for make in ways for c in make(name, scales)]


def stribeck_candidates(name: str, scales: Scales) -> list[Candidate]:
    """A constant level and a peak at low speed, beside the Coulomb friction that the model has already."""
    small = SMALL * scales.torque

    def candidate(speed: float) -> Candidate:
        def build(c: np.ndarray, coulomb_torque: float) -> Values | None:
            if c[1] <= 0 or c[0] + c[1] + coulomb_torque <= 0:
                return None
            # at a much smaller value no run would be sensitive to it, and a refit could not recover it
            coulomb = max(float(c[0]) + coulomb_torque, 0.1 * float(c[1]))
            return {"coulomb_Nm": coulomb, "static_Nm": coulomb + float(c[1]), "speed_rad_s": speed}

        flat = {"coulomb_Nm": small, "static_Nm": small, "speed_rad_s": speed}
        peak = {"coulomb_Nm": TINY, "static_Nm": small, "speed_rad_s": speed}
        return Candidate(name, (flat, peak), (small, small), build, "static_Nm")

    return [candidate(share * scales.speed) for share in STRIBECK_SPEEDS]


def asymmetric_candidates(name: str, scales: Scales) -> list[Candidate]:
    """Friction of each direction, beside the Coulomb friction that the model has already."""
    small = SMALL * scales.torque

    def build(c: np.ndarray, coulomb_torque: float) -> Values | None:
        if min(c) + coulomb_torque <= 0:
            return None
        return {"forward_Nm": float(c[0]) + coulomb_torque, "backward_Nm": float(c[1]) + coulomb_torque}

    columns = ({"forward_Nm": small, "backward_Nm": TINY}, {"forward_Nm": TINY, "backward_Nm": small})
    return [Candidate(name, columns, (small, small), build, "backward_Nm")]


def periodic_candidates(field: str, size: Callable[[Scales], float], *others: Values) -> MakeCandidates:
    """Cosine and sine of the rotor angle, with its own phase in every run; `others`, alternatives for other fields."""

    def make(name: str, scales: Scales) -> list[Candidate]:
        small = SMALL * size(scales)

        def candidate(periods: int, other: Values) -> Candidate:
            shape = {"periods": float(periods), **other}

            def build(c: np.ndarray, coulomb_torque: float) -> Values | None:
                phase = float(np.arctan2(c[1], c[0]))
                return {field: float(np.hypot(c[0], c[1])), "phase_rad": phase, **shape}

            columns = tuple({field: small, "phase_rad": p, **shape} for p in (0.0, np.pi / 2))
            return Candidate(name, columns, (small, small), build, field, own_phase=True)

        # a period that passes within one sample even in slow motion, or is never completed, does not show
        most = 2 * np.pi / (scales.slow_speed * scales.sample_time)
        visible = [p for p in PERIODS if p < most and p * scales.travel >= 2 * np.pi]
        return [candidate(periods, other) for other in others or ({},) for periods in visible]

    return make


def shaft_values(hertz: float, scales: Scales, share: float = LOAD_SHARE, damping: float = 0.05) -> Values:
    """A shaft between two inertias that resonates at `hertz`; `share`, the load's of the inertia; `damping`, ratio."""
    rate = 2 * np.pi * hertz
    stiffness = rate**2 * scales.inertia * share * (1 - share)
    return {"stiffness_Nm_rad": stiffness, "damping_Nms_rad": 2 * damping * stiffness / rate, "load_share": share}


def compliance_candidates(name: str, scales: Scales) -> list[Candidate]:
    """Shafts with the resonances `RESONANCES`, each as a whole."""

    def candidate(hertz: float) -> Candidate:
        values = shaft_values(hertz, scales)
        return Candidate(
            name, (values,), (1.0,), lambda c, coulomb_torque: values if c[0] > 0 else None, full_simulation=True
        )

    return [candidate(hertz) for hertz in RESONANCES if hertz * scales.sample_time < 0.5]


def no_candidates(name: str, scales: Scales) -> list[Candidate]:
    """None: the response to backlash is not even roughly proportional to it. See `Trial.starts` instead."""
    del name, scales
    return []


def sensor_times(scales: Scales) -> list[float]:
    """Time constants or delays of a sensor that are tried, in s: from 0.2 to 200 samples."""
    return [x for x in (5e-4, 1.5e-3, 4e-3, 1e-2, 3e-2) if 0.2 < x / scales.sample_time < 200]


def thermal_times(scales: Scales) -> list[float]:
    """Thermal time constants that are tried, in s."""
    return [scales.duration * x for x in (0.03, 0.1, 0.3, 1.0)]
