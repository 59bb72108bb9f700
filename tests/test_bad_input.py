"""Invalid recordings: each is refused with a message that names the file and the problem.

`cases()` is the table of invalid files, with their arguments on the command line.
"""

from __future__ import annotations

import gzip
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest
from scipy.io import savemat

from pmdc_jax.errors import InputError
from pmdc_jax.identify.prepare import prepare
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.recordings.recording_file import read_recording, write_recording

HEADER = "time_s,voltage_V,current_A,speed_rad_s"


class Case(NamedTuple):
    """`write` puts files into a folder and returns their paths and further command line arguments;
    the message must hold `fragment`."""

    name: str
    write: Callable[[Path], tuple[list[Path], list[str]]]
    fragment: str


def rows(count=20, columns=4, start=0.0, step=0.01):
    """Lines of a valid recording."""
    values = np.random.default_rng(0).normal(size=(count, columns)).round(4)
    values[:, 0] = start + step * np.arange(count)
    return [",".join(f"{x:.6g}" for x in row) for row in values]


def csv(*lines, name="run.csv", args=(), encoding="utf-8", end="\n"):
    """Write these lines."""

    def write(folder):
        path = folder / name
        path.write_bytes((end.join(lines) + end).encode(encoding))
        return [path], list(args)

    return write


def with_line(line, text, header=HEADER, **kwargs):
    """A valid file with one line (counted from 1) replaced."""
    lines = [header, *rows(columns=header.count(",") + 1)]
    lines[line - 1] = text
    return csv(*lines, **kwargs)


def raw(content, name="run.csv"):
    """Write these bytes."""

    def write(folder):
        (folder / name).write_bytes(content)
        return [folder / name], []

    return write


def mat(name="run.mat", **variables):
    """Write a MATLAB file."""

    def write(folder):
        savemat(folder / name, variables)
        return [folder / name], []

    return write


def frame(name="run.parquet", **columns):
    """Write a Parquet file."""

    def write(folder):
        pl.DataFrame(columns).write_parquet(folder / name)
        return [folder / name], []

    return write


def absent(folder):
    """A path without a file."""
    return [folder / "absent.csv"], []


def folder_instead_of_file(folder):
    """A folder named like a file."""
    (folder / "run.csv").mkdir()
    return [folder / "run.csv"], []


def mapped(*columns, header="a,b,c,d"):
    """A file whose columns are mapped by hand."""
    args = [part for column in columns for part in ("--column", column)]
    return csv(header, *rows(), args=args)


def good_mat(**changes):
    """Variables of a valid MATLAB file with changes."""
    t = np.arange(50) * 0.01
    return {"time_s": t, "voltage_V": np.sin(t), "speed_rad_s": np.cos(t)} | changes


def nan_share(share, column):
    """A file in which this share of the cells of one column is empty."""
    lines = [HEADER]
    for k, line in enumerate(rows(100)):
        cells = line.split(",")
        if (k % 10) < 10 * share:
            cells[column] = ""
        lines.append(",".join(cells))
    return csv(*lines)


