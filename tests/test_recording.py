"""Reading and writing recordings, and understanding their headers."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time as clock
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat

from pmdc_jax.errors import InputError
from pmdc_jax.recordings.columns import understand
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.recordings.recording_file import (
    named_apart,
    read_recording,
    read_recordings,
    recordings_of,
    refuse_copies,
    write_recording,
)

T = np.arange(12) * 0.01
NUMBER = {"allow_nan": False, "allow_infinity": False, "width": 64}


def table(header, *columns, separator=","):
    lines = [separator.join(f"{x!r}" for x in map(float, row)) for row in zip(*columns, strict=True)]
    return "\n".join([header, *lines]) + "\n"


def read_text(folder, text, columns=None, name="run.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return read_recording(path, columns)


@st.composite
def recordings(draw):
    count = draw(st.integers(10, 40))
    # less alike, they would have a gap too long for an even clock
    steps = draw(st.floats(1e-6, 1e3)) * draw(arrays(float, count, elements=st.floats(0.5, 10.0, **NUMBER)))
    start = draw(st.floats(-1e3, 1e3, **NUMBER))
    channel = arrays(float, count, elements=st.floats(-1e12, 1e12, **NUMBER))
    optional = ("current", "load", "angle", "temperature", "torque")
    present = {name: draw(channel) for name in optional if draw(st.booleans())}
    present["speed"] = draw(channel)
    present["speed"][3] = np.nan  # a missing sample
    return Recording("run", start + np.cumsum(steps), voltage=draw(channel), **present)


@given(recordings(), st.sampled_from([".csv", ".parquet"]))
@settings(max_examples=40, deadline=None)
def test_written_recordings_are_read_back_exactly(recording, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run{suffix}"
        write_recording(recording, path)
        read_back = read_recording(path)
        assert [file.name for file in Path(folder).iterdir()] == [path.name]
    assert read_back.name == "run" and not read_back.ignored
    has_temperature = recording.temperature is not None
    assert [n.what for n in read_back.notes] == ["a recorded temperature is not used"] * has_temperature
    assert set(read_back.columns()) == set(recording.columns())
    for quantity, values in recording.columns().items():
        np.testing.assert_array_equal(read_back.columns()[quantity], values)


RPM, DEGREE = np.pi / 30, np.pi / 180
LB_IN = 0.45359237 * 9.80665 * 0.0254  # N m
UNDERSTOOD = [
    ("Speed [rpm]", "speed", RPM),
    ("SPEED (RPM)", "speed", RPM),
    ("rpm", "speed", RPM),
    ("Speed, rpm", "speed", RPM),
    ("motor speed rpm", "speed", RPM),
    ("n / min^-1", "speed", RPM),
    ("Drehzahl [1/min]", "speed", RPM),
    ("n in U/min", "speed", RPM),
    ("speed [deg/s]", "speed", DEGREE),
    ("speed_deg_s", "speed", DEGREE),
    ("speed [rev/s]", "speed", 2 * np.pi),
    ("omega (rad/s)", "speed", 1),
    ("ω [rad/s]", "speed", 1),
    ("speed_rad_per_s", "speed", 1),
    ("v [m/s]", "speed", 1),
    ("data.speed_rpm", "speed", RPM),
    ("Current (mA)", "current", 1e-3),
    ("Motorstrom [mA]", "current", 1e-3),
    ("i_A", "current", 1),
    ("u [V]", "voltage", 1),
    ("U / V", "voltage", 1),
    ("v [mV]", "voltage", 1e-3),
    ("Ankerspannung [V]", "voltage", 1),
    ("Angle [deg]", "angle", DEGREE),
    ("Winkel [°]", "angle", DEGREE),
    ("position [mm]", "angle", 1e-3),
    ("time_ms", "time", 1e-3),
    ("Zeit [µs]", "time", 1e-6),
    ("t", "time", 1),
    ("time (Sec)", "time", 1),
    ("load_N_m", "load", 1),
    ("Lastmoment [mNm]", "load", 1e-3),
    ("load_torque [N·m]", "load", 1),
    ("torque [Ncm]", "torque", 1e-2),
    ("load [oz-in]", "load", LB_IN / 16),
    ("load [ozf-in]", "load", LB_IN / 16),
    ("load_oz.in", "load", LB_IN / 16),
    ("torque (lb-in)", "torque", LB_IN),
    ("torque [lbf·ft]", "torque", 12 * LB_IN),
    ("torque [ft-lbs]", "torque", 12 * LB_IN),
    ("torque [kgf·cm]", "torque", 9.80665e-2),
    ("torque [kg-cm]", "torque", 9.80665e-2),
    ("load torque Kgcm", "load", 9.80665e-2),
    ("load [gcm]", "load", 9.80665e-5),
    ("speed [r.p.m.]", "speed", RPM),
    ("speed [r/s]", "speed", 2 * np.pi),
    ("T [°C]", "temperature", 1),
]


@pytest.mark.parametrize(("header", "quantity", "scale"), UNDERSTOOD)
def test_headers_are_understood(header, quantity, scale):
    column = understand(header)
    assert column is not None
    assert column.quantity == quantity
    assert column.scale == pytest.approx(scale, rel=1e-14)


@pytest.mark.parametrize(
    "header",
    [
        "v",
        "i",
        "n",
        "T [Nm]",
        "M [gm]",
        "n [1/s]",
        "n [Hz]",
        "Drehzahl",
        "speed_ref",
        "speed_max",
        "current_limit",
        "u",
        "",
        "[V]",
    ],
)
def test_ambiguous_headers_are_not_understood(header):
    assert understand(header) is None


def test_units_of_temperature_have_an_offset():
    column = understand("winding_temperature [°F]")
    assert column is not None
    assert 212 * column.scale + column.offset == pytest.approx(100)


@given(
    st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{} / {}", "{} in {}"]),
    st.sampled_from(["speed", "Motor Speed", "OMEGA", "angular_velocity"]),
    st.sampled_from([("rpm", RPM), ("deg/s", DEGREE), ("rad/s", 1.0), ("krpm", 1e3 * RPM), ("kr/min", 1e3 * RPM)]),
)
@settings(max_examples=60, deadline=None)
def test_units_are_understood_in_every_notation(pattern, name, unit):
    column = understand(pattern.format(name, unit[0]))
    assert column is not None
    assert (column.quantity, column.scale) == ("speed", pytest.approx(unit[1], rel=1e-14))


def test_a_torque_column_of_unknown_name_is_noted(tmp_path):
    run = read_text(tmp_path, table("time_s,voltage_V,n_rpm,i_A,M_Nm,flag_N", T, T, T, T, T, T))
    (note,) = run.notes
    assert note.column == "M_Nm" and "looks like load" in note.what


@pytest.mark.parametrize("header", ["M_brake (mNm)", "Brake torque [Nm]", "M_Last [Nm]", "dyno torque / Nm"])
def test_a_torque_named_after_a_load_is_the_load(tmp_path, header):
    run = read_text(tmp_path, table(f"time_s,voltage_V,n_rpm,i_A,{header}", T, T, T, T, T))
    assert run.load is not None
    assert run.load[-1] == pytest.approx(T[-1] * (1e-3 if "mNm" in header else 1.0))
    (note,) = run.notes
    assert note.column == header and "because of its name and unit" in note.what


@pytest.mark.parametrize("header", ["M_blast [Nm]", "brake_limit [Nm]", "brake [A]"])
def test_other_columns_are_not_taken_for_a_load(tmp_path, header):
    assert read_text(tmp_path, table(f"time_s,voltage_V,n_rpm,i_A,{header}", T, T, T, T, T)).load is None


def test_columns_are_recognised_by_their_unit_alone(tmp_path):
    run = read_text(tmp_path, table("time_s,U_mot/V,I_mot [mA],n_ist [U/min]", T, T, T, T))
    np.testing.assert_allclose((run.voltage, run.current, run.speed), (T, T / 1e3, T * RPM))
    assert [(n.column, "because of its unit" in n.what) for n in run.notes] == [
        ("U_mot/V", True),
        ("I_mot [mA]", True),
        ("n_ist [U/min]", True),
    ]


def test_columns_are_recognised_by_symbols_of_the_motor(tmp_path):
    run = read_text(tmp_path, table("Time,Vmot,i_motor,RPM", T, T, T, T))
    np.testing.assert_allclose((run.voltage, run.current, run.speed), (T, T, T * RPM))
    # `i` may be a line number as well as a current
    assert read_text(tmp_path, table("i,time_s,u_mot,omega_mot", T, T, T, T)).current is None


def test_columns_with_the_same_unit_are_not_recognised_by_it(tmp_path):
    text = table("time_s,voltage_V,n1 [rpm],n2 [rpm],current_A", T, T, T, T, T)
    run = read_text(tmp_path, text)
    assert run.speed is None and run.ignored == ("n1 [rpm]", "n2 [rpm]")


def test_a_reference_is_not_taken_for_the_measured_speed(tmp_path):
    text = table("time_s,voltage_V,n_soll [rpm],n_ist [rpm],current_A", T, T, T, 2 * T, T)
    np.testing.assert_allclose(read_text(tmp_path, text).speed, 2 * T * RPM)


def test_a_commanded_voltage_is_used_if_none_was_measured(tmp_path):
    run = read_text(tmp_path, table("time_s,u_cmd / V,u_bat / V,I_mot [mA],n_rpm", T, T, 0 * T + 24, T, T))
    np.testing.assert_allclose(run.voltage, T)
    assert ("u_cmd / V", True) in [(n.column, "because of its unit" in n.what) for n in run.notes]
    run = read_text(tmp_path, table("time_s,u_cmd / V,U_mot / V,I_mot [mA],n_rpm", T, 2 * T, T, T, T))
    np.testing.assert_allclose(run.voltage, T)
    assert read_text(tmp_path, table("time_s,voltage_V,i_cmd / A,n_rpm", T, T, T, T)).current is None


def test_columns_are_converted_to_si_and_others_are_listed_as_ignored(tmp_path):
    text = table("time_ms,voltage_V,Speed [rpm],flag", 1000 * T, T, 60 + T, T)
    run = read_text(tmp_path, text)
    np.testing.assert_allclose(run.time, T, atol=1e-15)
    np.testing.assert_allclose(run.speed, 2 * np.pi + T * RPM)
    assert run.current is None and run.ignored == ("flag",)
    assert len(run) == 12 and run.sample_time == pytest.approx(0.01)
    assert run.duration == pytest.approx(0.11)


def test_columns_without_a_unit_are_taken_as_si_and_noted(tmp_path):
    run = read_text(tmp_path, table("time_s,voltage_V,speed", T, T, T))
    (note,) = run.notes
    assert (note.column, note.severity) == ("speed", "note")
    assert "rad/s assumed" in note.what


@pytest.mark.parametrize("units", ["ms,V,,rpm\n", "(ms),(V),(),(rpm)\n\n", "\n[ms],[V],-,[1/min]\n# begin\n"])
def test_a_second_line_may_hold_the_units(tmp_path, units):
    head, *numbers = table("Time,voltage_V,flag,speed", 1000 * T, T, T, 60 + T).splitlines()
    run = read_text(tmp_path, f"{head}\n{units}" + "\n".join(numbers))
    np.testing.assert_allclose(run.time, T, atol=1e-15)
    np.testing.assert_allclose(run.voltage, T)
    np.testing.assert_allclose(run.speed, 2 * np.pi + T * RPM)
    assert not any("assumed" in note.what for note in run.notes)


@pytest.mark.parametrize(
    "form", ["%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%H:%M:%S.%f", "parquet"]
)
def test_dates_become_seconds_since_the_first(tmp_path, form):
    stamps = [datetime(2026, 2, 28, 23, 59, 59, 950_000) + timedelta(seconds=t) for t in T]
    if form == "parquet":
        path = tmp_path / "run.parquet"
        pl.DataFrame({"time": stamps, "voltage_V": T, "speed_rpm": T}).write_parquet(path)
        run = read_recording(path)
    else:
        lines = [f"{s.strftime(form)},{x},{x}" for s, x in zip(stamps, T, strict=True)]
        run = read_text(tmp_path, "\n".join(["time,voltage_V,speed_rpm", *lines]))
    np.testing.assert_allclose(run.time, T, atol=1e-9)
    assert run.notes == ()


def test_thousands_separators_that_look_like_decimal_commas_are_refused(tmp_path):
    rows = [f"{t};{t};{n}" for t, n in zip(T, ["998", "999", *["1,000"] * (len(T) - 2)], strict=True)]
    with pytest.raises(InputError, match=r"line 4 a comma\. Export the file without thousands separators"):
        read_text(tmp_path, "\n".join(["time_s;voltage_V;speed [rpm]", *rows]))


CLOCKS = ["Time [hh:mm:ss]", "time (HH:MM:SS.fff)"]


@pytest.mark.parametrize("header", ["timestamp", "datetime", "Date/Time", "Date", "time_ms", "Zeit [µs]", *CLOCKS])
def test_dates_are_the_time_in_seconds_whatever_their_header_says(tmp_path, header):
    lines = [f"2026-03-01T12:00:00.{k:02},{k},{k}" for k in range(12)]
    run = read_text(tmp_path, "\n".join([f"{header},voltage_V,speed_rpm", *lines]))
    np.testing.assert_allclose(run.time, T, atol=1e-9)
    assert run.notes == ()


@pytest.mark.parametrize(
    ("form", "day"), [("%m/%d/%Y", 27), ("%d/%m/%Y", 27), ("%d-%m-%Y", 27), ("%m/%d/%Y", 2), ("%d-%m-%Y", 2)]
)
def test_days_and_months_are_told_apart_where_they_can_be_or_need_not_be(tmp_path, form, day):
    """From the 27th to the 28th; within the 2nd."""
    seconds = (59.95 if day > 12 else 0) + T
    stamps = [datetime(2026, 3, day, 23, 59) + timedelta(seconds=t) for t in seconds]
    lines = [f"{s.strftime(form + ' %H:%M:%S.%f')},0,{t}" for s, t in zip(stamps, T, strict=True)]
    run = read_text(tmp_path, "\n".join(["time,voltage_V,speed_rpm", *lines]))
    np.testing.assert_allclose(run.time, T, atol=1e-9)


def test_an_unused_column_that_resembles_a_quantity_is_noted(tmp_path):
    run = read_text(tmp_path, table("time_s,voltage_V,current_A,speed_kg", T, T, T, T))
    (note,) = run.notes
    assert note.column == "speed_kg" and "looks like speed" in note.what


@pytest.mark.parametrize(
    ("headers", "missing"),
    [
        ("time_s,voltage_V,current_A,n,flag", "speed=n:UNIT"),
        ("time_s,voltage_V,c urent,speed_rpm,flag", "'current=c urent:UNIT'"),
        ("time_s,i_A,Ch1,omega_mot,flag", "voltage=Ch1:UNIT"),
        ("time_s,i_A,voltage_V,angle_rad,flag", None),
        ("time_s,i_A,voltage_V,speed_rpm,flag", None),
    ],
)
def test_columns_that_are_not_understood_are_noted_once_where_a_quantity_is_missing(tmp_path, headers, missing):
    run = read_text(tmp_path, table(headers, T, T, T, T, T))
    found = [note for note in run.notes if "not understood" in note.what]
    assert len(found) == (missing is not None)
    for note in found:
        assert note.what.endswith(", flag") and f"--column {missing}" in note.mend


def test_a_suggested_mapping_can_be_pasted_into_a_shell(tmp_path):
    with pytest.raises(InputError, match=r"--column 'speed=Speed \[rpm\]'"):
        read_text(tmp_path, table("time_s,voltage_V,speed_rad_s,Speed [rpm]", T, T, T, T))


def test_linear_and_rotary_units_together_give_a_warning(tmp_path):
    run = read_text(tmp_path, table("time_s,voltage_V,speed [m/s],load [N m]", T, T, T, T))
    assert [finding.severity for finding in run.notes] == ["warning"]


@pytest.mark.parametrize(
    ("mapping", "scale"),
    [
        ({"speed": "rpm_meas:rpm"}, RPM),
        ({"speed": "rpm_meas:rpm/10"}, RPM / 10),
        ({"speed": "rpm_meas"}, 1),
        ({"speed": "w:a [rpm]"}, RPM),
        ({"speed": "w:a [rpm]:deg/s"}, DEGREE),
        ({"speed": "enc_rpm"}, RPM),
        ({"speed": "rpm_meas:-rpm"}, -RPM),
        ({"speed": "rpm_meas:-1*rpm/10"}, -RPM / 10),
        ({"speed": "enc_rpm:-"}, -RPM),
    ],
)
def test_columns_are_mapped_by_hand(tmp_path, mapping, scale):
    text = table("time_s,voltage_V,rpm_meas,w:a [rpm],enc_rpm", T, T, T, T, T)
    run = read_text(tmp_path, text, mapping)
    np.testing.assert_allclose(run.speed, T * scale)


def test_files_of_several_loggers_are_mapped_each_by_its_headers(tmp_path):
    paths = [tmp_path / name for name in ("a.csv", "b.csv", "c.csv")]
    for path, speed in zip(paths, ("n1", "n2 [rad/s]", "speed_rad_s"), strict=True):
        path.write_text(table(f"time_s,voltage_V,{speed}", T, T, T))
    runs = read_recordings(paths, [("speed", "n1:rpm"), ("speed", "n2")])
    for run, scale in zip(runs, (RPM, 1, 1), strict=True):
        np.testing.assert_allclose(run.speed, T * scale)
    with pytest.raises(InputError, match=r"speed=n3:rpm: no column 'n3' in .*a\.csv, .*b\.csv.*n1"):
        read_recordings(paths[:2], [("speed", "n3:rpm")])
    with pytest.raises(InputError, match=r"a\.csv, --column speed=n1:rpm: voltage_V is mapped"):
        read_recordings(paths[:1], [("speed", "voltage_V"), ("speed", "n1:rpm")])


def test_mapped_columns_take_precedence_over_understood_headers(tmp_path):
    text = table("time_s,voltage_V,speed_rad_s,Speed [rpm]", T, T, T, T)
    run = read_text(tmp_path, text, {"speed": "Speed [rpm]", "load_torque": "speed_rad_s:Nm"})
    np.testing.assert_allclose(run.speed, T * RPM)
    np.testing.assert_allclose(run.load, T)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_dialects_of_csv_are_read(tmp_path, separator, end):
    text = "\ufeff# bench 3\n\n" + table(
        separator.join(["time_s", "voltage_V", "speed_rad_s"]), T, T, T, separator=separator
    )
    lines = text.splitlines()
    lines.insert(6, "# pause")
    lines.insert(9, "")
    text = end.join([*lines, "", ""])
    for footer in ("", "# end of file", f"# end,{end}# of file{end}{end}"):
        np.testing.assert_array_equal(read_text(tmp_path, text + footer).speed, T)


def test_a_comment_after_many_rows_is_skipped(tmp_path):
    """Of so many that polars reads them in pieces."""
    t = np.arange(3000) * 1e-3
    run = read_text(tmp_path, table("time_s,voltage_V,speed_rad_s", t, t, t) + "# end of file")
    np.testing.assert_array_equal(run.speed, t)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read(tmp_path, separator):
    text = table(f"time_s{separator}voltage_V{separator}speed_rad_s", T, T, T, separator=separator)
    run = read_text(tmp_path, text.replace(".", ","))
    np.testing.assert_array_equal(run.speed, T)


def test_padded_and_quoted_numbers_are_read(tmp_path):
    text = table("time_s, voltage_V ,speed_rad_s", T, T, T).replace(",", " , ")
    np.testing.assert_array_equal(read_text(tmp_path, text).speed, T)
    quoted = "\n".join(",".join(f'"{cell.strip()}"' for cell in line.split(",")) for line in text.splitlines())
    np.testing.assert_array_equal(read_text(tmp_path, quoted).speed, T)


def test_a_header_in_a_comment_as_by_numpy_is_read(tmp_path):
    path = tmp_path / "run.csv"
    columns = np.stack([T, T, T], axis=1)
    np.savetxt(path, columns, delimiter=",", header="time_s,voltage_V,speed_rad_s")
    np.testing.assert_allclose(read_recording(path).speed, T)


def test_a_header_in_a_comment_may_have_semicolons(tmp_path):
    text = table("# time_s,voltage_V,speed_rad_s", T, T, T, separator=";").replace("voltage_V,", "voltage_V;")
    np.testing.assert_allclose(read_text(tmp_path, text.replace("time_s,", "time_s;")).speed, T)


@pytest.mark.parametrize("header", ["Temperature [F]", "Torque [%]"])
def test_a_column_that_is_not_used_may_have_any_unit(tmp_path, header):
    run = read_text(tmp_path, table(f"time_s,voltage_V,current_A,speed_rad_s,{header}", T, T, T, T, T))
    assert header in run.ignored


def test_a_torque_in_another_unit_is_refused_where_it_would_drive_the_motor(tmp_path):
    with pytest.raises(InputError, match="Torque"):
        read_text(tmp_path, table("time_s,speed_rad_s,Torque [%]", T, T, T))


def test_a_matrix_column_that_a_file_lacks_is_named_whole(tmp_path):
    with pytest.raises(InputError, match=r"no column 'data\(:,9\)'"):
        read_text(tmp_path, table("time_s,voltage_V,n", T, T, T), {"speed": "data(:,9)"})


def test_a_date_column_without_dates_is_refused(tmp_path):
    path = tmp_path / "run.parquet"
    none = pl.Series([None] * len(T), dtype=pl.Datetime)
    pl.DataFrame({"time": none, "voltage_V": T, "speed_rad_s": T}).write_parquet(path)
    with pytest.raises(InputError, match="time"):
        read_recording(path)


@pytest.mark.parametrize("cell", ["", "NaN", "nan", "NA", " "])
def test_missing_outputs_are_nan(tmp_path, cell):
    lines = table("time_s,voltage_V,current_A,speed_rad_s", T, T, T, T).splitlines()
    lines[4] = f"0.03,1,{cell},{cell}"
    run = read_text(tmp_path, "\n".join(lines))
    assert run.current is not None and run.speed is not None
    assert np.flatnonzero(np.isnan(run.current)).tolist() == [3]
    assert np.flatnonzero(np.isnan(run.speed)).tolist() == [3]


def test_runs_of_files_of_the_same_name_are_named_after_their_paths(tmp_path):
    paths = [tmp_path / name for name in ("a/x/run.csv", "b/x/run.csv", "c.csv", "c.txt", "d.csv")]
    for k, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(table("time_s,voltage_V,speed", T, T, T + k))
    runs = named_apart(recordings_of(paths))
    names = [run.name for run in runs]
    assert names == ["a/x/run.csv", "b/x/run.csv", "c.csv", "c.txt", "d"]
    assert [note.run for run in runs for note in run.notes] == names
    again = tmp_path / "a" / ".." / "d.csv"
    with pytest.raises(InputError, match=r"d\.csv: this file is listed twice"):
        named_apart(recordings_of([*paths, again]))


def test_copies_of_a_recording_are_refused(tmp_path):
    paths = [tmp_path / name for name in ("run.csv", "other.csv", "copy.csv")]
    for path, speed in zip(paths, (T, 2 * T, T), strict=True):
        path.write_text(table("time_s,voltage_V,speed", T, T, speed))
    refuse_copies(recordings_of(paths[:2]))
    with pytest.raises(InputError, match=r"copy\.csv: it holds the same data as run"):
        refuse_copies(recordings_of(paths))


def test_an_empty_column_counts_as_absent(tmp_path):
    lines = ["time_s,voltage_V,current_A,speed_rad_s", *[f"{t},,1,{t}" for t in T]]
    run = read_text(tmp_path, "\n".join(lines))
    assert run.voltage is None and run.drive == "current"
    assert [note.column for note in run.notes] == ["voltage_V"]


@pytest.mark.parametrize(
    ("quantities", "drive"),
    [
        ("voltage current speed", "voltage"),
        ("voltage angle", "voltage"),
        ("voltage current", "voltage"),
        ("current angle", "current"),
        ("current torque speed", "torque"),
    ],
)
def test_the_drive_of_a_run_follows_from_its_columns(quantities, drive):
    assert Recording("run", T, **dict.fromkeys(quantities.split(), T)).drive == drive


@pytest.mark.parametrize("shape", [(-1,), (-1, 1), (1, -1)])
@pytest.mark.parametrize("nested", [False, True])
def test_matlab_vectors_of_any_orientation_are_read(tmp_path, shape, nested):
    variables = {"t": T, "voltage_V": T, "Speed_rpm": T, "gain": 35.15, "note": "hello"}
    variables = {k: v.reshape(shape) if k in "t voltage_V Speed_rpm" else v for k, v in variables.items()}
    savemat(tmp_path / "run.mat", {"log": {"run1": variables}} if nested else variables)
    run = read_recording(tmp_path / "run.mat")
    np.testing.assert_allclose(run.speed, T * RPM)
    np.testing.assert_array_equal(run.time, T)


def _structures(*fields: dict) -> np.ndarray:
    """An array of structures as savemat takes it."""
    structures = np.zeros(len(fields), [(name, object) for name in fields[0]])
    structures[:] = [tuple(one.values()) for one in fields]
    return structures


def _simulink(*signals: tuple[np.ndarray, str]) -> dict:
    signals = _structures(*({"values": v, "dimensions": 1.0, "label": label} for v, label in signals))
    return {"time": T[:, None], "signals": signals, "blockName": "model/To Workspace"}


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        # Simulink's "structure with time": labelled signals, one for each, and without labels
        ({"simout": _simulink((T, "voltage_V"), (T, "Speed [rpm]"))}, {}),
        ({"voltage_V": _simulink((T, "")), "Speed_rpm": _simulink((T, ""))}, {}),
        ({"yout": _simulink((np.stack([T, T], 1), ""))}, {"voltage": "yout(:,1)", "speed": "yout(:,2):rpm"}),
        # its block "To File" has a row for each signal
        ({"ans": np.stack([T, T, T])}, {"time": "ans(1,:)", "voltage": "ans(2,:)", "speed": "ans(3,:):rpm"}),
        # dSPACE ControlDesk
        (
            {
                "exp_001": {
                    "X": _structures({"Name": "time", "Data": T, "Unit": "s"}),
                    "Y": _structures(
                        {"Name": "voltage", "Data": T, "Unit": "V"}, {"Name": "Speed", "Data": T, "Unit": "rpm"}
                    ),
                }
            },
            {},
        ),
    ],
)
def test_files_of_simulink_and_controldesk_are_read(tmp_path, content, columns):
    savemat(tmp_path / "run.mat", content)
    run = read_recording(tmp_path / "run.mat", columns)
    np.testing.assert_array_equal(run.time, T)
    np.testing.assert_array_equal(run.voltage, T)
    np.testing.assert_allclose(run.speed, T * RPM)


def test_integers_in_parquet_and_matlab_are_read(tmp_path):
    whole = np.arange(12)
    columns = {"time_s": whole, "voltage_V": whole, "speed_rad_s": whole}
    pl.DataFrame(columns).write_parquet(tmp_path / "run.parquet")
    savemat(tmp_path / "run.mat", columns)
    for name in ("run.parquet", "run.mat"):
        np.testing.assert_array_equal(read_recording(tmp_path / name).speed, whole)


def test_a_million_rows_are_read_in_seconds(tmp_path):
    rng = np.random.default_rng(0)
    count = 1_000_000
    columns = dict(zip(("voltage", "current", "speed"), rng.normal(size=(3, count)), strict=True))
    write_recording(Recording("big", np.arange(count) / 1e4, **columns), tmp_path / "big.csv")
    begin = clock.perf_counter()
    assert len(read_recording(tmp_path / "big.csv")) == count
    assert clock.perf_counter() - begin < 5  # on a machine that others use too


def test_importing_recordings_and_checks_imports_nothing_heavy():
    code = (
        "import sys, pmdc_jax.recordings.recording, pmdc_jax.checks.check;"
        "print(*{'jax', 'pint', 'polars', 'scipy'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_a_path_stands_for_its_recording(tmp_path):
    run = Recording("step", 0.01 * np.arange(20), np.ones(20), speed=np.arange(20.0))
    path = tmp_path / "step.csv"
    write_recording(run, path)
    for kind in (run, path, str(path)):
        for found in (*recordings_of(kind), *recordings_of([kind])):
            assert found.name == "step"
            np.testing.assert_array_equal(found.speed, run.speed)


# --------------------------------------------------------------------------------- instruments


ROWS = "".join(f"{0.001 * k:.3f},{12 + k % 3},{0.1 * k:.1f},{k}\n" for k in range(20))


@pytest.mark.parametrize(
    "preamble",
    [
        "Model,MSO46\nFirmware Version,1.30\n\nProbe Attenuation,10,1,1\nVertical Units,V,A,V\n\n",
        "LabVIEW Measurement,\nSeparator,Comma\n***End_of_Header***,\n",
        "Date 2026-11-24\nSample interval 0.001\n",
    ],
)
def test_a_preamble_of_an_instrument_is_skipped(tmp_path, preamble):
    file = tmp_path / "scope.csv"
    file.write_text(f"{preamble}time_s,voltage_V,current_A,speed_rad_s\n{ROWS}")
    run = read_recording(file)
    assert len(run) == 20
    assert (run.voltage[1], run.current[1], run.speed[1]) == (13.0, 0.1, 1.0)


def test_a_preamble_may_be_followed_by_names_and_units(tmp_path):
    file = tmp_path / "scope.csv"
    file.write_text(f"Model,MSO46\n\nTIME,CH1,CH2,CH3\n(s),(V),(A),(rad/s)\n{ROWS}")
    columns = {"voltage": "CH1", "current": "CH2", "speed": "CH3"}
    run = read_recording(file, columns)
    assert len(run) == 20
    assert (run.voltage[1], run.current[1], run.speed[1]) == (13.0, 0.1, 1.0)


def test_a_header_of_another_width_is_not_taken_for_a_preamble(tmp_path):
    file = tmp_path / "run.csv"
    file.write_text(f"time_s,voltage_V,current_A\n{ROWS}")
    with pytest.raises(InputError, match="it has 4 fields where the header"):
        read_recording(file)


@pytest.mark.parametrize(
    ("separator", "written", "number"),
    [
        (",", "1,234.5", 1234.5),
        (";", "1.234,5", 1234.5),
        ("\t", "1,234.50", 1234.5),
        (";", "-12,345,678.5", -12345678.5),
    ],
)
def test_thousands_separators_are_read(tmp_path, separator, written, number):
    lines = table("time_s,voltage_V,current_A,speed_rad_s", T, T, T, T).splitlines()
    rows = [line.split(",") for line in lines]
    rows[5][3] = f'"{written}"'
    run = read_text(tmp_path, "\n".join(map(separator.join, rows)))
    assert run.speed[4] == number


def test_a_spreadsheet_with_quoted_cells_remarks_and_empty_lines_is_read(tmp_path):
    """As exported by a spreadsheet program."""
    rows = [f'"{line.replace(",", chr(34) + "," + chr(34))}",""' for line in ROWS.splitlines()]
    rows[0] = f'{rows[0][:-3]},"cold, at first"'
    file = tmp_path / "run.csv"
    header = '"Time (s)","Motor Voltage (V)","Motor Current (A)","Shaft Speed (rad/s)","Remark"'
    file.write_text("\r\n".join(['"Bench 3, ""north"""', "", header, *rows, ",,,,", ""]))
    run = read_recording(file)
    assert len(run) == 20
    assert (run.voltage[1], run.current[1], run.speed[1]) == (13.0, 0.1, 1.0)


def test_a_column_is_mapped_by_its_name_without_the_unit_below(tmp_path):
    file = tmp_path / "scope.csv"
    file.write_text(f"x-axis,1,2,3\nsecond,Volt,Ampere,Volt\n{ROWS}")
    columns = {"time": "x-axis", "voltage": "1", "current": "2", "speed": "3:rad/s"}
    run = read_recording(file, columns)
    assert (run.time[1], run.voltage[1], run.speed[1]) == (0.001, 13.0, 1.0)
