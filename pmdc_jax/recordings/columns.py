"""The meaning of column headers: quantity, and conversion of the unit to SI."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from shlex import quote

from attrs import evolve, frozen

from ..errors import InputError
from .units import UnitError, conversion


@frozen
class Quantity:
    """One canonical column.

    **Fields**: `header`, written to files; `units`, the SI units it is converted to, that of a rotating shaft first and
    that of a linear axis second; `names`, recognised without a unit; `symbols`, recognised only with one.
    """

    header: str
    units: tuple[str, ...]
    names: tuple[str, ...]
    symbols: tuple[str, ...] = ()


QUANTITIES = {
    "time": Quantity("time_s", ("s",), ("time", "t", "zeit", "elapsed_time"), ("t", "timestamp")),
    "voltage": Quantity(
        "voltage_V",
        ("V",),
        (
            "voltage",
            "motor_voltage",
            "armature_voltage",
            "terminal_voltage",
            "spannung",
            "motorspannung",
            "ankerspannung",
            "klemmenspannung",
        ),
        ("u", "v", "ua", "u_a", "va", "v_a"),
    ),
    "current": Quantity(
        "current_A",
        ("A",),
        ("current", "motor_current", "armature_current", "strom", "motorstrom", "ankerstrom"),
        ("i", "ia", "i_a"),
    ),
    "speed": Quantity(
        "speed_rad_s",
        ("rad/s", "m/s"),
        (
            "speed",
            "motor_speed",
            "shaft_speed",
            "rotor_speed",
            "angular_speed",
            "velocity",
            "angular_velocity",
            "omega",
            "winkelgeschwindigkeit",
        ),
        # a bare "Drehzahl" or "n" is nearly always in 1/min, so these need their unit
        ("w", "n", "v", "drehzahl", "motordrehzahl", "rotational_speed"),
    ),
    "load": Quantity(
        "load_torque_Nm", ("N m", "N"), ("load_torque", "load", "load_force", "lastmoment", "lastdrehmoment")
    ),
    "angle": Quantity(
        "angle_rad",
        ("rad", "m"),
        ("angle", "shaft_angle", "motor_angle", "rotor_angle", "theta", "winkel", "drehwinkel"),
        ("phi", "pos", "position"),
    ),
    "temperature": Quantity(
        "temperature_C",
        ("degC",),
        ("temperature", "temp", "temperatur", "motor_temperature", "winding_temperature"),
        ("t",),
    ),
    "torque": Quantity(
        "torque_Nm",
        ("N m", "N"),
        ("torque", "motor_torque", "motor_force", "motormoment", "antriebsmoment"),
        ("force",),
    ),
}


# Symbols with a suffix for the motor, such as u_motor and Vmot, which need no unit
MOTOR_SYMBOLS = {
    quantity: re.compile(rf"({symbol})_?(mot|motor|arm|armature)")
    for quantity, symbol in {"voltage": "u|v", "current": "i", "speed": "w|omega"}.items()
}
# Quantities recognised by their unit, if only one column has it; a torque, which may also be that of the motor, only if
# its name has a word of `LOADS`
RECOGNISED_BY_UNIT = ("time", "voltage", "current", "speed", "angle", "load")
LOADS = re.compile(r"(?i)(?<![a-z])(load|last|brak|brems|dyno)")
# Names of columns that are the time if they hold dates with times; numbers need a unit
DATED = ("timestamp", "time_stamp", "datetime", "date_time", "date", "datum")
# The layout of times of the day in a header, as in Time [hh:mm:ss.fff]
CLOCK_LAYOUT = re.compile(r"(?i)\s*[\[(]\s*h+:m+(:s+)?[.,\w]*\s*[\])]$")
# Words in the names of columns that hold a set point rather than a measurement
COMMANDED = re.compile(r"(?i)(?<![a-z])(ref|set|soll|cmd|command|target|demand|desired)")
# ... and in those of columns that hold a limit or a supply rather than what is at the motor
NOT_AT_MOTOR = re.compile(r"(?i)(?<![a-z])(limit|max|min|supply|bat)")


@frozen
class Column:
    """A header understood: SI value = scale * number + offset.

    `unit` is None where the header names none and SI was assumed; `base` is the SI unit; `by_unit` is true where the
    quantity was recognised by the unit alone.
    """

    header: str
    quantity: str
    unit: str | None
    base: str
    scale: float = 1.0
    offset: float = 0.0
    by_unit: bool = False


def match_columns(headers: Sequence[str], columns: Mapping[str, str] | None, where: str) -> dict[str, Column]:
    """Which header holds which quantity.

    **Arguments**: `headers` of the file; `columns`, the mapping of the user from quantity to "header[:[-]unit]", which
    takes precedence, and where a minus reverses the sign; `where`, the file, for messages.

    **Returns**: the columns by quantity.

    **Raises**: `InputError` for unknown names or units, and if two headers mean the same quantity.
    """
    if not isinstance(columns, Mapping | None):
        what = f"columns is {columns!r}, not a mapping"
        raise InputError(where, what, 'Write for example {"speed": "rpm_meas:rpm"}')
    by_hand = [_by_hand(name, spec, headers, where) for name, spec in (columns or {}).items()]
    matched = {column.quantity: column for column in by_hand}
    _refuse_shared(matched, where)
    taken = {column.header for column in matched.values()}
    refused: dict[str, InputError] = {}
    understood: dict[str, Column] = {}
    for header in headers:
        try:
            column = understand(header)
        except UnitError as error:
            mend = f"Write it as in {QUANTITIES[error.quantity].header}, or map it with --column"
            refused[error.quantity] = InputError(f"{where}, column {header}", str(error), mend)
            continue
        if column is None or column.quantity in matched or header in taken:
            continue
        if column.quantity in understood:
            raise _ambiguous_headers(understood[column.quantity], column, where)
        understood[column.quantity] = column
    matched |= understood
    matched |= _match_by_unit_or_symbol(headers, matched)
    # neither a temperature nor, beside a voltage, a torque of the motor is used
    needless = {"temperature", "torque"} if "voltage" in matched else {"temperature"}
    for quantity, error in refused.items():
        if quantity not in matched.keys() | needless:
            raise error
    return matched


def _match_by_unit_or_symbol(headers: Sequence[str], matched: Mapping[str, Column]) -> dict[str, Column]:
    """Quantities recognised by the unit or the motor symbol of exactly one of the remaining headers."""
    taken = {column.header for column in matched.values()}
    free = [header for header in headers if header not in taken]
    known: dict[str, Column] = {}
    for quantity in (q for q in RECOGNISED_BY_UNIT if q not in matched):
        alike = _of_unit(free, quantity, commanded=False)
        if symbol := MOTOR_SYMBOLS.get(quantity):
            marked = (header for header in free if symbol.fullmatch(_normalised(header)))
            alike += [_column(header, quantity, None) for header in marked]
        if quantity == "voltage" and not alike:  # a bridge applies about what it is told to
            alike = _of_unit(free, quantity, commanded=True)
        if len(alike) == 1:
            known[quantity] = alike[0]
    return known


def _of_unit(headers: Sequence[str], quantity: str, *, commanded: bool) -> list[Column]:
    """The headers with a shaft unit of the quantity and a name that goes with it, of measurements or of set points."""
    columns, units = [], QUANTITIES[quantity].units[:1]
    for header in headers:
        readings = ((name, unit) for name, unit, _ in _readings(header) if unit and _is_unit_of(unit, quantity, units))
        name, unit = next(readings, ("", None))
        fits = bool(COMMANDED.search(name)) == commanded and not NOT_AT_MOTOR.search(name)
        if unit and fits and (quantity != "load" or LOADS.search(name)):
            columns.append(evolve(_column(header, quantity, unit), by_unit=True))
    return columns


def understand(header: str) -> Column | None:
    """What a header such as `Speed [rpm]`, `u / V` or `time_ms` means; None if it is not recognised.

    **Raises**: `UnitError` if the name identifies the quantity but the unit in brackets does not measure it.
    """
    if _normalised(header) == "rpm":
        return _column(header, "speed", "rpm")
    for name, unit, explicit in _readings(header):
        key = _normalised(name)
        named = [q for q, known in QUANTITIES.items() if key in known.names]
        if unit is None and named:
            return _column(header, named[0], None)
        if unit is None:
            continue
        meant = [q for q, quantity in QUANTITIES.items() if key in quantity.names + quantity.symbols]
        fitting = [q for q in meant if _is_unit_of(unit, q)]
        if len(fitting) == 1:
            return _column(header, fitting[0], unit)
        if explicit and named and len(meant) == 1:
            return _column(header, named[0], unit)  # raises: the unit is wrong
    stem, dot, leaf = header.rpartition(".")
    column = understand(leaf) if dot and stem else None  # a path into a MATLAB structure
    return column and evolve(column, header=header)


def likely_quantity(header: str) -> str | None:
    """The quantity that an unused header may hold: the one whose name it begins with, such as speed for `speed_kg`; or
    the load for a unit of torque, as in `M_Nm`; else None."""
    readings = [(name, unit) for name, unit, _ in _readings(header) if unit is not None]
    for name, _ in readings:
        for quantity, known in QUANTITIES.items():
            if _normalised(name) in known.names:
                return quantity
    torque = QUANTITIES["load"].units[:1]
    return "load" if any(_is_unit_of(unit, "load", torque) for _, unit in readings) else None


def may_be_dates(header: str) -> bool:
    """Whether a header is that of a column of dates with times, or of times of the day."""
    name = CLOCK_LAYOUT.sub("", header)
    return _normalised(header) in DATED or (name != header and _normalised(name) in QUANTITIES["time"].names)


def column_option(quantity: str, header: str, unit: str = "") -> str:
    """The option that maps a header, to be pasted into a shell."""
    return f"--column {quote(f'{quantity}={header}' + (unit and f':{unit}'))}"


def mixed_axes(matched: Mapping[str, Column]) -> tuple[Column, Column] | None:
    """A column in units of a shaft (rad, N m) and one in those of a linear axis (m, N); None without both."""
    sorts: dict[bool, Column] = {}
    for quantity in ("speed", "angle", "load", "torque"):
        column = matched.get(quantity)
        if column and column.unit:
            sorts.setdefault(column.base == QUANTITIES[quantity].units[1], column)
    return (sorts[False], sorts[True]) if len(sorts) == 2 else None


def _by_hand(name: str, spec: str, headers: Sequence[str], where: str) -> Column:
    option = f"{where}, --column {name}={spec}"
    quantity = quantity_named(name, option)
    header, unit = header_and_unit(spec, headers)
    if header not in headers:
        listed = ", ".join(headers[:20]) or "none"
        raise InputError(option, f"the file has no column '{header}'", f"Its columns are: {listed}")
    sign, unit = -1.0 if unit.startswith("-") else 1.0, unit.removeprefix("-")
    try:
        column = _column(header, quantity, unit or _unit_in_header(header, quantity))
        return evolve(column, scale=sign * column.scale)
    except UnitError as error:
        mend = f"Write for example {column_option(name, header, QUANTITIES[quantity].units[0])}"
        if quantity == "angle":
            mend += f", or {column_option(name, header, 'rev/2000')} for 2000 counts per turn"
        raise InputError(option, str(error), mend) from None


def quantity_named(name: str, option: str) -> str:
    """The quantity that a mapping names; an `InputError` about the `option` if there is none of that name."""
    quantity = "load" if name == "load_torque" else name
    if quantity not in QUANTITIES:
        mend = f"Write QUANTITY=HEADER, with one of {', '.join(QUANTITIES)} as the quantity"
        raise InputError(option, f"unknown quantity '{name}'", mend)
    return quantity


def header_and_unit(spec: str, headers: Sequence[str]) -> tuple[str, str]:
    """The header, which may be none of these, and the unit, if any, of the mapping "header[:[-]unit]"."""
    header, unit = spec, ""
    if spec not in headers:
        header, _, unit = (part.strip() for part in spec.rpartition(":"))
        # nor is the colon in brackets, as of the columns of a MATLAB matrix, followed by a unit
        is_split = header and unit.count(")") <= unit.count("(")
        header, unit = (header, unit) if is_split else (spec.strip(), "")
    # `header` may lack the unit that was read from the line below the names
    named = [h for h in headers if h.rpartition(" [")[0] == header]
    if header not in headers and len(named) == 1:
        (header,) = named
    return header, unit


def _unit_in_header(header: str, quantity: str) -> str | None:
    """The unit in a header, whose name need not be recognised."""
    for _, unit, explicit in _readings(header):
        if unit is not None and (explicit or _is_unit_of(unit, quantity)):
            return unit
    return None


def _column(header: str, quantity: str, unit: str | None) -> Column:
    if unit is None:
        return Column(header, quantity, None, QUANTITIES[quantity].units[0])
    return Column(header, quantity, unit, *conversion(unit, quantity, QUANTITIES[quantity].units))


def _readings(header: str) -> Iterator[tuple[str, str | None, bool]]:
    """Ways to split a header into name and unit, the most certain first; True if the unit is in brackets."""
    header = header.strip()
    # a colon in brackets is MATLAB notation for a column or a row of a matrix
    if brackets := re.fullmatch(r"(.*?)[\s_]*[\[({]\s*([^:]*?)\s*[\])}]", header):
        name, unit = brackets.groups()
        yield name, None if unit in ("", "-") else unit, True
        return
    yield header, None, False
    if marked := re.fullmatch(r"(.*?)\s*(?:/|,|\bin\b)\s*(.+)", header):
        yield marked[1], marked[2], False
    for cut in reversed([match.start() for match in re.finditer(r"[_ ]", header)]):
        yield header[:cut], header[cut + 1 :], False


def _normalised(name: str) -> str:
    name = name.strip().casefold().replace("ω", "omega").replace("θ", "theta").replace("φ", "phi")
    return re.sub(r"\W+|_+", "_", name).strip("_")


def _is_unit_of(unit: str, quantity: str, units: tuple[str, ...] | None = None) -> bool:
    try:
        conversion(unit, quantity, units or QUANTITIES[quantity].units)
    except UnitError:
        return False
    return True


def _refuse_shared(matched: Mapping[str, Column], where: str) -> None:
    by_header: dict[str, str] = {}
    for quantity, column in matched.items():
        other = by_header.setdefault(column.header, quantity)
        if other != quantity:
            what = f"--column maps '{column.header}' to both {other} and {quantity}"
            raise InputError(where, what, "Give each quantity a column of its own")


def _ambiguous_headers(first: Column, second: Column, where: str) -> InputError:
    return InputError(
        f"{where}, columns {first.header} and {second.header}",
        f"both mean {first.quantity}",
        f"Choose one, for example with {column_option(first.quantity, second.header)}",
    )
