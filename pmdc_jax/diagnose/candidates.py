"""What may be missing: for every effect of the library the regression columns that test for it.

An effect is linear in its amplitudes. Its other parameters (a Stribeck speed, a number of periods) are tried on a
grid that the recordings set. Effects that are no small perturbation (a lag, a shaft) are tried at finite sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..effects import (
    EFFECTS,
    CoulombFriction,
    ShaftCompliance,
    SpeedSensorDelay,
    SpeedSensorLag,
    StribeckFriction,
)

Values = dict[str, float]


class Scales(NamedTuple):
    """Sizes that are typical of the recordings."""

    current: float  # A
    speed: float  # rad/s
    slow: float  # rad/s, below which the motion is for a twentieth of its time
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
    run has coefficients of its own.
    """

    effect: str
    columns: tuple[Values, ...]
    units: tuple[float, ...]
    build: Callable[[np.ndarray, float], Values | None]
    amplitude: str | None = None  # the field that the last coefficient is, if it is one field
    own_phase: bool = False
    # the response is from a simulation with the whole setting, not to first order
    whole: bool = False

    @property
    def order(self) -> int:
        """How many coefficients it has (in one run, with `own_phase`)."""
        return len(self.columns)

    @property
    def unit(self) -> float:
        """The amplitude at a last coefficient of one: one unit, or the whole size of an effect tried at finite size."""
        if self.amplitude is None or self.units[-1] != 1.0:
            return 1.0
        return self.columns[-1][self.amplitude]

    @property
    def largest(self) -> float:
        """Upper limit of the amplitude: the scale itself, which no real motor exceeds; infinite at finite sizes."""
        return np.inf if self.units[-1] == 1.0 else self.units[-1] / SMALL


# Makes the candidates of an effect from its name and the scales of the recordings
Rows = Callable[[str, Scales], list[Candidate]]

# A small amplitude, as a share of its scale: the response to it is practically a derivative.
SMALL = 1e-4
# ... and one in SI units that stands for zero, where an amplitude must be positive.
NOTHING = 1e-12


def candidates(scales: Scales) -> list[Candidate]:
    """All shapes of all effects of the library that are to be tried."""
    return [c for name in EFFECTS for c in TRIALS[name].columns(name, scales)]


def _amplitude(
    field: str,
    size: Callable[[Scales], float],
    signed: bool = False,
    **shapes: Callable[[Scales], Iterable[float]],
) -> Rows:
    """An effect with one amplitude, tried at `SMALL` of its `size`; `shapes` give the grids of its other fields."""

    def rows(name: str, scales: Scales) -> list[Candidate]:
        small = SMALL * size(scales)
        grids = [{}]
        for shape, grid in shapes.items():
            grids = [{**values, shape: x} for values in grids for x in grid(scales)]

        def candidate(values: Values) -> Candidate:
            def build(c: np.ndarray, dry: float) -> Values | None:
                return {field: float(c[0]), **values} if signed or c[0] > 0 else None

            return Candidate(name, ({field: small, **values},), (small,), build, field)

        return [candidate(values) for values in grids]

    return rows


def _finite(field: str, grid: Callable[[Scales], Sequence[float]]) -> Rows:
    """An effect tried at finite sizes; the coefficient scales each size, within a factor of 5 either way."""

    def rows(name: str, scales: Scales) -> list[Candidate]:
        def candidate(size: float) -> Candidate:
            def build(c: np.ndarray, dry: float) -> Values | None:
                return {field: size * float(np.clip(c[0], 0.2, 5.0))} if c[0] > 0 else None

            return Candidate(name, ({field: size},), (1.0,), build, field)

        return [candidate(size) for size in grid(scales)]

    return rows


def _either(*rows: Rows) -> Rows:
    """An effect tried in several ways."""
    return lambda name, scales: [c for of_one in rows for c in of_one(name, scales)]


# The Stribeck speeds that are tried, as shares of `Scales.speed`
PEAKS = (0.01, 0.016, 0.025, 0.04, 0.06, 0.1, 0.15, 0.25)


def _stribeck(name: str, scales: Scales) -> list[Candidate]:
    small = SMALL * scales.torque

    def candidate(speed: float) -> Candidate:
        def build(c: np.ndarray, dry: float) -> Values | None:
            if c[1] <= 0 or c[0] + c[1] + dry <= 0:
                return None
            # were it much smaller, no run would be sensitive to it and a refit could not bring it back
            coulomb = max(float(c[0]) + dry, 0.1 * float(c[1]))
            return {"coulomb_Nm": coulomb, "static_Nm": coulomb + float(c[1]), "speed_rad_s": speed}

        flat = {"coulomb_Nm": small, "static_Nm": small, "speed_rad_s": speed}
        peak = {"coulomb_Nm": NOTHING, "static_Nm": small, "speed_rad_s": speed}
        return Candidate(name, (flat, peak), (small, small), build, "static_Nm")

    return [candidate(share * scales.speed) for share in PEAKS]