def cases() -> Iterator[Case]:
    """The table of cases."""
    yield Case("missing file", absent, "no such file")
    yield Case("folder", folder_instead_of_file, "folder")
    yield Case("empty file", raw(b""), "the file is empty")
    yield Case("only blank lines", raw(b"\n\n \n"), "no header")
    yield Case("only a byte order mark", raw(b"\xef\xbb\xbf"), "no header")
    yield Case("header only", csv(HEADER), "no rows")
    yield Case("one sample", csv(HEADER, *rows(1)), "at least 10")
    yield Case("nine samples", csv(HEADER, *rows(9)), "9 samples")
    yield Case("no header", csv(*rows()), "line 1: the first line holds numbers")
    yield Case("no time column", csv("index,voltage_V,current_A,speed_rad_s", *rows()), "no time column")
    yield Case("nothing useful", csv("time_s,a,b,c", *rows()), "columns in the file: time_s, a, b, c")
    yield Case("voltage alone", csv("time_s,voltage_V", *rows(columns=2)), "too few columns")
    yield Case("speed alone", csv("time_s,speed_rad_s", *rows(columns=2)), "too few columns")
    yield Case("blanks separate", csv("time_s voltage_V speed_rad_s", "0 1 2"), "separate them by")
    yield Case("text in a column", with_line(7, "0.05,1,oops,2"), "line 7, column current_A: 'oops' is not")
    yield Case(
        "line of wrong units",
        csv("time,voltage,current,speed", "s,V,A,furlong", *rows()),
        "column speed [furlong]: unknown unit 'furlong'",
    )
    yield Case("clock time", with_line(2, "12:00:01,1,2,3"), "line 2, column time_s: '12:00:01'")
    yield Case(
        "days or months",
        csv("time,voltage_V,speed_rpm", *[f"03/0{1 + k // 6}/2026 12:00:{k},1,2" for k in range(12)]),
        "line 2, column time: '03/01/2026 12:00:0' may begin with the day or the month",
    )
    yield Case(
        "text after comments",
        csv("# bench 3", "", HEADER, "# begin", *rows(12), "", "0.5,1,x,2"),
        "line 18, column current_A: 'x'",
    )
    yield Case(
        "decimal comma between commas",
        csv("time_s,voltage_V,speed_rad_s", *["0,01,1,0,2,0"] * 20),
        "line 2: it has 6 fields",
    )
    yield Case("a thousand's comma", with_line(5, '0.03,"1,234",1,1'), "line 5, column voltage_V")
    yield Case("long row", with_line(9, "0.07,1,2,3,4"), "line 9: it has 5 fields")
    yield Case("short row", with_line(11, "0.09,1"), "line 11: it has 2 fields")
    yield Case("cut off in the middle", with_line(21, "0.19,0."), "line 21: it has 2 fields")
    yield Case("unclosed quote", with_line(6, '0.04,"1,2,3'), "run.csv")
    yield Case(
        "Latin-1 header",
        csv("time_s,voltage_V,Winkel [°]", *rows(columns=3), encoding="latin-1"),
        "line 1: byte 26 (0xb0) is not UTF-8",
    )
    yield Case("Latin-1 later", with_line(8, "0.06,1,2,3 µ", encoding="latin-1"), "line 8: byte")
    yield Case("UTF-16", csv(HEADER, *rows(), encoding="utf-16"), "UTF-16")
    yield Case("binary junk", raw(bytes(range(256)) * 20), "not a text file")
    yield Case("gzip named csv", raw(gzip.compress(b"time_s" * 99)), "run.csv")
    yield Case("unknown suffix", raw(b"PK\x03\x04", "run.xlsx"), "unknown file type '.xlsx'")
    yield Case("no suffix", csv(HEADER, *rows(), name="run"), "unknown file type ''")
    yield Case("duplicate columns", csv("time_s,voltage_V,speed_rad_s,speed_rad_s", *rows()), "'speed_rad_s' 2 times")
    yield Case(
        "two columns for one quantity",
        csv("time_s,voltage_V,speed_rad_s,Speed [rpm]", *rows()),
        "columns speed_rad_s and Speed [rpm]: both mean speed",
    )
    yield Case(
        "unknown unit",
        csv("time_s,voltage_V,current_A,speed [furlong]", *rows()),
        "column speed [furlong]: unknown unit 'furlong'",
    )
    yield Case("speed in kg", csv("time_s,voltage_V,current_A,speed [kg]", *rows()), "'kg' does not measure speed")
    yield Case("speed in Hz", csv("time_s,voltage_V,current_A,speed [1/s]", *rows()), "'1/s' does not measure speed")
    yield Case("time goes backwards", with_line(12, "0.02,1,2,3"), "line 12, column time_s: time goes")
    yield Case("two runs in one file", csv(HEADER, *rows(15), *rows(15)), "line 17, column time_s: time goes backwards")
    yield Case("repeated time", with_line(4, "0.01,1,2,3"), "line 4, column time_s: the time stamp")
    yield Case("time rounded away", csv(HEADER, *rows(step=0.0)), "line 3, column time_s: the time stamp")
    yield Case("wrong last time", with_line(21, "1e12,1,2,3"), "line 21, column time_s: a gap of 1e+12 s")
    yield Case(
        "a long gap",
        csv(HEADER, *rows(30), *rows(30, start=2500.0)),
        "line 32, column time_s: a gap of 2500 s in time before it, where most steps are 0.01 s",
    )
    yield Case("time missing", with_line(6, ",1,2,3"), "line 6, column time_s: 1 of 20 values")
    yield Case("voltage missing", with_line(6, "0.04,,2,3"), "line 6, column voltage_V: 1 of 20")
    yield Case("voltage NaN", with_line(3, "0.01,NaN,2,3"), "line 3, column voltage_V: 1 of 20")
    yield Case(
        "load missing",
        with_line(5, "0.03,1,2,NA", header="time_s,voltage_V,speed_rad_s,load_torque_Nm"),
        "line 5, column load_torque_Nm",
    )
    yield Case("infinite speed", with_line(10, "0.08,1,2,inf"), "line 10, column speed_rad_s: 1 inf")
    yield Case("speed mostly missing", nan_share(0.3, 3), "column speed_rad_s: 30 of 100 values are missing")
    yield Case(
        "driving current missing",
        with_line(6, "0.04,,3", header="time_s,current_A,speed_rad_s"),
        "line 6, column current_A",
    )
    yield Case(
        "voltage column empty, nothing else drives",
        csv("time_s,voltage_V,speed_rad_s", *[f"{k / 100},,{k}" for k in range(20)]),
        "only time, speed; nothing is in voltage_V",
    )
    yield Case(
        "speeds that are dates",
        csv("time_s,voltage_V,speed_rpm", *[f"{k},1,2026-03-01 12:00:{k:02}" for k in range(20)]),
        "column speed_rpm: it contains dates",
    )
    yield Case(
        "numbers named timestamp", csv("timestamp,voltage_V,current_A,speed_rpm", *rows()), "there is no time column"
    )
    yield from mapping_cases()
    yield from binary_cases()


