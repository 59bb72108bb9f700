"""Effects that may be hidden in a motor: the seventeen of the library, other formulas of them, and strangers.

`LIBRARY` has the effects by their documented names. `FORMULAS` are the same effects with other
formulas, to be named the same. `STRANGERS` are effects outside the library.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from numpy.random import Generator

from benchmarks.naming.plant import Plant

Parameters = dict[str, float]


@dataclass(frozen=True)
class Hidden:
    """An effect that may be hidden.

    `draw` gives parameters at a medium amplitude; an amplitude factor multiplies those named in
    `scaled` and divides those in `inverse`. `fields` turns parameters into constants of the plant.
    `limits` are the factors within which the effect remains physical.
    """

    label: str
    name: str | None  # its name in the library; None for a stranger
    draw: Callable[[Generator, Plant], Parameters]
    fields: Callable[[Parameters], Parameters]
    scaled: tuple[str, ...]
    inverse: tuple[str, ...] = ()
    limits: tuple[float, float] = (1e-4, 10.0)

    def at(self, drawn: Parameters, factor: float) -> Parameters:
        """The drawn parameters at another amplitude."""
        up = {n: drawn[n] * factor for n in self.scaled}
        return drawn | up | {n: drawn[n] / factor for n in self.inverse}

    def put_into(self, plant: Plant, parameters: Parameters) -> Plant:
        """The plant with this effect in it."""
        return plant._replace(**self.fields(parameters))


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """One number between low and high, uniform in its logarithm."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _phase(rng: Generator) -> float:
    return float(rng.uniform(0.0, 2.0 * math.pi))


def _renamed(**names: str) -> Callable[[Parameters], Parameters]:
    """Renames parameters to fields of the plant: field = parameter."""
    return lambda p: {field: p[name] for field, name in names.items()}


# ------------------------------------------------------------------------------------- the library


def _one(name: str, low: float, high: float) -> Callable[[Generator, Plant], Parameters]:
    return lambda rng, plant: {name: log_uniform(rng, low, high)}


def _coulomb_draw(rng: Generator, plant: Plant) -> Parameters:
    return {"torque_Nm": log_uniform(rng, 0.02, 0.1)}


def _stribeck_draw(rng: Generator, plant: Plant) -> Parameters:
    level = log_uniform(rng, 0.02, 0.1)
    static = level * rng.uniform(1.6, 3.5)
    return {"coulomb_Nm": level, "static_Nm": static, "speed_rad_s": log_uniform(rng, 4.0, 25.0)}


def _asymmetric_draw(rng: Generator, plant: Plant) -> Parameters:
    level, ratio = log_uniform(rng, 0.02, 0.08), rng.uniform(1.5, 3.5)
    pair = (level, level * ratio) if rng.random() < 0.5 else (level * ratio, level)
    return dict(zip(("forward_Nm", "backward_Nm"), pair, strict=True))


def _periodic_draw(name: str, low: float, high: float, fewest: int = 2, most: int = 12):
    def draw(rng: Generator, plant: Plant) -> Parameters:
        amplitude = log_uniform(rng, low, high)
        periods = float(rng.integers(fewest, most + 1))
        return {name: amplitude, "periods": periods, "phase": _phase(rng)}

    return draw


def _signed(draw: Callable[[Generator, Plant], Parameters], name: str):
    def signed(rng: Generator, plant: Plant) -> Parameters:
        drawn = draw(rng, plant)
        return drawn | {name: drawn[name] * float(rng.choice([-1.0, 1.0]))}

    return signed


def _coupling_draw(rng: Generator, plant: Plant, hertz: tuple[float, float], damped: tuple[float, float]) -> Parameters:
    """A spring with a given resonance of the two inertias against each other, and damping ratio."""
    share, ratio = rng.uniform(0.3, 0.7), log_uniform(rng, *damped)
    reduced, speed = plant.J * share * (1.0 - share), 2.0 * math.pi * log_uniform(rng, *hertz)
    damping = 2.0 * ratio * reduced * speed
    return {"stiffness": reduced * speed**2, "damping": damping, "load_share": share}


def _compliance_draw(rng: Generator, plant: Plant) -> Parameters:
    return _coupling_draw(rng, plant, (15.0, 60.0), (0.03, 0.2))


def _backlash_draw(rng: Generator, plant: Plant) -> Parameters:
    """Teeth so stiff that the backlash matters, not their compliance."""
    contact = _coupling_draw(rng, plant, (500.0, 900.0), (0.3, 0.8))
    return contact | {"gap_rad": log_uniform(rng, 0.01, 0.1)}


def _heating_draw(rng: Generator, plant: Plant) -> Parameters:
    return {"rise_per_W": log_uniform(rng, 5e-4, 5e-3), "time_constant_s": log_uniform(rng, 0.7, 8.0)}


