"""How each effect of the library is tried: its candidates, its start values for refits, and its related effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from ...effects import (
    EFFECTS,
    CoulombFriction,
    GearBacklash,
    ShaftCompliance,
    SpeedSensorDelay,
    SpeedSensorLag,
    StribeckFriction,
)
from .candidates import (
    Candidate,
    MakeCandidates,
    Scales,
    Values,
    amplitude_candidates,
    asymmetric_candidates,
    combined,
    compliance_candidates,
    finite_candidates,
    no_candidates,
    periodic_candidates,
    sensor_times,
    shaft_values,
    stribeck_candidates,
    thermal_times,
)

# Factors, up and down from the start of backlash, within which populations search. Almost nothing is known of the
# stiffness: how fast teeth come to rest depends on their damping.
BACKLASH_FACTORS = {"gap_rad": 40.0, "stiffness_Nm_rad": 30.0, "damping_Nms_rad": 10.0, "load_share": 2.0}
# A clear Stribeck peak: static over Coulomb friction, and the Stribeck speed as a share of `Scales.speed`
STATIC_TO_COULOMB, STRIBECK_SPEED = 2.0, 0.05
# Clear backlash: the gap as a share of the twist of the shaft under `Scales.torque`
GAP_TO_TWIST = 0.3


class Fuller(NamedTuple):
    """A fuller form of an effect: the simple form is a special case of it."""

    effect: str
    # start values from the fit of the simple form, with what makes it fuller clearly present
    from_simple: Callable[[Any, Scales], Values]
    extra: tuple[str, ...]  # the fields that make it fuller
    # start values of the simple form from the fit of the fuller one, which may have been found without it
    to_simple: Callable[[Any], Values]


class Trial(NamedTuple):
    """How an effect is tried."""

    candidates: MakeCandidates
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


def _shaft_starts(scales: Scales) -> list[Values]:
    return [shaft_values(f, scales, share, 0.1) for f in (200.0, 100.0, 50.0) for share in (0.6, 0.3)]


def _backlash_starts(scales: Scales) -> list[Values]:
    """A gear whose teeth are stiff compared with everything else."""
    return [{"gap_rad": 0.05, **shaft_values(100.0, scales, 0.45, 0.3)}]


def _stribeck_from_coulomb(friction: CoulombFriction, scales: Scales) -> Values:
    coulomb = float(friction.torque_Nm)
    return {
        "coulomb_Nm": coulomb,
        "static_Nm": STATIC_TO_COULOMB * coulomb,
        "speed_rad_s": STRIBECK_SPEED * scales.speed,
    }


def _backlash_from_shaft(shaft: ShaftCompliance, scales: Scales) -> Values:
    values = {field: float(getattr(shaft, field)) for field in shaft.ranges}
    return {"gap_rad": GAP_TO_TWIST * scales.torque / values["stiffness_Nm_rad"], **values}


def _shaft_from_backlash(gear: GearBacklash) -> Values:
    return {field: float(getattr(gear, field)) for field in ShaftCompliance.ranges}


def _coulomb_from_stribeck(friction: StribeckFriction) -> Values:
    """Coulomb friction midway between both levels: a peak as wide as the range of speeds hides the Coulomb level."""
    return {"torque_Nm": float(friction.coulomb_Nm + friction.static_Nm) / 2}


def _delay_from_lag(lag: SpeedSensorLag) -> Values:
    return {"delay_s": float(lag.time_constant_s)}


def _lag_from_delay(delay: SpeedSensorDelay) -> Values:
    return {"time_constant_s": float(delay.delay_s)}


TRIALS: Mapping[str, Trial] = {
    "coulomb_friction": Trial(
        amplitude_candidates("torque_Nm", lambda s: s.torque),
        fuller=Fuller(
            "stribeck_friction", _stribeck_from_coulomb, ("static_Nm", "speed_rad_s"), _coulomb_from_stribeck
        ),
    ),
    "stribeck_friction": Trial(stribeck_candidates, contains=frozenset({"coulomb_friction"})),
    "asymmetric_friction": Trial(asymmetric_candidates, contains=frozenset({"coulomb_friction", "constant_load"})),
    "quadratic_drag": Trial(amplitude_candidates("drag_Nms2_rad2", lambda s: s.torque / s.speed**2)),
    "cogging_torque": Trial(periodic_candidates("amplitude_Nm", lambda s: s.torque)),
    "torque_ripple": Trial(periodic_candidates("amplitude", lambda s: 1.0, {"emf_share": 0.0}, {"emf_share": 1.0})),
    "constant_load": Trial(amplitude_candidates("torque_Nm", lambda s: s.torque, signed=True)),
    "shaft_compliance": Trial(
        compliance_candidates,
        starts=_shaft_starts,
        fuller=Fuller("gear_backlash", _backlash_from_shaft, ("gap_rad",), _shaft_from_backlash),
    ),
    "gear_backlash": Trial(no_candidates, starts=_backlash_starts, factors=BACKLASH_FACTORS),
    "brush_voltage_drop": Trial(amplitude_candidates("voltage_V", lambda s: s.voltage)),
    "resistance_heating": Trial(
        amplitude_candidates("rise_per_W", lambda s: 1 / (s.voltage * s.current), time_constant_s=thermal_times)
    ),
    "torque_constant_saturation": Trial(
        amplitude_candidates("per_A2", lambda s: 1 / s.current**2, emf_share=lambda s: (0.0, 1.0))
    ),
    "inductance_saturation": Trial(amplitude_candidates("per_A2", lambda s: 1 / s.current**2)),
    # also at finite widths: while the voltage is within the dead zone, the motor does not respond to its sign, which a
    # small width does not show
    "input_dead_zone": Trial(
        combined(
            amplitude_candidates("width_V", lambda s: s.voltage),
            finite_candidates("width_V", lambda s: [share * s.voltage for share in (0.01, 0.05)]),
        )
    ),
    "speed_sensor_lag": Trial(
        finite_candidates("time_constant_s", sensor_times), alike={"speed_sensor_delay": _delay_from_lag}
    ),
    "speed_sensor_delay": Trial(
        finite_candidates("delay_s", sensor_times), alike={"speed_sensor_lag": _lag_from_delay}
    ),
    "current_sensor_offset": Trial(amplitude_candidates("offset_A", lambda s: s.current, signed=True)),
}


def all_candidates(scales: Scales) -> list[Candidate]:
    """The candidates of all effects of the library."""
    return [c for name in EFFECTS for c in TRIALS[name].candidates(name, scales)]
