"""The command line: exit status, messages, and destinations of the output; computations are replaced by fakes."""

from __future__ import annotations

import importlib
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import attrs
import pytest
from attrs import evolve
from test_diagnose_report import ambiguous, named
from test_report import fake_identification, partial_identification

from pmdc_jax import cli
from pmdc_jax.errors import InputError
from pmdc_jax.identify.identification import Estimate
from pmdc_jax.report import terminal
from pmdc_jax.runtime.compilation_cache import keep_compiled

HEAVY = ("jax", "numpy", "plotly", "polars", "scipy", "equinox", "diffrax")


def replace_function(monkeypatch, module: str, name: str, function) -> None:
    """Replace a function of a module, also where the package holds a function of the same name."""
    monkeypatch.setattr(importlib.import_module(module), name, function, raising=False)


@pytest.fixture
def faked(monkeypatch, tmp_path, no_terminal):
    """Fakes of reading, identifying, diagnosing and saving, which store their arguments."""
    calls = SimpleNamespace(identify=None, read=[], saved=[], result=fake_identification(400))
    calls.diagnosis = named()

    def identify(recordings, **options):
        calls.identify = (recordings, options)
        if isinstance(calls.result, BaseException):
            raise calls.result
        return calls.result

    def diagnose(recordings, **options):
        identify(recordings, **options)
        return calls.diagnosis

    def read_recording(path, columns=None, to_simulate=False):
        calls.read.append((str(path), columns))
        return Path(path).stem

    def read_recordings(paths, mappings, to_simulate=False):
        return [read_recording(path, mappings) for path in paths]

    def save_motor(path, motor, identification):
        calls.saved.append(path)
        Path(path).write_text("{}")

    replace_function(monkeypatch, "pmdc_jax.identify", "identify", identify)
    replace_function(monkeypatch, "pmdc_jax.diagnose", "diagnose", diagnose)
    for function in (read_recording, read_recordings):
        module = "pmdc_jax.recordings.recording_file"
        replace_function(monkeypatch, module, function.__name__, function)
    replace_function(monkeypatch, "pmdc_jax.motor_file", "save_motor", save_motor)
    monkeypatch.chdir(tmp_path)
    return calls


def refused(capsys, *arguments: str) -> str:
    """The message of a command, which must exit with 2 and print nothing else."""
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pmdc: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize(
    "command", [(), *((c,) for c in ["identify", "diagnose", "simulate", "demo", "tune", "export", "paper"])]
)
def test_help_shows_an_example(capsys, command):
    assert cli.main([*command, "--help"]) == 0
    out, err = capsys.readouterr()
    assert "pmdc" in out.split("\n")[0]
    assert ("Example: pmdc" if command else "Start with: pmdc") in out
    assert err == ""


def test_help_is_quick():
    code = "import sys; from pmdc_jax.cli import main; sys.exit(main(['--help']))"

    def used() -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return children.ru_utime + children.ru_stime

    def time_of_help() -> float:
        """Processor time, which other processes do not affect."""
        start = used()
        shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
        assert b"identify" in shown.stdout
        return used() - start

    assert min(time_of_help() for _ in range(10)) < 0.4


def test_importing_the_command_line_imports_nothing_heavy():
    code = "import sys, pmdc_jax.cli; print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert not set(HEAVY) & set(shown.stdout.split())


def test_the_module_returns_the_status_of_the_command():
    run = [sys.executable, "-m", "pmdc_jax", "identify", "missing.csv"]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("pmdc: missing.csv: ")


def test_identify_passes_on_every_option(faked, capsys):
    arguments = (
        "identify a.csv b.csv --holdout c.csv --seed 7 --column speed=rpm_meas:rpm --tie Kt=Kb"
        " --known R=0.157 --unloaded --effect coulomb_friction --search genetic"
    )
    assert cli.main(arguments.split()) == 0
    recordings, options = faked.identify
    assert callable(options.pop("progress"))
    assert recordings == ["a", "b"]
    assert options == {
        "holdout": ["c"],
        "tie": (("Kt", "Kb"),),
        "known": {"R": 0.157},
        "unloaded": True,
        "effects": ("coulomb_friction",),
        "search": "genetic",
        "seed": 7,
    }
    assert faked.read[0] == ("a.csv", [("speed", "rpm_meas:rpm")])


