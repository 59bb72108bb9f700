"""The tour: identify and diagnose the motor of the packaged sample and report on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from .diagnose.diagnosis import Diagnosis
    from .report.terminal import ReportProgress

SAMPLE = Path(__file__).parent / "sample"
TRAINING = ("staircase", "prbs", "triangle", "loaded")
HOLDOUT = ("drive",)


def demo(
    out: str | Path = "demo_out", seed: int = 0, progress: ReportProgress | None = None
) -> Diagnosis:
    """Diagnose the packaged sample; write report.html, motor.json and diagnosis.json to `out`.

    **Arguments**: `out`, a folder, made where it does not exist; `seed` of the search; `progress`,
    called now and then with what is being done.

    **Returns**: the diagnosis, whose `final` is the identification of the completed motor.
    """
    folder = result_folder(Path(out), "report.html")
    from .diagnose import diagnose
    from .motor_file import save_motor
    from .recording import read_recording
    from .report.diagnosis import write_diagnosis
    from .report.json import diagnosis_json, write_json

    training, held_out = (
        [read_recording(SAMPLE / f"{name}.csv") for name in names] for names in (TRAINING, HOLDOUT)
    )
    diagnosis = diagnose(training, holdout=held_out, seed=seed, progress=progress)
    save_motor(folder / "motor.json", diagnosis.final.motor, diagnosis.final)
    write_json(diagnosis_json(diagnosis), folder / "diagnosis.json")
    write_diagnosis(diagnosis, folder / "report.html")
    return diagnosis


def result_folder(path: Path, first: str) -> Path:
    """Make the folder now, and see whether a file `first` can be written there: better to fail before the work than
    after it."""
    from .report.files import check_writable

    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError("--out", f"{path} is not a folder", "Name a new folder") from None
    check_writable("--out", path / first)
    return path
