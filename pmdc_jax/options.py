"""Options of the commands, and parsing of their values."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from .errors import InputError

Runs = Annotated[
    list[Path], typer.Argument(metavar="RUN", help="Recordings to fit, one run per file: CSV, Parquet or MAT.")
]
Holdout = Annotated[
    list[Path], typer.Option(metavar="RUN", help="A run held out of the fit, to validate it. Repeatable.")
]
Save = Annotated[Path | None, typer.Option(metavar="MOTOR.json", help="Save the motor, for pmdc simulate and tune.")]
Json = Annotated[str | None, typer.Option(metavar="OUT", help="Write the result as JSON; - is standard output.")]
Report = Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write an HTML report with figures.")]
Experiment = Annotated[
    Path | None,
    typer.Option(metavar="OUT.csv", help="Write the voltage of the next experiment, if the verdict is ambiguous."),
]
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Random seed of the search.")]
Column = Annotated[
    list[str],
    typer.Option(
        metavar="QUANTITY=HEADER:UNIT",
        help="Quantity and unit of a column whose header is not recognised; -UNIT reverses its sign."
        " For all files with that header. Repeatable.",
    ),
]
Tie = Annotated[list[str], typer.Option(metavar="A=B", help="Two parameters to keep equal, such as Kt=Kb. Repeatable.")]
Known = Annotated[
    list[str], typer.Option(metavar="NAME=VALUE", help="A parameter to fix at a known value, in SI. Repeatable.")
]
Unloaded = Annotated[bool, typer.Option("--unloaded", help="Assume no load in runs without a load column.")]
Effect = Annotated[
    list[str], typer.Option(metavar="NAME", help="An effect to identify as well, such as coulomb_friction. Repeatable.")
]
Search = Annotated[
    str, typer.Option(metavar="NAME", help="Global search: cma_es, paper_ga, differential_evolution or particle_swarm.")
]
MotorFile = Annotated[Path, typer.Argument(metavar="MOTOR.json", help="Motor file, from pmdc identify --save.")]
Input = Annotated[Path, typer.Option("--input", metavar="RUN", help="Recording with the input to simulate.")]
Output = Annotated[Path, typer.Option("--out", metavar="RUN_OUT", help="Output file, .csv or .parquet.")]
Controller = Annotated[str, typer.Option(metavar="NAME", help="pi, pid, state-feedback or state-feedback-integral.")]
Setpoint = Annotated[
    float | None,
    typer.Option(metavar="RAD_S", help="Set point of the speed; by default 80 % of what the voltage limit reaches."),
]
VoltageLimit = Annotated[
    float | None,
    typer.Option(
        metavar="V",
        help="Largest voltage, in either direction; by default 1.25 times what holds the set point,"
        " or 24 V without one.",
    ),
]
CurrentLimit = Annotated[float | None, typer.Option(metavar="A", help="Largest current; unlimited if not given.")]
SampleTime = Annotated[float | None, typer.Option(metavar="S", help="Sample time; by default 1 ms, or less if needed.")]
MaxOvershoot = Annotated[float, typer.Option(min=0, metavar="PCT", help="Largest overshoot, % of the step.")]
MaxSettling = Annotated[float | None, typer.Option(metavar="S", help="Largest settling time.")]
LoadTorque = Annotated[
    float | None,
    typer.Option(
        metavar="NM", help="Load torque step to reject; by default half of what can be held at the set point."
    ),
]
Delay = Annotated[int, typer.Option(metavar="SAMPLES", help="Delay from measurement to voltage: 0 or 1.")]
SpeedStep = Annotated[float | None, typer.Option(metavar="RAD_S", help="Resolution of the speed sensor.")]
SpeedNoise = Annotated[
    float | None,
    typer.Option(
        metavar="RAD_S", help="RMS noise of the speed sensor; by default tuned against that in the motor file."
    ),
]
CurrentSensor = Annotated[bool, typer.Option(help="Whether the controller measures the current.")]
Spread = Annotated[
    float | None,
    typer.Option(min=0, metavar="PCT", help="Standard deviation of each parameter; by default from the motor file."),
]
SaveController = Annotated[
    Path | None, typer.Option(metavar="CONTROLLER.json", help="Save the controller, for pmdc export.")
]
ControllerFile = Annotated[
    Path, typer.Argument(metavar="CONTROLLER.json", help="Controller file, from pmdc tune --save.")
]
HeaderFile = Annotated[Path, typer.Option("--c", metavar="CONTROLLER.h", help="C header file to write.")]
Folder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")]


def fit_options(tie: list[str], known: list[str], unloaded: bool, search: str, seed: int) -> dict[str, Any]:
    """The keyword arguments that `identify` and `diagnose` have in common."""
    fixed = pairs("--known", known)
    for name, text in fixed:
        if dict(fixed)[name] != text:
            what = f"{name} is also given as {dict(fixed)[name]}"
            raise InputError(f"--known {name}={text}", what, "Give each parameter one value")
    return {
        "tie": tuple(pairs("--tie", tie)),
        "known": {name: _number("--known", name, text) for name, text in fixed},
        "unloaded": unloaded,
        "search": search,
        "seed": seed,
    }


def pairs(option: str, texts: list[str]) -> list[tuple[str, str]]:
    """The two sides of every value of an option such as `--tie Kt=Kb`."""
    return [_pair(option, text) for text in texts]


def _pair(option: str, text: str) -> tuple[str, str]:
    """Split "Kt=Kb" into ("Kt", "Kb")."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        examples = {"--column": "speed=rpm_meas:rpm", "--tie": "Kt=Kb", "--known": "R=0.157"}
        raise InputError(
            f"{option} {text}", "this is not of the form A=B", f"Write for example {option} {examples[option]}"
        )
    return name, value


def _number(option: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        mend = f"Write the value in SI units, for example {option} {name}=0.157"
        raise InputError(f"{option} {name}={text}", f"'{text}' is not a number", mend)
    return value