def _asymmetric(name: str, scales: Scales) -> list[Candidate]:
    small = SMALL * scales.torque

    def build(c: np.ndarray, dry: float) -> Values | None:
        if min(c) + dry <= 0:
            return None
        return {"forward_Nm": float(c[0]) + dry, "backward_Nm": float(c[1]) + dry}

    columns = (
        {"forward_Nm": small, "backward_Nm": NOTHING},
        {"forward_Nm": NOTHING, "backward_Nm": small},
    )
    return [Candidate(name, columns, (small, small), build, "backward_Nm")]


def _periodic(field: str, size: Callable[[Scales], float], *others: Values) -> Rows:
    """Cosine and sine of the rotor angle, with a phase of its own in every run; `others` set the other fields."""

    def rows(name: str, scales: Scales) -> list[Candidate]:
        small = SMALL * size(scales)

        def candidate(periods: int, other: Values) -> Candidate:
            shape = {"periods": float(periods), **other}

            def build(c: np.ndarray, dry: float) -> Values | None:
                phase = float(np.arctan2(c[1], c[0]))
                return {field: float(np.hypot(c[0], c[1])), "phase_rad": phase, **shape}

            columns = tuple({field: small, "phase_rad": p, **shape} for p in (0.0, np.pi / 2))
            return Candidate(name, columns, (small, small), build, field, own_phase=True)

        # a period that passes within one sample even in slow motion, or is never completed, is not in the record
        most = 2 * np.pi / (scales.slow * scales.sample_time)
        shown = [p for p in PERIODS if p < most and p * scales.travel >= 2 * np.pi]
        return [candidate(periods, other) for other in others or ({},) for periods in shown]

    return rows


PERIODS = (*range(1, 17), 18, 20, 21, 22, 24, 26, 28, 30, 32, 36, 40, 42, 48)

# Resonances of a compliant shaft that are tried, Hz; so dense because one far from the true one explains little
RINGING = (6.0, 9.0, 12.0, 18.0, 25.0, 35.0, 50.0, 70.0, 100.0, 140.0, 200.0, 280.0, 400.0)
# Share of the inertia that they have behind the shaft
SHARE = 0.5


def _shaft(hertz: float, scales: Scales, share: float = SHARE, damping: float = 0.05) -> Values:
    """A shaft on which two inertias ring at `hertz`; `share`, the load's of the inertia; `damping`, damping ratio."""
    rate = 2 * np.pi * hertz
    stiffness = rate**2 * scales.inertia * share * (1 - share)
    return {
        "stiffness_Nm_rad": stiffness,
        "damping_Nms_rad": 2 * damping * stiffness / rate,
        "load_share": share,
    }


def _compliance(name: str, scales: Scales) -> list[Candidate]:
    def candidate(hertz: float) -> Candidate:
        values = _shaft(hertz, scales)
        return Candidate(
            name, (values,), (1.0,), lambda c, dry: values if c[0] > 0 else None, whole=True
        )

    return [candidate(hertz) for hertz in RINGING if hertz * scales.sample_time < 0.5]


def _no_columns(name: str, scales: Scales) -> list[Candidate]:
    """No columns: the response to backlash is not even roughly proportional to it. See `Trial.starts` instead."""
    del name, scales
    return []


def _shaft_starts(scales: Scales) -> list[Values]:
    return [_shaft(f, scales, share, 0.1) for f in (200.0, 100.0, 50.0) for share in (0.6, 0.3)]


def _backlash_starts(scales: Scales) -> list[Values]:
    """A gear whose teeth are stiff compared with everything else."""
    return [{"gap_rad": 0.05, **_shaft(100.0, scales, 0.45, 0.3)}]


# The factors, up and down from that start, within which each is sought. Of the stiffness almost nothing is known: how
# fast teeth come to rest depends on their damping.
TEETH = {"gap_rad": 40.0, "stiffness_Nm_rad": 30.0, "damping_Nms_rad": 10.0, "load_share": 2.0}

# A clear Stribeck peak: static over Coulomb friction, and the Stribeck speed as a share of `Scales.speed`
PEAK, SLOW = 2.0, 0.05
# ... and clear backlash: the gap as a share of the twist of the shaft under `Scales.torque`
PLAY = 0.3


def _with_peak(friction: CoulombFriction, scales: Scales) -> Values:
    dry = float(friction.torque_Nm)
    return {"coulomb_Nm": dry, "static_Nm": PEAK * dry, "speed_rad_s": SLOW * scales.speed}


