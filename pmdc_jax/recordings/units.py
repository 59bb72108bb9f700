"""Conversion of units, in the spellings common in log files, to SI with pint."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint

# Replaces pint's default registry, in which angles are dimensionless, so that 1/s, Hz and rad/s are alike, and "Nm" is
# not a newton metre; it also takes a second to build. Here an angle is a dimension.
UNITS = """
nano- = 1e-9 = n-
micro- = 1e-6 = µ- = μ- = u-
milli- = 1e-3 = m-
kilo- = 1e3 = k-
mega- = 1e6 = M-
second = [time] = s = sec
minute = 60 * second = min
hour = 3600 * second = h
meter = [length] = m = metre
centimeter = 0.01 * meter = cm
kilogram = [mass] = kg
ampere = [current] = A = amp
kelvin = [temperature]; offset: 0 = K
degree_Celsius = kelvin; offset: 273.15 = degC = degreeC = celsius = C
degree_Fahrenheit = 5 / 9 * kelvin; offset: 233.15 + 200 / 9 = degF = degreeF = fahrenheit
newton = kilogram * meter / second ** 2 = N
newton_meter = newton * meter = Nm
newton_centimeter = 0.01 * newton_meter = Ncm = cNm
inch = 0.0254 * meter
foot = 12 * inch
gram_force = 9.80665e-3 * newton = gf
pound_force = 453.59237 * gram_force = lbf
ounce_force = pound_force / 16 = ozf
volt = newton * meter / ampere / second = V
radian = [angle] = rad
degree = 0.017453292519943295 * radian = deg
turn = 6.283185307179586 * radian = rev = revolution
rpm = turn / minute
rps = turn / second
"""
# Further spellings of rpm, most of which omit the turn, and of turns per second; 1/s and Hz may mean rad/s, too
RPM = ("1/min", "min^-1", "min-1", "min⁻¹", "/min", "u/min", "upm", "r/min", "r.p.m.", "r.p.m")
TURNS: dict[str, str] = {**dict.fromkeys(RPM, "rpm"), "kr/min": "krpm", "r/s": "rps", "u/s": "rps"}
# Torques as weights by lengths, such as oz-in and kgf.cm, and the other way round, as in ft-lb
WEIGHT, LENGTH = r"(?P<weight>oz|lb|kg|g)f?s?", r"(?P<length>in|ft|cm)"
WEIGHT_BY_LENGTH = tuple(
    re.compile(rf"{one}[\s_.·*\-]*{other}", re.I) for one, other in ((WEIGHT, LENGTH), (LENGTH, WEIGHT))
)
# Between the factors of a unit, as in N_m; not the minus of a sign or an exponent
SEPARATOR = r"(?<=\w)[_.\-](?=[^\W\d])"


class UnitError(ValueError):
    """The unit of `quantity` is unknown or measures another quantity; the message says which."""

    def __init__(self, quantity: str, why: str) -> None:
        self.quantity = quantity
        super().__init__(why)


def conversion(unit: str, quantity: str, bases: Sequence[str]) -> tuple[str, float, float]:
    """The conversion of a unit to SI.

    **Arguments**: `unit`, as found in a header, or a fraction of one, such as rev/2000 for counts of an encoder;
    `quantity`, for the message; `bases`, the SI units allowed, in order of preference.

    **Returns**: the SI unit, scale and offset: SI value = scale * number + offset.

    **Raises**: `UnitError` if `unit` is unknown or converts to none of `bases`.
    """
    fraction = re.fullmatch(r"(.*\w)\s*/\s*(\d+(?:\.\d+)?)", unit)
    if fraction and float(fraction[2]):
        base, scale, offset = conversion(fraction[1], quantity, bases)
        return base, scale / float(fraction[2]), offset
    unknown = True
    for spelling in _spellings(unit):
        for base in bases:
            try:
                return base, *_convert(spelling, base)
            except ArithmeticError:
                unknown = False
            except LookupError:
                pass
    units = " or ".join(bases)
    if unknown:
        raise UnitError(quantity, f"unknown unit '{unit}' for {quantity} ({units})")
    raise UnitError(quantity, f"'{unit}' does not measure {quantity} ({units})")


def _spellings(unit: str) -> Iterator[str]:
    """The unit as written, then other readings: rad_s as rad/s, N_m as N m, RPM as rpm."""
    unit = unit.strip()
    if unit.casefold() in TURNS:
        yield TURNS[unit.casefold()]
    for pattern in WEIGHT_BY_LENGTH:
        if torque := pattern.fullmatch(unit):
            length = torque["length"].lower().replace("in", "inch").replace("ft", "foot")
            yield f"{torque['weight'].lower()}f * {length}"
    for text in dict.fromkeys((unit, unit.lower())):
        yield text
        if re.search(SEPARATOR, text):
            yield re.sub(SEPARATOR, " ", text)
            yield text.replace("_", "/", 1)


@cache
def _convert(unit: str, base: str) -> tuple[float, float]:
    """Scale and offset; `LookupError` if the unit is unknown, `ArithmeticError` if incompatible."""
    if unit in (base, base.replace(" ", ""), base.replace("/", "_")):
        return 1.0, 0.0  # saves the import of pint, 0.1 s
    import pint

    try:
        parsed = _registry().Unit(unit)
    except Exception:  # pint raises many kinds, even those of the tokenizer
        raise LookupError(unit) from None
    try:
        zero, one = (_registry().Quantity(x, parsed).to(base).magnitude for x in (0.0, 1.0))
    except pint.DimensionalityError:
        raise ArithmeticError(unit) from None
    return one - zero, zero


@cache
def _registry() -> pint.UnitRegistry:
    import pint

    registry = pint.UnitRegistry(None)  # pyright: ignore[reportArgumentType]
    registry.load_definitions(UNITS.strip().splitlines())
    return registry
