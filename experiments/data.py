"""The folder of the measured records: PMDC_DATA, otherwise ../shared/data."""

import os
from pathlib import Path

BESIDE = Path(__file__).parents[2] / "shared" / "data"
OWNERS = {
    "emps": (
        "It belongs to A. Janot (ONERA), M. Gautier (LS2N) and M. Brunot: see 'Data Set and "
        "Reference Models of EMPS', Workshop on Nonlinear System Identification Benchmarks, 2019"
    ),
    "undcmotor": ("It belongs to the makers of the UNDCMotor laboratory motor, who publish it under the MIT licence"),
}


def data_folder() -> Path:
    """The folder of all records, which may be absent."""
    return Path(os.environ.get("PMDC_DATA") or BESIDE)


def available(name: str) -> bool:
    """Whether there is a folder of this name among the records."""
    return (data_folder() / name).is_dir()


def data_file(name: str, file: str) -> Path:
    """A file of the records `name`; exits with one message if it is absent."""
    path = data_folder() / name / file
    if not path.is_file():
        raise SystemExit(
            f"{path} is absent. {OWNERS[name]}. Put it there, or name the folder that holds "
            f"{name}/ in the environment variable PMDC_DATA."
        )
    return path