def _with_play(shaft: ShaftCompliance, scales: Scales) -> Values:
    same = {field: float(getattr(shaft, field)) for field in shaft.ranges}
    return {"gap_rad": PLAY * scales.torque / same["stiffness_Nm_rad"], **same}


def _times(scales: Scales) -> list[float]:
    """Time constants or delays of a sensor that are tried, in s: from 0.2 to 200 samples."""
    return [x for x in (5e-4, 1.5e-3, 4e-3, 1e-2, 3e-2) if 0.2 < x / scales.sample_time < 200]


def _thermal(scales: Scales) -> list[float]:
    return [scales.duration * x for x in (0.03, 0.1, 0.3, 1.0)]


def _without_peak(friction: StribeckFriction) -> Values:
    """Coulomb friction midway between both levels: under a peak as wide as the speeds the Coulomb level is hidden."""
    return {"torque_Nm": float(friction.coulomb_Nm + friction.static_Nm) / 2}


def _as_late(lag: SpeedSensorLag) -> Values:
    return {"delay_s": float(lag.time_constant_s)}


def _as_slow(delay: SpeedSensorDelay) -> Values:
    return {"time_constant_s": float(delay.delay_s)}


class Fuller(NamedTuple):
    """A fuller form of an effect: the simple form is a special case of it."""

    effect: str
    # start values from the fit of the simple form, with what makes it fuller clearly there
    begun: Callable[[Any, Scales], Values]
    extra: tuple[str, ...]  # the fields that make it fuller
    # start values of the simple form from the fit of the fuller one, which may have been found without it
    reduced: Callable[[Any], Values] | None = None


class Trial(NamedTuple):
    """How an effect is tried."""

    # makes its candidates, each with its regression columns
    columns: Rows
    # additional start values for refits, if these easily end in a wrong optimum
    starts: Callable[[Scales], list[Values]] | None = None
    # by field, the factor around a start within which populations search first, if it has many optima
    factors: Mapping[str, float] = MappingProxyType({})
    # effects that it contains, and replaces
    contains: frozenset[str] = frozenset()
    # effects that resemble it, each with its start values from the fit of this one
    alike: Mapping[str, Callable[[Any], Values]] = MappingProxyType({})
    # a fuller form of it, which the runs must rule out
    fuller: Fuller | None = None


TRIALS: Mapping[str, Trial] = {
    "coulomb_friction": Trial(
        _amplitude("torque_Nm", lambda s: s.torque),
        fuller=Fuller("stribeck_friction", _with_peak, ("static_Nm", "speed_rad_s"), _without_peak),
    ),
    "stribeck_friction": Trial(_stribeck, contains=frozenset({"coulomb_friction"})),
    "asymmetric_friction": Trial(
        _asymmetric, contains=frozenset({"coulomb_friction", "constant_load"})
    ),
    "quadratic_drag": Trial(_amplitude("drag_Nms2_rad2", lambda s: s.torque / s.speed**2)),
    "cogging_torque": Trial(_periodic("amplitude_Nm", lambda s: s.torque)),
    "torque_ripple": Trial(
        _periodic("amplitude", lambda s: 1.0, {"emf_share": 0.0}, {"emf_share": 1.0})
    ),
    "constant_load": Trial(_amplitude("torque_Nm", lambda s: s.torque, signed=True)),
    "shaft_compliance": Trial(
        _compliance, starts=_shaft_starts, fuller=Fuller("gear_backlash", _with_play, ("gap_rad",))
    ),
    "gear_backlash": Trial(_no_columns, starts=_backlash_starts, factors=TEETH),
    "brush_voltage_drop": Trial(_amplitude("voltage_V", lambda s: s.voltage)),
    "resistance_heating": Trial(
        _amplitude("rise_per_W", lambda s: 1 / (s.voltage * s.current), time_constant_s=_thermal)
    ),
    "torque_constant_saturation": Trial(
        _amplitude("per_A2", lambda s: 1 / s.current**2, emf_share=lambda s: (0.0, 1.0))
    ),
    "inductance_saturation": Trial(_amplitude("per_A2", lambda s: 1 / s.current**2)),
    # also at finite widths: noise or a small signal within the dead zone has a sign that the motor does not feel, which
    # a small width does not show
    "input_dead_zone": Trial(
        _either(
            _amplitude("width_V", lambda s: s.voltage),
            _finite("width_V", lambda s: [share * s.voltage for share in (0.01, 0.05)]),
        )
    ),
    "speed_sensor_lag": Trial(
        _finite("time_constant_s", _times), alike={"speed_sensor_delay": _as_late}
    ),
    "speed_sensor_delay": Trial(_finite("delay_s", _times), alike={"speed_sensor_lag": _as_slow}),
    "current_sensor_offset": Trial(_amplitude("offset_A", lambda s: s.current, signed=True)),
}