_COUPLING = dict.fromkeys(("stiffness", "damping", "load_share"))
_coupled = _renamed(**{n: n for n in _COUPLING})
_backlash_fields = _renamed(**{n: n for n in _COUPLING}, gap_rad="gap_rad")
_coulomb_fields = _renamed(friction_forward_Nm="torque_Nm", friction_backward_Nm="torque_Nm")


def _stribeck_fields(p: Parameters) -> Parameters:
    return {
        "friction_forward_Nm": p["coulomb_Nm"],
        "friction_backward_Nm": p["coulomb_Nm"],
        "friction_excess_Nm": p["static_Nm"] - p["coulomb_Nm"],
        "stribeck_speed_rad_s": p["speed_rad_s"],
    }


_cogging_fields = _renamed(cogging_Nm="amplitude_Nm", cogging_periods="periods", cogging_phase="phase")
_ripple_fields = _renamed(ripple="amplitude", ripple_periods="periods", ripple_phase="phase")
_friction_fields = _renamed(friction_forward_Nm="forward_Nm", friction_backward_Nm="backward_Nm")
_heating_fields = _renamed(heat_per_W="rise_per_W", heat_s="time_constant_s")
_cogging_draw = _periodic_draw("amplitude_Nm", 0.01, 0.1)
_ripple_draw = _periodic_draw("amplitude", 0.02, 0.2)

_ROWS = (
    Hidden("", "coulomb_friction", _coulomb_draw, _coulomb_fields, ("torque_Nm",)),
    Hidden("", "stribeck_friction", _stribeck_draw, _stribeck_fields, ("coulomb_Nm", "static_Nm")),
    Hidden("", "asymmetric_friction", _asymmetric_draw, _friction_fields, ("forward_Nm", "backward_Nm")),
    Hidden("", "quadratic_drag", _one("drag", 3e-7, 3e-6), _renamed(drag="drag"), ("drag",)),
    Hidden("", "cogging_torque", _cogging_draw, _cogging_fields, ("amplitude_Nm",)),
    Hidden("", "torque_ripple", _ripple_draw, _ripple_fields, ("amplitude",), limits=(1e-4, 5.0)),
    Hidden(
        "",
        "constant_load",
        _signed(_one("torque_Nm", 0.02, 0.1), "torque_Nm"),
        _renamed(load_Nm="torque_Nm"),
        ("torque_Nm",),
    ),
    Hidden("", "shaft_compliance", _compliance_draw, _coupled, (), ("stiffness",), limits=(1e-2, 10.0)),
    Hidden("", "gear_backlash", _backlash_draw, _backlash_fields, ("gap_rad",), limits=(0.05, 10.0)),
    Hidden(
        "",
        "brush_voltage_drop",
        _one("voltage_V", 0.1, 1.0),
        _renamed(brush_V="voltage_V"),
        ("voltage_V",),
        limits=(1e-4, 5.0),
    ),
    Hidden("", "resistance_heating", _heating_draw, _heating_fields, ("rise_per_W",)),
    Hidden(
        "",
        "torque_constant_saturation",
        _one("saturation", 5e-6, 5e-5),
        _renamed(kt_saturation="saturation"),
        ("saturation",),
    ),
    Hidden(
        "",
        "inductance_saturation",
        _one("saturation", 5e-5, 5e-4),
        _renamed(l_saturation="saturation"),
        ("saturation",),
        limits=(1e-4, 50.0),
    ),
    Hidden("", "input_dead_zone", _one("width_V", 0.1, 0.6), _renamed(dead_zone_V="width_V"), ("width_V",)),
    Hidden(
        "",
        "speed_sensor_lag",
        _one("time_constant_s", 1e-3, 5e-3),
        _renamed(lag_s="time_constant_s"),
        ("time_constant_s",),
        limits=(2e-2, 10.0),
    ),
    Hidden("", "speed_sensor_delay", _one("delay_s", 1e-3, 4e-3), _renamed(delay_s="delay_s"), ("delay_s",)),
    Hidden(
        "",
        "current_sensor_offset",
        _signed(_one("offset_A", 0.1, 1.0), "offset_A"),
        _renamed(offset_A="offset_A"),
        ("offset_A",),
    ),
)
LIBRARY: Mapping[str, Hidden] = {row.name: row for row in _ROWS if row.name}
NAMES = tuple(LIBRARY)


# ------------------------------------------------------------------------------------ other formulas


def _variant(label: str, name: str, also: Callable[[Generator], Parameters]) -> Hidden:
    """An effect of the library with further constants of the plant, and the same name."""
    row = LIBRARY[name]

    def draw(rng: Generator, plant: Plant) -> Parameters:
        return row.draw(rng, plant) | {f"plant.{n}": v for n, v in also(rng).items()}

    def fields(p: Parameters) -> Parameters:
        extra = {n.removeprefix("plant."): v for n, v in p.items() if n.startswith("plant.")}
        return row.fields(p) | extra

    return Hidden(label, name, draw, fields, row.scaled, row.inverse, row.limits)