def test_identify_prints_parameters_and_runs(faked, capsys):
    faked.result = partial_identification()
    assert cli.main(["identify", "a.csv"]) == 0
    out, err = capsys.readouterr()
    for word in (*faked.result.parameters, *faked.result.fit, "at bound", "not identifiable", "157.20"):
        assert word in out
    assert "NaN" not in out
    assert "saturated at 60 A" in err
    assert "Runs without voltage" in err


def test_json_is_all_that_goes_to_standard_output(faked, capsys):
    faked.result = partial_identification()
    assert cli.main(["identify", "a.csv", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["parameters"]["L"]["status"] == "at_bound"
    assert "saturated" in err


def test_outputs_are_written(faked, capsys, tmp_path):
    arguments = "identify a.csv --save motor.json --json fit.json --report fit.html"
    assert cli.main(arguments.split()) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.html", "fit.json", "motor.json"]
    assert json.loads((tmp_path / "fit.json").read_text())["converged"] is True


def test_diagnose_passes_on_every_option(faked, capsys):
    arguments = (
        "diagnose a.csv b.csv --holdout c.csv --seed 7 --column speed=rpm_meas:rpm --tie Kt=Kb"
        " --known R=0.157 --unloaded --search genetic"
    )
    assert cli.main(arguments.split()) == 0
    recordings, options = faked.identify
    assert callable(options.pop("progress"))
    assert recordings == ["a", "b"]
    assert options == {
        "holdout": ["c"],
        "tie": (("Kt", "Kb"),),
        "known": {"R": 0.157},
        "unloaded": True,
        "search": "genetic",
        "seed": 7,
    }
    assert faked.read[0] == ("a.csv", [("speed", "rpm_meas:rpm")])
    out, err = capsys.readouterr()
    assert "Missing: Stribeck friction" in out
    assert err == ""


def test_diagnose_writes_the_requested_files(faked, capsys, tmp_path):
    faked.diagnosis = ambiguous()
    arguments = "diagnose a.csv --save m.json --json d.json --report d.html --experiment next.csv"
    assert cli.main(arguments.split()) == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["d.html", "d.json", "m.json", "next.csv"]
    assert json.loads((tmp_path / "d.json").read_text())["verdict"] == "ambiguous"


def test_diagnose_states_if_there_is_no_experiment_to_write(faked, capsys, tmp_path):
    assert cli.main(["diagnose", "a.csv", "--json", "-", "--experiment", "next.csv"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["verdict"] == "named"
    assert "no experiment" in err
    assert list(tmp_path.iterdir()) == []


def test_diagnose_reports_bad_input_in_one_message(faked, capsys):
    faked.result = InputError("a.csv, line 3", "time runs backwards", "Sort the rows")
    assert "a.csv, line 3: time" in refused(capsys, "diagnose", "a.csv")


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ("", ["Missing command", "pmdc --help"]),
        ("fly", ["fly"]),
        ("identify", ["RUN", "pmdc identify --help"]),
        ("identify a.csv --bogus", ["--bogus"]),
        ("identify a.csv --seed one", ["--seed"]),
        ("identify a.csv --seed -1", ["--seed"]),
        ("identify a.csv --tie Kt", ["--tie Kt", "Kt=Kb"]),
        ("identify a.csv --column speed", ["--column speed", "speed=rpm_meas:rpm"]),
        ("identify a.csv --known R=much", ["--known R=much", "not a number", "SI"]),
        ("identify a.csv --known R=nan", ["--known R=nan", "not a number"]),
        ("identify a.csv --known R=1 --known R=2", ["--known R=1", "also given as 2"]),
        ("identify a.csv --seed 99999999999999999999", ["--seed"]),
        ("identify a.csv --json b.csv", ["--json", "b.csv", ".json"]),
        ("export controller.json --c motor.json", ["--c", "motor.json", ".h"]),
        ("identify a.csv --report nowhere/x.html", ["--report", "nowhere", "does not exist"]),
        ("identify a.csv --save .", ["--save", "folder"]),
        ("identify a.csv --report=", ["--report", "the name is empty"]),
        ("identify a.csv --report x.pdf", ["--report", "x.pdf", ".html"]),
        ("identify a.csv --save x.html", ["--save", "x.html", ".json"]),
        ("identify a.csv --report -", ["--report", "--json"]),
        ("identify a.csv --json a.csv", ["--json", "a.csv", "an input"]),
        ("identify a.csv --json x --report x", ["--report", "the output of --json"]),
        ("diagnose", ["RUN", "pmdc diagnose --help"]),
        ("diagnose a.csv --tie Kt", ["--tie Kt", "Kt=Kb"]),
        ("diagnose a.csv --known R=much", ["--known R=much", "not a number"]),
        ("diagnose a.csv --experiment a.csv", ["--experiment", "an input"]),
        ("diagnose a.csv --json x --experiment x", ["--experiment", "the output of --json"]),
        ("simulate motor.json --input a.csv", ["--out"]),
        ("simulate motor.json --input a.csv --out a.csv", ["--out", "an input"]),
        ("simulate motor.json --input a.csv --out a.pdf", ["a.pdf", ".csv or .parquet"]),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_read(faked, capsys, arguments, names):
    message = refused(capsys, *arguments.split())
    assert all(name in message for name in names), message
    assert faked.identify is None
    assert faked.read == []


@pytest.mark.parametrize(
    ("problem", "text"),
    [
        (InputError("a.csv, line 3", "time runs backwards", "Sort the rows"), "a.csv, line 3: time"),
        (FileNotFoundError(2, "No such file or directory", "a.csv"), "a.csv: No such file"),
        (OSError(28, "No space left on device"), "No space left"),
    ],
)
def test_bad_input_is_reported_in_one_message(faked, capsys, problem, text):
    faked.result = problem
    assert text in refused(capsys, "identify", "a.csv")


def test_an_interrupt_exits_with_130(faked, capsys):
    faked.result = KeyboardInterrupt()
    assert cli.main(["identify", "a.csv"]) == 130
    assert capsys.readouterr() == ("", "pmdc: interrupted\n")


def test_an_interrupted_search_writes_its_results_and_exits_with_130(faked, capsys):
    search = attrs.evolve(faked.result.search, interrupted=True)
    faked.result = attrs.evolve(faked.result, search=search)
    assert cli.main(["identify", "a.csv", "--json", "result.json"]) == 130
    assert "pmdc: interrupted" in capsys.readouterr().err
    assert Path("result.json").exists()


def test_a_defect_of_the_program_is_not_hidden(faked):
    faked.result = ZeroDivisionError("a bug")
    with pytest.raises(ZeroDivisionError):
        cli.main(["identify", "a.csv"])


def test_simulate_reads_simulates_and_writes(faked, monkeypatch, capsys):
    written = []
    replace_function(monkeypatch, "pmdc_jax.simulate", "simulate", lambda motor, run: (motor, run))
    replace_function(
        monkeypatch,
        "pmdc_jax.recordings.recording_file",
        "write_recording",
        lambda run, path: written.append((run, path)),
    )
    assert cli.main(["simulate", "motor.json", "--input", "drive.csv", "--out", "out.csv"]) == 0
    assert written == [((Path("motor.json"), "drive"), Path("out.csv"))]


@pytest.fixture
def faked_tuning(monkeypatch):
    """Fakes of tuning, which stores its arguments, and of writing its results."""
    calls = SimpleNamespace(tune=None)

    def tune(motor, controller, **options):
        calls.tune = (motor, controller, options)
        return SimpleNamespace(law="law", messages=())

    def write(path, content=None):
        Path(path).write_text("")

    replace_function(monkeypatch, "pmdc_jax.control.pipeline", "tune", tune)
    replace_function(monkeypatch, "pmdc_jax.control.controller_file", "save_controller", write)
    replace_function(
        monkeypatch, "pmdc_jax.report.tuning.page", "write_tuning_report", lambda tuning, path: write(path)
    )
    replace_function(monkeypatch, "pmdc_jax.report.tuning.tables", "tuning_tables", lambda tuning: "gains")
    return calls


def test_demo_writes_into_its_folder(faked, faked_tuning, capsys, tmp_path):
    assert cli.main(["demo", "--out", "deep/tour"]) == 0
    names = {path.name for path in (tmp_path / "deep" / "tour").iterdir()}
    reports = {"report.html", "diagnosis.json", "motor.json", "tuning.html", "controller.json"}
    assert names == reports
    motor, controller, options = faked_tuning.tune
    assert (motor, controller) == (Path("deep/tour/motor.json"), "pid")
    recordings, options = faked.identify
    assert [path.stem for path in recordings] == ["staircase", "prbs", "triangle", "loaded"]
    assert [path.stem for path in options["holdout"]] == ["drive"]
    assert "report.html" in capsys.readouterr().out


def test_demo_refuses_a_file_as_folder(faked, capsys, tmp_path):
    (tmp_path / "taken").write_text("")
    assert "taken" in refused(capsys, "demo", "--out", "taken")
    assert faked.identify is None


def test_demo_refuses_a_folder_that_cannot_be_made(faked, capsys, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied", "tour")

    monkeypatch.setattr(Path, "mkdir", refuse)
    message = refused(capsys, "demo", "--out", "tour")
    assert "--out: the folder tour cannot be made (Permission denied). Choose" in message


def test_no_progress_is_printed_without_a_terminal(faked, capsys):
    assert cli.main(["identify", "a.csv"]) == 0
    faked.identify[1]["progress"]("searching", fitness=1.0)
    assert capsys.readouterr().err == ""


def test_progress_is_shown_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with terminal.progress() as report:
        report("searching, generation 12", fitness=1.0234, fraction=0.4)
        report("refining")
    out, err = capsys.readouterr()
    assert out == ""
    assert "refining" in err


CACHE = "JAX_COMPILATION_CACHE_DIR"


def cache_folder(monkeypatch, **environment: str) -> str | None:
    """The cache folder that JAX is given in this environment."""
    monkeypatch.setattr("os.environ", environment)
    keep_compiled()
    return environment.get(CACHE)


def test_compiled_code_goes_to_the_users_cache(monkeypatch, tmp_path):
    folder = cache_folder(monkeypatch, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "c"))
    assert "pmdc_jax" in folder
    assert not Path(folder).exists()  # JAX makes it when it has something to store


def test_environment_variables_set_the_folder_of_compiled_code(monkeypatch, tmp_path):
    assert Path(cache_folder(monkeypatch, PMDC_CACHE=str(tmp_path / "new"))).parent.name == "new"
    assert cache_folder(monkeypatch, PMDC_CACHE=str(tmp_path), **{CACHE: "mine"}) == "mine"


def test_no_compiled_code_is_kept_if_disabled_or_impossible(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    assert cache_folder(monkeypatch, PMDC_CACHE="") is None
    assert cache_folder(monkeypatch, PMDC_CACHE=str(tmp_path / "file")) is None
    assert cache_folder(monkeypatch, PMDC_CACHE=str(tmp_path / "file" / "below")) is None
    monkeypatch.setattr("os.access", lambda *_: False)
    assert cache_folder(monkeypatch, PMDC_CACHE=str(tmp_path)) is None


def test_only_the_command_keeps_compiled_code(faked, monkeypatch, tmp_path):
    environment = {"PMDC_CACHE": str(tmp_path)}
    monkeypatch.setattr("os.environ", environment)
    assert cli.main(["identify", "a.csv"]) == 0  # called by a program
    assert CACHE not in environment
    monkeypatch.setattr("sys.argv", ["pmdc", "identify", "a.csv"])
    assert cli.main() == 0
    assert environment[CACHE].startswith(str(tmp_path))


@pytest.mark.parametrize(
    ("code", "kept"), [("import pmdc_jax, pmdc_jax.cli", False), ("from pmdc_jax.cli import main; main()", True)]
)
def test_jax_keeps_what_the_command_compiles(tmp_path, code, kept):
    code = f"{code}\nimport jax; jax.jit(lambda x: x + 1)(1.0)"
    environment = {n: v for n, v in os.environ.items() if not n.startswith("JAX_")}
    environment["PMDC_CACHE"] = str(tmp_path)
    run = [sys.executable, "-c", code, "--help"]
    subprocess.run(run, check=True, capture_output=True, env=environment)
    assert bool(list(tmp_path.rglob("*-cache"))) == kept


def test_a_parameter_without_a_value_is_printed(faked, capsys):
    R = Estimate(None, None, None, "ohm", "not_identifiable")
    faked.result = evolve(faked.result, parameters=faked.result.parameters | {"R": R})
    assert cli.main(["identify", "a.csv"]) == 0
    row = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("R "))
    assert row.split() == ["R", "–", "Ω", "–", "–", "not", "identifiable"]