def mapping_cases() -> Iterator[Case]:
    """Bad `--column` arguments."""
    three = ("time=a:s", "voltage=b:V")
    yield Case("map to no column", mapped(*three, "speed=z:rpm"), "no column 'z'")
    yield Case("map no quantity", mapped(*three, "torsion=c"), "unknown quantity 'torsion'")
    yield Case("map the wrong way round", mapped(*three, "c=speed"), "Write QUANTITY=HEADER")
    yield Case("map in a wrong unit", mapped(*three, "speed=c:kg"), "'kg' does not measure speed")
    yield Case("map in no unit", mapped(*three, "speed=c:rpn"), "unknown unit 'rpn'")
    for unit in ("A/-1", "A-", "A/0", "0*A", "--A"):
        yield Case(f"map in {unit}", mapped(*three, f"current=c:{unit}"), "for current (A)")
    yield Case("map one to two", mapped(*three, "speed=c:rpm", "current=c:A"), "both speed and current")
    yield Case("map nothing", mapped(*three, "speed="), "no column ''")


def binary_cases() -> Iterator[Case]:
    """Bad MATLAB and Parquet files."""
    yield Case("text named mat", raw(b"time_s,voltage_V\n" * 20, "run.mat"), "not a MATLAB file")
    yield Case("short junk named mat", raw(b"ab", "run.mat"), "not a MATLAB file")
    hdf5 = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" * 20
    yield Case("MATLAB v7.3", raw(hdf5, "run.mat"), "-v7")
    yield Case("mat of texts", mat(note="hello"), "no numeric vectors")
    yield Case("mat of one matrix", mat(data=np.eye(30)), "no time column")
    yield Case("mat without time", mat(**good_mat(time_s="none")), "no time column")
    yield Case(
        "mat of unequal lengths",
        mat(**good_mat(speed_rad_s=np.arange(40.0))),
        "variables speed_rad_s and time_s: 40 and 50 samples",
    )
    yield Case("mat with two speeds", mat(a=good_mat(), b={"speed_rpm": np.arange(50.0)}), "both mean speed")
    yield Case("mat with NaN in time", mat(**good_mat(time_s=np.full(50, np.nan))), "column time_s")
    yield Case("text named parquet", raw(b"time_s,voltage_V\n" * 20, "run.parquet"), "not a Parquet")
    t = [k / 10 for k in range(20)]
    words = ["fast"] * 20
    yield Case(
        "parquet with texts", frame(time_s=t, voltage_V=t, speed_rad_s=words), "column speed_rad_s: it contains String"
    )
    yield Case(
        "parquet with time backwards",
        frame(time_s=t[::-1], voltage_V=t, speed_rad_s=t),
        "row 2, column time_s: time goes backwards",
    )
    yield Case("empty parquet", frame(time_s=[], voltage_V=[], speed_rad_s=[]), "no rows")


def columns_of(args):
    """The mapping in `--column` arguments."""
    return dict(value.split("=", 1) for value in args[1::2])