def _two_masses_draw(rng: Generator, plant: Plant) -> Parameters:
    first = _heating_draw(rng, plant) | {"time_constant_s": log_uniform(rng, 0.5, 2.0)}
    slow = first["rise_per_W"] * rng.uniform(0.7, 1.5)
    return first | {"slow_rise_per_W": slow, "slow_time_constant_s": log_uniform(rng, 8.0, 30.0)}


def _two_masses_fields(p: Parameters) -> Parameters:
    slow = {"slow_heat_per_W": p["slow_rise_per_W"], "slow_heat_s": p["slow_time_constant_s"]}
    return _heating_fields(p) | slow


def _lugre_draw(rng: Generator, plant: Plant) -> Parameters:
    level, deflection = log_uniform(rng, 0.02, 0.1), log_uniform(rng, 0.02, 0.06)
    return {"torque_Nm": level, "presliding_rad": deflection, "bristle_damping_s": 2e-3}


def _lugre_fields(p: Parameters) -> Parameters:
    stiffness = p["torque_Nm"] / p["presliding_rad"]
    bristles = {"presliding_rad": p["presliding_rad"]}
    return _coulomb_fields(p) | bristles | {"bristle_damping": p["bristle_damping_s"] * stiffness}


_FORMULAS = (
    _variant("stribeck_exponential", "stribeck_friction", lambda rng: {"stribeck_shape": 1.0}),
    _variant("stribeck_lorentz", "stribeck_friction", lambda rng: {"stribeck_shape": 0.0}),
    Hidden("coulomb_lugre", "coulomb_friction", _lugre_draw, _lugre_fields, ("torque_Nm",)),
    Hidden(
        "heating_two_masses",
        "resistance_heating",
        _two_masses_draw,
        _two_masses_fields,
        ("rise_per_W", "slow_rise_per_W"),
    ),
    _variant("brush_smooth", "brush_voltage_drop", lambda rng: {"brush_onset_A": log_uniform(rng, 0.5, 3.0)}),
    _variant("kt_tanh", "torque_constant_saturation", lambda rng: {"kt_curve": 1.0}),
    _variant("kt_hyperbola", "torque_constant_saturation", lambda rng: {"kt_curve": 2.0}),
    _variant("l_hyperbola", "inductance_saturation", lambda rng: {"l_curve": 2.0}),
    _variant(
        "cogging_two_harmonics",
        "cogging_torque",
        lambda rng: {"cogging_second": float(rng.uniform(0.3, 0.7)), "cogging_second_phase": _phase(rng)},
    ),
    _variant("ripple_in_emf_too", "torque_ripple", lambda rng: {"ripple_in_emf": 1.0}),
    _variant("drag_exponent", "quadratic_drag", lambda rng: {"drag_exponent": float(rng.choice([1.75, 2.25]))}),
)
FORMULAS: Mapping[str, Hidden] = {row.label: row for row in _FORMULAS}


# -------------------------------------------------------------------------------------- strangers


def _shake_draw(rng: Generator, plant: Plant) -> Parameters:
    return {"shake_Nm": 0.05, "shake_Hz": log_uniform(rng, 1.0, 25.0), "shake_phase": _phase(rng)}


def _bump_draw(rng: Generator, plant: Plant) -> Parameters:
    speed = rng.uniform(80.0, 180.0)
    width = speed * rng.uniform(0.1, 0.2)
    return {"bump_Nm": 0.1, "bump_speed_rad_s": float(speed), "bump_width_rad_s": float(width)}


def _seizing_draw(rng: Generator, plant: Plant) -> Parameters:
    return {"seizing_Nm": 0.05, "seizing_from_s": float(rng.uniform(1.5, 2.5))}


def _eccentric_draw(rng: Generator, plant: Plant) -> Parameters:
    # never a whole number of periods per turn
    gear = float(rng.integers(5, 30) + rng.uniform(0.2, 0.8))
    return {"eccentric_Nm": 0.05, "eccentric_gear": gear, "eccentric_phase": _phase(rng)}


def _sag_draw(rng: Generator, plant: Plant) -> Parameters:
    return {"sag_ohm": 0.03, "sag_s": log_uniform(rng, 0.02, 0.5)}


def _stranger(label: str, draw: Callable[[Generator, Plant], Parameters], scaled: str) -> Hidden:
    return Hidden(label, None, draw, dict, (scaled,))


_STRANGERS = (
    _stranger("external_periodic_torque", _shake_draw, "shake_Nm"),
    _stranger("friction_bump", _bump_draw, "bump_Nm"),
    _stranger("seizing_bearing", _seizing_draw, "seizing_Nm"),
    _stranger("eccentric_load", _eccentric_draw, "eccentric_Nm"),
    _stranger("supply_sag", _sag_draw, "sag_ohm"),
)
STRANGERS: Mapping[str, Hidden] = {row.label: row for row in _STRANGERS}
