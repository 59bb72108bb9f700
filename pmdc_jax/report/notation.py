"""Numbers, units and names in engineering notation: 157.3 mΩ, not 0.157312 ohm."""

from __future__ import annotations

import re
from collections.abc import Iterable
from math import floor, isfinite, log10

from attrs import evolve, frozen

from ..effects import EFFECTS, form_with, range_of
from ..identify.identification import Estimate, Role, Status

UNKNOWN = "–"
NARROW_SPACE = "\u202f"  # narrow no-break space
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
PARAMETER_NAMES = {
    "R": "armature resistance",
    "L": "armature inductance",
    "Kb": "back-EMF constant",
    "Kt": "torque constant",
    "J": "inertia",
    "f": "viscous friction",
}
SEARCH_NAMES = {
    "cma_es": "CMA-ES",
    "paper_ga": "Genetic algorithm of the wheelchair paper",
    "differential_evolution": "Differential evolution",
    "particle_swarm": "Particle swarm",
}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@frozen
class EstimateText:
    """An estimate as texts: value, standard error and interval share one scaled unit and number of decimals."""

    value: str
    stderr: str
    interval: str
    relative: str  # standard error in per cent of the value
    unit: str


def write_estimate(estimate: Estimate) -> EstimateText:
    """Write an estimate with as many decimals as give its standard error two significant digits; a known value has no
    error."""
    if estimate.status == "known":
        estimate = evolve(estimate, stderr=None, ci95=None)
    value, stderr = estimate.value or 0.0, estimate.stderr or 0.0
    exponent = engineering_exponent(max(abs(value), stderr), estimate.unit)
    scale = 10.0**exponent
    decimals = _decimals(value / scale, stderr / scale)

    def write(number: float | None) -> str:
        return fixed(None if number is None else number / scale, decimals)

    interval = UNKNOWN
    if estimate.ci95 is not None:
        interval = f"{write(estimate.ci95[0])} … {write(estimate.ci95[1])}"
    relative = UNKNOWN
    if estimate.stderr is not None and estimate.value:
        relative = percent(100 * estimate.stderr / abs(estimate.value))
    unit = scaled_unit(estimate.unit, exponent)
    return EstimateText(write(estimate.value), write(estimate.stderr), interval, relative, unit)


def significant(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits, as a power of ten if very large or small; a dash if it is unknown."""
    if value is None or not isfinite(value):
        return UNKNOWN
    if value and not -5 < _magnitude(value) < 6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa.replace('-', '−')}×10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return fixed(value, max(0, digits - 1 - _magnitude(value)))


def estimate_words(estimate: Estimate) -> str:
    """An estimate in running text, without its error: "61.20 mN·m"."""
    written = write_estimate(estimate)
    return f"{written.value} {written.unit}".strip()


def value_with_unit(value: float, unit: str, digits: int = 3) -> str:
    """A number with its scaled unit: (0.00321, "N m") as "3.21 mN·m"."""
    exponent = engineering_exponent(value, unit)
    scaled = significant(value / 10.0**exponent, digits)
    return f"{scaled} {scaled_unit(unit, exponent)}".strip()


def thousands(count: int) -> str:
    """A count in groups of three digits, separated by narrow no-break spaces."""
    return f"{count:,}".replace(",", NARROW_SPACE)


def engineering_exponent(value: float, unit: str) -> int:
    """The power of ten, a multiple of three, that leaves 1 to 999; 0 for a number without unit from 0.001 to 1e6."""
    if not value or not isfinite(value) or (not unit and 1e-3 <= abs(value) < 1e6):
        return 0
    return max(-12, min(9, 3 * floor(log10(abs(value)) / 3)))


def scaled_unit(unit: str, exponent: int) -> str:
    """The unit with its prefix: ("N m/A", -3) as "mN·m/A"; a power of ten instead for kg..., 1/... and no unit."""
    unit = pretty_unit(unit)
    if not exponent:
        return unit
    if not unit or unit.startswith(("kg", "1/")):
        return f"×10{str(exponent).translate(_SUPERSCRIPT)} {unit}".strip()
    return PREFIXES[exponent] + unit


def pretty_unit(unit: str) -> str:
    """ "kg m^2" as "kg·m²", "ohm" as "Ω"."""
    unit = unit.replace("ohm", "Ω").replace("**", "^").replace("*", " ")
    for power in "23":
        unit = unit.replace(f"^{power}", power.translate(_SUPERSCRIPT))
    return "·".join(unit.split())


def percent(value: float | None) -> str:
    """A percentage with two significant digits, three from 10 on, and two decimals from 90 to 100 (fits)."""
    if value is None or not isfinite(value):
        return UNKNOWN
    if 90 < abs(value) <= 100:
        return f"{fixed(value, 2)}{NARROW_SPACE}%"
    return f"{significant(value, 3 if abs(value) >= 10 else 2)}{NARROW_SPACE}%"


def fixed(value: float | None, decimals: int) -> str:
    """A number with fixed decimals and a true minus sign, none before zero; a dash if it is unknown."""
    if value is None or not isfinite(value):
        return UNKNOWN
    written = f"{value:.{decimals}f}"
    return written.replace("-", "−" if float(written) else "")


def status_word(status: Status) -> str:
    """The status of an estimate as printed in all reports."""
    return status.replace("_", " ")


def role_word(role: Role) -> str:
    """The role of a run as printed in all reports."""
    return "hold-out" if role == "holdout" else "training"


def formula_text(effect: str, fields: Iterable[str] = ()) -> str:
    """The formula of an effect, in the form that has these parameters; the speed is ω."""
    return re.sub(r"\bw(?![a-zA-Z0-9])", "ω", form_with(effect, fields).formula).replace("-", "−")


def effect_words(effect: str) -> str:
    """An effect in running text: "Coulomb friction", "dead zone of the input"."""
    label = EFFECTS[effect].label
    named_after_someone = label.startswith(("Coulomb", "Stribeck"))
    return label if named_after_someone else label[0].lower() + label[1:]


def field_words(effect: str, field: str) -> str:
    """A parameter of an effect without the unit in its name: "time constant" for time_constant_s."""
    unit = range_of(effect, field).unit
    suffix = unit.removeprefix("1/").replace(" ", "").replace("^", "").replace("/", "_")
    if field == f"per_{suffix}":
        return "coefficient"
    return field.removesuffix(f"_{suffix}").removesuffix("_per").replace("_", " ")


def parameter_words(effect: str, field: str) -> str:
    """ "Stribeck friction, static"."""
    return f"{effect_words(effect)}, {field_words(effect, field)}"


def p_value_words(p_value: float) -> str:
    """ "p < 0.001" or "p = 0.21"."""
    return "p < 0.001" if p_value < 1e-3 else f"p = {significant(p_value, 2)}"


def _decimals(value: float, stderr: float) -> int:
    if stderr > 0 and isfinite(stderr):
        return max(0, min(6, 1 - _magnitude(stderr)))
    return max(0, 3 - _magnitude(value))


def _magnitude(value: float) -> int:
    return floor(log10(abs(value))) if value and isfinite(value) else 0