@pytest.mark.parametrize("case", list(cases()), ids=lambda case: case.name)
def test_an_invalid_file_is_refused_with_a_message_that_names_it_and_the_problem(case, tmp_path):
    paths, args = case.write(tmp_path)
    with pytest.raises(InputError) as caught:
        for path in paths:
            read_recording(path, columns_of(args))
    message = str(caught.value)
    assert case.fragment in message
    assert paths[-1].name in message
    assert "\n" not in message
    assert caught.value.mend


def test_there_are_many_cases_with_distinct_names():
    names = [case.name for case in cases()]
    assert len(names) == len(set(names)) >= 35


def forbid(monkeypatch, mode):
    """Makes it fail to open a file in this mode, since root may open any file."""
    opened = Path.open

    def refuse(self, file_mode="r", *args, **kwargs):
        if mode in file_mode:
            raise PermissionError(13, "Permission denied")
        return opened(self, file_mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", refuse)


def test_a_file_without_read_permission_is_refused(tmp_path, monkeypatch):
    (path,), _ = csv(HEADER, *rows())(tmp_path)
    forbid(monkeypatch, "r")
    with pytest.raises(InputError, match=r"run\.csv: no permission to read"):
        read_recording(path)


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="root may read anything")
def test_a_file_with_mode_0_is_refused(tmp_path):
    (path,), _ = csv(HEADER, *rows())(tmp_path)
    path.chmod(0)
    with pytest.raises(InputError, match=r"run\.csv: no permission to read"):
        read_recording(path)


def good_recording():
    t = np.arange(20) / 10
    return Recording("run", t, voltage=np.sin(t), speed=np.cos(t))


def test_an_output_without_write_permission_is_refused(tmp_path, monkeypatch):
    forbid(monkeypatch, "w")
    with pytest.raises(InputError, match=r"out\.csv: it cannot be written \(Permission denied\)"):
        write_recording(good_recording(), tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "what"), [("absent/out.csv", "No such"), ("out.mat", "of type")])
def test_an_output_in_an_absent_folder_or_of_another_type_is_refused(tmp_path, name, what):
    with pytest.raises(InputError, match=what):
        write_recording(good_recording(), tmp_path / name)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"time": np.zeros(20)}, "sample 2, column time: the time stamp"),
        ({"speed": np.zeros(19)}, "column speed: shape"),
        ({"voltage": None}, "no input column, only time, speed"),
        ({"voltage": np.full(20, np.inf)}, "infinite"),
    ],
)
def test_recordings_made_in_python_are_validated_too(changes, what):
    t = np.arange(20) / 10
    with pytest.raises(InputError, match=what):
        Recording(**{"name": "run", "time": t, "voltage": t, "speed": t} | changes)


def test_a_voltage_alone_is_enough_to_simulate_but_not_to_identify(tmp_path):
    t = np.arange(20) / 10
    run = Recording("run", t, voltage=t)
    with pytest.raises(InputError, match="too few columns to identify a motor, only time, voltage"):
        prepare([run], ())
    write_recording(run, tmp_path / "run.csv")
    with pytest.raises(InputError, match="too few columns to identify a motor, only time, voltage"):
        read_recording(tmp_path / "run.csv")
    assert read_recording(tmp_path / "run.csv", to_simulate=True).speed is None
    (tmp_path / "speed.csv").write_text("time_s,speed_rad_s\n0,0\n0.1,1\n")
    with pytest.raises(InputError, match="no input column, only time, speed"):
        read_recording(tmp_path / "speed.csv", to_simulate=True)


def test_damaged_text_is_read_or_refused_without_another_error(tmp_path):
    rng = np.random.default_rng(0)
    good = "\n".join([HEADER, *rows(12)]).encode()
    path = tmp_path / "run.csv"
    for _ in range(200):
        text = bytearray(good)
        for place in rng.integers(len(good) - 40, size=2):
            piece = bytes(rng.choice(list(b',;\n"#\t -eE.\r9x'), rng.integers(0, 4)).astype(np.uint8))
            text[place : place + rng.integers(0, 4)] = piece
        path.write_bytes(bytes(text))
        try:
            read_recording(path)
        except InputError as error:
            assert str(path) in str(error)


@pytest.mark.parametrize("suffix", [".mat", ".parquet"])
def test_truncated_files_are_refused(tmp_path, suffix):
    if suffix == ".mat":
        mat(**good_mat())(tmp_path)
    else:
        write_recording(good_recording(), tmp_path / "run.parquet")
    path = tmp_path / f"run{suffix}"
    content = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match="run"):
            read_recording(path)
