"""The command line: parse, call one function, print, exit status.

Slow imports are inside the commands, so that help and usage errors come at once.
"""

# ruff: noqa: B006  typer copies default lists

from __future__ import annotations

import atexit
import gc
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from .errors import InputError
from .files import check_outputs
from .options import (
    Column,
    Controller,
    ControllerFile,
    CurrentLimit,
    CurrentSensor,
    Delay,
    Effect,
    Experiment,
    Folder,
    HeaderFile,
    Holdout,
    Input,
    Json,
    Known,
    LoadTorque,
    MaxOvershoot,
    MaxSettling,
    MotorFile,
    Output,
    Report,
    Runs,
    SampleTime,
    Save,
    SaveController,
    Search,
    Seed,
    Setpoint,
    SpeedNoise,
    SpeedStep,
    Spread,
    Tie,
    Unloaded,
    VoltageLimit,
    fit_options,
    pairs,
)
from .runtime.compilation_cache import keep_compiled

if TYPE_CHECKING:
    from rich.console import RenderableType

    from .identify.identification import Identification

Result = TypeVar("Result")

# exit statuses
DONE = 0
BAD_INPUT = 2
INTERRUPTED = 130

app = typer.Typer(
    name="pmdc",
    help="Identify, diagnose and control brushed permanent-magnet DC motors from recorded data.",
    epilog="Start with: pmdc demo",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help is shorter and takes half the time
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


@app.command(epilog="Example: pmdc identify step.csv chirp.csv --holdout drive.csv --report motor.html")
def identify(
    runs: Runs,
    holdout: Holdout = [],
    save: Save = None,
    json: Json = None,
    report: Report = None,
    seed: Seed = 0,
    column: Column = [],
    tie: Tie = [],
    known: Known = [],
    unloaded: Unloaded = False,
    effect: Effect = [],
    search: Search = "cma_es",
) -> int:
    """Identify the parameters of a motor from recordings.

    Estimates R, L, Kb, Kt, J and f from voltage, current and speed, each with its standard error,
    and reports which of them the recordings do not determine. Runs without current or voltage are
    used for what they determine.
    """
    check_outputs({"--save": save, "--json": json, "--report": report}, [*runs, *holdout])
    columns = pairs("--column", column)
    options = fit_options(tie, known, unloaded, search, seed) | {"effects": tuple(effect)}
    from .identify import identify

    identification = _read_and_fit(identify, runs, holdout, columns, options)
    from .report.identification.json import identification_json
    from .report.identification.tables import identification_tables
    from .report.terminal import print_findings

    print_findings(identification)
    _print_and_write(identification, json, identification_json, identification_tables)
    _save(identification, save)
    if report:
        from .report.identification.page import write_identification_report

        write_identification_report(identification, report)
    return _status(identification)


@app.command(epilog="Example: pmdc diagnose *.csv --holdout drive.csv --report diagnosis.html --save motor.json")
def diagnose(
    runs: Runs,
    holdout: Holdout = [],
    save: Save = None,
    json: Json = None,
    report: Report = None,
    experiment: Experiment = None,
    seed: Seed = 0,
    column: Column = [],
    tie: Tie = [],
    known: Known = [],
    unloaded: Unloaded = False,
    search: Search = "cma_es",
) -> int:
    """Find physical effects that are missing from the motor model.

    Shows where simulation and measurement disagree, names the missing effect, adds it to the model,
    and shows how much of the disagreement it removes. --save writes the extended motor.
    """
    outputs = {"--save": save, "--json": json, "--report": report, "--experiment": experiment}
    check_outputs(outputs, [*runs, *holdout])
    columns = pairs("--column", column)
    options = fit_options(tie, known, unloaded, search, seed)
    from .diagnose import diagnose

    diagnosis = _read_and_fit(diagnose, runs, holdout, columns, options)
    from .report.diagnosis.json import diagnosis_json
    from .report.diagnosis.tables import diagnosis_tables
    from .report.terminal import print_findings

    print_findings(diagnosis.final)
    _print_and_write(diagnosis, json, diagnosis_json, diagnosis_tables)
    _save(diagnosis.final, save)
    if experiment:
        from .report.experiment import write_experiment

        if not write_experiment(diagnosis, experiment):
            typer.echo(f"note: no experiment was designed, so {experiment} was not written", err=True)
    if report:
        from .report.diagnosis.page import write_diagnosis_report

        write_diagnosis_report(diagnosis, report)
    return _status(diagnosis.final)


@app.command(epilog="Example: pmdc simulate motor.json --input drive.csv --out simulated.csv")
def simulate(motor: MotorFile, input: Input, out: Output, column: Column = []) -> None:
    """Simulate a motor with a recorded input voltage.

    Voltage and load are read from the recording; current and speed are written to another file.
    """
    check_outputs({"--out": out}, [motor, input])
    columns = pairs("--column", column)
    from .recordings.recording_file import check_recording_suffix, read_recordings, write_recording
    from .simulate import simulate

    check_recording_suffix(out)
    (driven,) = read_recordings([input], columns, to_simulate=True)
    write_recording(simulate(motor, driven), out)


@app.command(epilog="Example: pmdc tune motor.json --controller pid --setpoint 481 --voltage-limit 30")
def tune(
    motor: MotorFile,
    controller: Controller,
    setpoint: Setpoint = None,
    voltage_limit: VoltageLimit = None,
    current_limit: CurrentLimit = None,
    sample_time: SampleTime = None,
    max_overshoot: MaxOvershoot = 1.0,
    max_settling: MaxSettling = None,
    load_torque: LoadTorque = None,
    delay: Delay = 1,
    speed_step: SpeedStep = None,
    speed_noise: SpeedNoise = None,
    current_sensor: CurrentSensor = True,
    spread: Spread = None,
    save: SaveController = None,
    json: Json = None,
    report: Report = None,
    seed: Seed = 0,
) -> None:
    """Tune the gains of a speed controller.

    Tunes on the sampled loop with its delay and limits and over the uncertainty of the motor, and
    compares with the fastest settling possible within the voltage and current limits.
    """
    check_outputs({"--save": save, "--json": json, "--report": report}, [motor])
    from .control.pipeline import tune
    from .report.terminal import print_messages, progress

    with progress() as on_progress:
        tuning = tune(
            motor,
            controller,
            setpoint=setpoint,
            voltage_limit=voltage_limit,
            current_limit=current_limit,
            sample_time=sample_time,
            max_overshoot=max_overshoot,
            max_settling=max_settling,
            load_torque=load_torque,
            delay=delay,
            speed_step=speed_step,
            speed_noise=speed_noise,
            measures_current=current_sensor,
            spread=None if spread is None else spread / 100,
            seed=seed,
            progress=on_progress,
        )
    from .report.tuning.json import tuning_json
    from .report.tuning.tables import tuning_tables

    print_messages(tuning.messages)
    _print_and_write(tuning, json, tuning_json, tuning_tables)
    if save:
        from .control.controller_file import save_controller

        save_controller(save, tuning.law)
    if report:
        from .report.tuning.page import write_tuning_report

        write_tuning_report(tuning, report)


@app.command(epilog="Example: pmdc export controller.json --c controller.h")
def export(controller: ControllerFile, c: HeaderFile) -> None:
    """Write a controller as C code.

    One C99 header: the sampled control law with its limits and anti-windup.
    """
    check_outputs({"--c": c}, [controller])
    from .control.controller_file import load_controller
    from .control.export import export

    export(load_controller(controller), c)


@app.command(epilog="Example: pmdc paper --out paper_out")
def paper(out: Folder = Path("paper_out")) -> None:
    """Reproduce the wheelchair-motor paper.

    Prints its tables beside ours, and writes paper.html and paper.json with its figures to a folder.
    """
    from .paper.pipeline import paper
    from .report.paper.tables import paper_tables
    from .report.terminal import print_tables, progress

    with progress() as on_progress:
        result = paper(out, progress=on_progress)
    print_tables(paper_tables(result))
    for name in ("paper.html", "paper.json"):
        typer.echo(out / name)


@app.command(epilog="Example: pmdc demo --out tour")
def demo(out: Folder = Path("demo_out"), seed: Seed = 0) -> None:
    """Run a demonstration on a packaged sample.

    Identifies and diagnoses four runs, validates on a fifth, tunes a controller, and writes results and
    reports to a folder.
    """
    from .demo import FILES, demo
    from .report.diagnosis.tables import diagnosis_tables
    from .report.terminal import print_findings, print_messages, print_tables, progress
    from .report.tuning.tables import tuning_tables

    with progress() as on_progress:
        diagnosis, tuning = demo(out, seed=seed, progress=on_progress)
    print_findings(diagnosis.final)
    print_tables(diagnosis_tables(diagnosis))
    print_messages(tuning.messages)
    print_tables(tuning_tables(tuning))
    for name in FILES:
        typer.echo(out / name)


def _read_and_fit(
    fit: Callable[..., Result],
    runs: list[Path],
    holdout: list[Path],
    columns: list[tuple[str, str]],
    options: dict[str, Any],
) -> Result:
    """Read the runs and call `fit`, which is `identify` or `diagnose`, on them, showing progress."""
    from .recordings.recording_file import read_recordings
    from .report.terminal import progress

    with progress() as on_progress:
        recordings = read_recordings([*runs, *holdout], columns)
        train, held_out = recordings[: len(runs)], recordings[len(runs) :]
        return fit(train, holdout=held_out, progress=on_progress, **options)


def _status(identification: Identification) -> int:
    """The exit status: results of a search that was interrupted are written, but count as interrupted."""
    return INTERRUPTED if identification.search.interrupted else DONE


def _save(identification: Identification, path: Path | None) -> None:
    """Save the motor if a path is given."""
    if path:
        from .motor_file import save_motor

        save_motor(path, identification.motor, identification)


def _print_and_write(
    result: Result,
    json: str | None,
    as_json: Callable[[Result], dict[str, Any]],
    tables: Callable[[Result], RenderableType],
) -> None:
    """Print tables, unless JSON goes to standard output; write JSON if a path is given.

    Printed first, so that the result is not lost if a file cannot be written.
    """
    if json != "-":
        from .report.terminal import print_tables

        print_tables(tables(result))
    if json:
        from .report.json import write_json

        write_json(as_json(result), json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    **Arguments**: `arguments`, those of the process if None; the process is then taken to do nothing else, and so keeps
    what JAX compiles for later processes, and collects garbage rarely.

    **Returns**: the exit status: 0 done, 2 bad input or arguments, 130 interrupted.
    """
    if arguments is None:
        keep_compiled()
        _collect_garbage_rarely()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # an Ω must not fail on an old code page
    try:
        status = app(args=arguments, prog_name="pmdc", standalone_mode=False) or DONE
    except typer.TyperException as error:
        return _print_bad_input(_usage_message(error))
    except InputError as error:
        return _print_bad_input(str(error))
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _print_bad_input(f"{place}{error.strerror or error}")
    except typer.Abort:
        status = INTERRUPTED
    if status == INTERRUPTED:
        print("pmdc: interrupted", file=sys.stderr)
    return status


def _collect_garbage_rarely() -> None:
    """Save an eighth of the time of a command: the millions of objects that it imports and traces live until it ends,
    yet the garbage collector would scan them repeatedly, and once more at exit."""
    gc.set_threshold(100_000, 50, 50)
    atexit.register(gc.freeze)


def _print_bad_input(message: str) -> int:
    print(f"pmdc: {message}", file=sys.stderr)
    return BAD_INPUT


def _usage_message(error: typer.TyperException) -> str:
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "pmdc"
    return f"{error.format_message().rstrip('.')}. See {command} --help"
