"""Options of the commands, and parsing of their values."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from .errors import InputError

Runs = Annotated[
    list[Path],
    typer.Argument(metavar="RUN", help="Recordings to fit, one run a file: CSV, Parquet or MAT."),
]
Holdout = Annotated[
    list[Path],
    typer.Option(metavar="RUN", help="A run kept out of the fit to test it. Repeatable."),
]
Save = Annotated[
    Path | None, typer.Option(metavar="MOTOR.json", help="Write the motor, for pmdc simulate.")
]
Json = Annotated[
    str | None,
    typer.Option(metavar="OUT", help="Write the result as JSON; - is standard output."),
]
Report = Annotated[
    Path | None, typer.Option(metavar="OUT.html", help="Write a report with pictures.")
]
Experiment = Annotated[
    Path | None,
    typer.Option(
        metavar="OUT.csv", help="Write the voltage to record next, where these runs cannot tell."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the search.")]
Column = Annotated[
    list[str],
    typer.Option(
        metavar="QUANTITY=HEADER:UNIT",
        help="What a column holds, where its header does not say. Repeatable.",
    ),
]
Tie = Annotated[
    list[str],
    typer.Option(metavar="A=B", help="Two parameters that are one, such as Kt=Kb. Repeatable."),
]
Known = Annotated[
    list[str],
    typer.Option(metavar="NAME=VALUE", help="A parameter known from elsewhere, in SI. Repeatable."),
]
Unloaded = Annotated[
    bool, typer.Option("--unloaded", help="Runs without a load column have no load at all.")
]
Effect = Annotated[
    list[str],
    typer.Option(
        metavar="NAME", help="An effect to identify too, such as coulomb_friction. Repeatable."
    ),
]
Search = Annotated[str, typer.Option(metavar="NAME", help="The global search.")]
MotorFile = Annotated[
    Path, typer.Argument(metavar="MOTOR.json", help="Written by pmdc identify --save.")
]
Input = Annotated[
    Path, typer.Option("--input", metavar="RUN", help="Recording that drives the motor.")
]
Output = Annotated[
    Path, typer.Option("--out", metavar="RUN_OUT", help="Where it goes: .csv or .parquet.")
]
Controller = Annotated[
    str,
    typer.Option(metavar="NAME", help="pi, pid, state-feedback or state-feedback-integral."),
]
Setpoint = Annotated[float | None, typer.Option(metavar="RAD_S", help="Speed to go to.")]
VoltageLimit = Annotated[
    float | None, typer.Option(metavar="V", help="Voltage there is, in either direction.")
]
CurrentLimit = Annotated[
    float | None, typer.Option(metavar="A", help="Current that is allowed, none if not given.")
]
SampleTime = Annotated[
    float | None, typer.Option(metavar="S", help="Of the controller. 1 ms, or less if needed.")
]
MaxOvershoot = Annotated[
    float, typer.Option(metavar="PCT", help="Overshoot that is allowed, % of the step.")
]
MaxSettling = Annotated[
    float | None, typer.Option(metavar="S", help="Settling time that is asked for.")
]
LoadTorque = Annotated[
    float | None, typer.Option(metavar="NM", help="Load step that has to be withstood.")
]
Delay = Annotated[int, typer.Option(metavar="SAMPLES", help="From measurement to voltage: 0 or 1.")]
SpeedStep = Annotated[
    float | None, typer.Option(metavar="RAD_S", help="Quantum of the speed sensor.")
]
SpeedNoise = Annotated[float, typer.Option(metavar="RAD_S", help="Noise of the speed sensor, rms.")]
CurrentSensor = Annotated[bool, typer.Option(help="Whether the controller measures the current.")]
Spread = Annotated[
    float | None,
    typer.Option(
        metavar="PCT", help="Spread of each parameter; else as uncertain as the file says."
    ),
]
SaveController = Annotated[
    Path | None,
    typer.Option(metavar="CONTROLLER.json", help="Write the controller, for pmdc export."),
]
ControllerFile = Annotated[
    Path, typer.Argument(metavar="CONTROLLER.json", help="Written by pmdc tune --save.")
]
HeaderFile = Annotated[Path, typer.Option("--c", metavar="CONTROLLER.h", help="Where the C goes.")]
Folder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")]


def fit_options(
    tie: list[str], known: list[str], unloaded: bool, search: str, seed: int
) -> dict[str, Any]:
    """The keyword arguments that `identify` and `diagnose` have in common."""
    return {
        "tie": tuple(pairs("--tie", tie)),
        "known": {name: _number("--known", name, text) for name, text in pairs("--known", known)},
        "unloaded": unloaded,
        "search": search,
        "seed": seed,
    }


def pairs(option: str, texts: list[str]) -> list[tuple[str, str]]:
    """The two sides of every value of an option such as `--tie Kt=Kb`."""
    return [_pair(option, text) for text in texts]


def _pair(option: str, text: str) -> tuple[str, str]:
    """Split "Kt=Kb" into ("Kt", "Kb")."""
    left, equals, right = (part.strip() for part in text.partition("="))
    if not (left and equals and right):
        examples = {"--column": "speed=rpm_meas:rpm", "--tie": "Kt=Kb", "--known": "R=0.157"}
        raise InputError(
            f"{option} {text}",
            "this is not a pair",
            f"Write for example {option} {examples[option]}",
        )
    return left, right


def _number(option: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        mend = f"Write the value in SI units, for example {option} {name}=0.157"
        raise InputError(f"{option} {name}={text}", f"'{text}' is not a number", mend)
    return value
