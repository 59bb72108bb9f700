"""The tour: identify and diagnose the motor of the packaged sample, tune a controller for it, and report on both."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from .files import result_folder
from .progress import ReportProgress

if TYPE_CHECKING:
    from .control.tuning import Tuning
    from .diagnose.diagnosis import Diagnosis

SAMPLE = Path(__file__).parent / "sample"
TRAINING = ("staircase", "prbs", "triangle", "loaded")
HOLDOUT = ("drive",)
FILES = ("report.html", "diagnosis.json", "motor.json", "tuning.html", "controller.json")


class DemoResult(NamedTuple):
    """What the demo found: the diagnosis of the sample, and the controller tuned for its motor."""

    diagnosis: Diagnosis
    tuning: Tuning


def demo(out: str | Path = "demo_out", seed: int = 0, progress: ReportProgress | None = None) -> DemoResult:
    """Diagnose the packaged sample and tune a PID controller for the motor found; write `FILES` to `out`.

    **Arguments**: `out`, a folder, made if missing; `seed` of the searches; `progress`, a callback for progress.

    **Returns**: the diagnosis, whose `final` is the identification of the completed motor, and the tuning.
    """
    folder = result_folder(Path(out), FILES[0])
    from .control.controller_file import save_controller
    from .control.pipeline import tune
    from .diagnose import diagnose
    from .motor_file import save_motor
    from .report.diagnosis.json import diagnosis_json
    from .report.diagnosis.page import write_diagnosis_report
    from .report.json import write_json
    from .report.tuning.page import write_tuning_report

    report, content, motor, page, controller = (folder / name for name in FILES)
    training, held_out = ([SAMPLE / f"{name}.csv" for name in names] for names in (TRAINING, HOLDOUT))
    diagnosis = diagnose(training, holdout=held_out, seed=seed, progress=progress)
    save_motor(motor, diagnosis.final.motor, diagnosis.final)
    write_json(diagnosis_json(diagnosis), content)
    write_diagnosis_report(diagnosis, report)
    tuning = tune(motor, "pid", setpoint=200.0, voltage_limit=18.0, current_limit=20.0, seed=seed, progress=progress)
    save_controller(controller, tuning.law)
    write_tuning_report(tuning, page)
    return DemoResult(diagnosis, tuning)
