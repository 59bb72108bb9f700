"""The report and the JSON of identifications that are made up, with plausible numbers."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from attrs import evolve

from pmdc_jax import files
from pmdc_jax.errors import InputError
from pmdc_jax.identify.identification import Direction, Estimate, Identification, RunFit, Search
from pmdc_jax.identify.search.evolution import METHODS
from pmdc_jax.motor import Motor
from pmdc_jax.recordings.recording import Finding
from pmdc_jax.report import notation
from pmdc_jax.report.figures import envelope
from pmdc_jax.report.identification.figures import correlations, run_figure
from pmdc_jax.report.identification.json import identification_json
from pmdc_jax.report.identification.page import write_identification_report
from pmdc_jax.report.identification.sentences import MODEL_ASSUMPTION, summary
from pmdc_jax.report.identification.tables import identification_tables
from pmdc_jax.report.json import write_json
from pmdc_jax.report.page import _commands

TRUTH = {"R": 0.157, "L": 84e-6, "Kb": 0.0501, "Kt": 0.0501, "J": 1.21e-3, "f": 2.3e-4}
UNITS = {"R": "ohm", "L": "H", "Kb": "V s/rad", "Kt": "N m/A", "J": "kg m^2", "f": "N m s/rad"}
NOISE = {"current_A": 0.35, "speed_rad_s": 0.6}
INPUTS = {
    "staircase": lambda t: 6.0 * (1 + (t // 0.5) % 4),
    "prbs": lambda t: 12 + 9 * np.sign(np.sin(2 * np.pi * t * (2 + 3 * (t % 1)))),
    "triangle": lambda t: 24 * np.abs(2 * ((t / 2) % 1) - 1) - 12,
    "loaded": lambda t: 18 + 0 * t,
    "drive": lambda t: 12 + 8 * np.sin(2 * np.pi * 0.4 * t) + 4 * (t % 0.8 > 0.4),
}


def simulated(voltage: np.ndarray, step: float, load: float) -> tuple[np.ndarray, np.ndarray]:
    """Current and speed of the true motor: no inductance, Euler steps of the speed."""
    speed = np.zeros(len(voltage))
    for k in range(len(voltage) - 1):
        current = (voltage[k] - TRUTH["Kb"] * speed[k]) / TRUTH["R"]
        torque = TRUTH["Kt"] * current - TRUTH["f"] * speed[k] - load
        speed[k + 1] = speed[k] + step * torque / TRUTH["J"]
    return (voltage - TRUTH["Kb"] * speed) / TRUTH["R"], speed


def fake_run(name: str, rng: np.random.Generator, samples: int) -> RunFit:
    step = 1e-3
    time = step * np.arange(samples)
    voltage = INPUTS[name](time)
    current, speed = simulated(voltage, step, load=0.4 if name == "loaded" else 0.0)
    noisy_current = current + NOISE["current_A"] * rng.standard_normal(samples)
    noisy_speed = speed + NOISE["speed_rad_s"] * rng.standard_normal(samples)
    return RunFit(
        role="holdout" if name == "drive" else "train",
        current_rmse=NOISE["current_A"],
        speed_rmse=NOISE["speed_rad_s"],
        current_fit_percent=97.83,
        speed_fit_percent=99.41,
        load_offset=0.0123 if name == "loaded" else None,
        initial_rise=None,
        time=time,
        voltage=voltage,
        current=noisy_current,
        current_simulated=current,
        speed=noisy_speed,
        speed_simulated=speed,
        load=None,
    )


def fake_search(rng: np.random.Generator, generations: int = 80) -> Search:
    decay = np.exp(-np.arange(generations) / 9)
    best = 1.02 + 4e3 * np.minimum.accumulate(decay * rng.uniform(0.3, 1, generations))
    return Search(
        method="differential_evolution",
        evaluations=64 * generations,
        best=best,
        median=best * (3 + 90 * decay),
        refined=np.array([1.0003, 1.0003, 1.0003, 1.0003, 1.0004, 14.2]),
        times_found=5,
    )


def fake_identification(samples: int = 3000, **changes) -> Identification:
    """All six parameters from four training runs, and a held-out run; `changes` replace fields."""
    rng = np.random.default_rng(0)
    relative = dict(zip(TRUTH, (0.0026, 0.031, 0.0004, 0.006, 0.0061, 0.043), strict=True))
    deviation = np.array(list(relative.values()))
    correlation = np.eye(6)
    for row, column, value in ((3, 4, 0.96), (3, 5, 0.55), (4, 5, 0.52), (0, 1, -0.31), (0, 2, -0.44)):
        correlation[row, column] = correlation[column, row] = value
    fields = {
        "motor": Motor(**TRUTH),
        "parameters": {
            name: Estimate(
                value=value * (1 + 0.5 * relative[name]),
                stderr=value * relative[name],
                ci95=(value * (1 - 1.46 * relative[name]), value * (1 + 2.46 * relative[name])),
                unit=UNITS[name],
                status="identified",
            )
            for name, value in TRUTH.items()
        },
        "unidentified_directions": (),
        "fit": {name: fake_run(name, rng, samples) for name in INPUTS},
        "noise": NOISE,
        "distance": 0.01,
        "seed": 0,
        "seconds": {"total": 3.21, "search": 1.1, "refine": 0.4},
        "search": fake_search(rng),
        "findings": (),
        "covariance": correlation * np.outer(deviation, deviation),
        "covariance_names": tuple(TRUTH),
    }
    return Identification(**(fields | changes))


def partial_identification() -> Identification:
    """With nearly everything missing that can be: known loads, columns, hold-outs, convergence, the search."""
    complete = fake_identification()
    hidden = Estimate(0.117, None, None, "N m/A", "not_identifiable")
    bound = Estimate(1e-6, None, None, "H", "at_bound")
    no_voltage = {"voltage": None, "current_simulated": None, "current_rmse": None}
    no_current = {"current": None, "current_rmse": None, "current_fit_percent": None}
    return fake_identification(
        parameters={**complete.parameters, **dict.fromkeys(("Kt", "J", "f"), hidden), "L": bound},
        unidentified_directions=(
            Direction(
                ("Kt", "J", "f"),
                "No run has a known load torque, so only the ratios of Kt, J and f can be seen",
                "Record a run with a known load, declare --unloaded, or tie them by --tie Kt=Kb",
            ),
        ),
        fit={
            "coast <down> & out": evolve(complete.fit["prbs"], current_fit_percent=None, **no_voltage),
            "speed only": evolve(complete.fit["drive"], role="train", **no_current),
        },
        noise={"current_A": None, "speed_rad_s": 0.6},
        distance=np.inf,
        findings=(Finding("prbs", "current_A", "warning", "saturated at 60 A", "2.31 s to 2.35 s", "Widen it"),),
        messages=("Runs without voltage were used for the mechanical half only.",),
        search=Search("particle_swarm", 0, np.zeros(0), np.zeros(0), np.zeros(0), 0),
        covariance=np.zeros((6, 6)),
    )


class Page(HTMLParser):
    """The contents of a report: its visible text, the addresses that it would load, and its figures."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.text, self.loads, self.styles = "", [], ""
        self.figures: list[dict] = []
        self.data = False
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag not in ("meta", "link", "br"):
            self.open.append(tag)
        self.loads += [attributes[key] for key in ("src", "href") if key in attributes]
        self.data = attributes.get("type") == "application/json"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            if self.data:
                self.figures.append(json.loads(data, parse_constant=pytest.fail))
        elif self.open and self.open[-1] == "style":
            self.styles += data
        else:
            self.text += data


CASES = {"whole": fake_identification, "partial": partial_identification}


@pytest.fixture(params=CASES)
def case(request, tmp_path):
    identification = CASES[request.param]()
    write_identification_report(identification, tmp_path / "report.html")
    return identification, (tmp_path / "report.html").read_text(encoding="utf-8")


def test_report_contains_every_parameter_run_and_finding(case):
    identification, html = case
    page = Page(html)
    assert page.open == []
    for name, estimate in identification.parameters.items():
        written = notation.write_estimate(estimate)
        row = (name, notation.PARAMETER_NAMES[name], written.value, written.unit, written.stderr)
        assert "".join("".join(row).split()) in "".join(page.text.split()), name
    for name in identification.fit:
        assert page.text.count(name) >= 2
    for finding in identification.findings:
        assert finding.what in page.text
        assert finding.mend in page.text
    for message in (*summary(identification), *identification.messages):
        assert message.replace("`", "") in page.text  # commands are marked as code instead
    assert f"Seed {identification.seed}" in page.text
    assert "pmdc_jax" in page.text


def test_report_loads_nothing_and_shows_no_nan(case):
    _, html = case
    page = Page(html)
    assert all(url.startswith(("#", "data:")) for url in page.loads), page.loads
    assert "url(" not in page.styles
    assert "@import" not in page.styles
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", page.text, re.IGNORECASE)
    assert html.count("plotly.js v") == 1
    # plotly's cloud button would upload a recording
    assert "showSendToCloud: false" in html


def test_report_has_a_figure_for_every_run_the_search_and_the_correlations(case):
    identification, html = case
    figures_shown = Page(html).figures
    extra = 2 if len(identification.search.best) else 0
    assert len(figures_shown) == len(identification.fit) + extra


def test_hold_out_runs_are_shown_first(tmp_path):
    write_identification_report(fake_identification(), tmp_path / "report.html")
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert text.index("drive", text.index("Measured and simulated")) < text.index(
        "staircase", text.index("Measured and simulated")
    )


def test_missing_quantities_are_left_out_of_the_figure():
    fits = partial_identification().fit
    no_voltage = run_figure(fits["coast <down> & out"], {}, 1000)
    assert [trace.name for trace in no_voltage.data] == ["measured", "simulated", "measured", "residual"]
    no_current = run_figure(fits["speed only"], {}, 1000)
    assert [trace.name for trace in no_current.data] == [*("measured", "simulated", "simulated", "applied", "residual")]


def test_long_runs_are_thinned_and_the_page_stays_small(tmp_path):
    run = fake_identification().fit["prbs"]
    length = 200_000
    columns = ("time", "voltage", "current", "current_simulated", "speed", "speed_simulated")
    changes = {name: np.resize(getattr(run, name), length) for name in columns}
    changes["time"] = 1e-3 * np.arange(length)
    runs = {f"run {number}": evolve(run, **changes) for number in range(12)}
    write_identification_report(fake_identification(fit=runs), tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size < 6_000_000
    assert "plot reduced to" in Page((tmp_path / "report.html").read_text(encoding="utf-8")).text


def test_the_readings_of_a_slow_sensor_are_joined():
    time, values = np.arange(100.0), np.full(100, np.nan)
    values[3::10] = np.arange(10.0)
    drawn_time, drawn = envelope(time, values, 400)
    np.testing.assert_array_equal(drawn_time, time[3::10])
    np.testing.assert_array_equal(drawn, values[3::10])


def test_envelope_keeps_peaks_order_and_gaps():
    rng = np.random.default_rng(1)
    time = np.arange(10_001) * 1e-3
    values = rng.standard_normal(10_001)
    values[7_777], values[3_333] = 50.0, -50.0
    values[:500] = np.nan
    thin_time, thin = envelope(time, values, 400)
    assert len(thin) <= 400
    assert np.nanmax(thin) == 50
    assert np.nanmin(thin) == -50
    assert np.all(np.diff(thin_time) >= 0)
    assert np.isnan(thin[:4]).all()
    short_time, short = envelope(time[:50], values[600:650], 400)
    np.testing.assert_allclose(short, values[600:650], rtol=1e-6)
    np.testing.assert_allclose(short_time, time[:50], rtol=1e-6)


def test_correlations_omit_fixed_parameters():
    covariance = np.array([[4.0, 0.0, 3.0], [0.0, 0.0, 0.0], [3.0, 0.0, 9.0]])
    matrix, names = correlations(covariance, ("R", "L", "Kb"))
    assert names == ("R", "Kb")
    np.testing.assert_allclose(matrix, [[1, 0.5], [0.5, 1]])


def test_commands_and_options_are_marked_as_code():
    page = _commands("add `--effect x` or run `pmdc diagnose`, or --tie Kt=Kb; <b> stays text")
    assert str(page) == (
        "add <code>--effect x</code> or run <code>pmdc diagnose</code>, or"
        " <code>--tie Kt=Kb</code>; &lt;b&gt; stays text"
    )


def test_summary_states_what_was_identified_and_how_well_it_fits():
    sentences = " ".join(summary(fake_identification()))
    assert "All 6 parameters were identified from 4 training runs" in sentences
    assert "(f)" in sentences
    assert "drive is reproduced" in sentences
    assert "the residuals are measurement noise" in sentences
    assert "pmdc diagnose" in sentences
    sentences = " ".join(summary(partial_identification()))
    assert "Kt, J and f could not be identified" in sentences
    assert "--tie Kt=Kb" in sentences
    assert "No run was held out" in sentences
    assert "L is at the bound" in sentences
    assert "did not converge" in sentences
    sentences = " ".join(summary(fake_identification(distance=1.34)))
    assert "stalled up to 1.3 standard errors" in sentences


@pytest.mark.parametrize(("ratio", "status"), [(30, "at_bound"), (1.2, "identified"), (30, "tied")])
def test_summary_doubts_constants_that_no_motor_has(ratio, status):
    complete = fake_identification()
    Kb = complete.parameters["Kb"]
    Kt = evolve(Kb, value=ratio * Kb.value, status=status)
    found = evolve(complete, parameters={**complete.parameters, "Kt": Kt})
    doubted = "Kt is 30.0 times Kb" in " ".join(summary(found))
    assert doubted == (ratio == 30 and status != "tied")


def test_summary_lists_the_columns_with_warnings_of_the_data_check():
    finding = Finding("loaded", "current", "warning", "as if in mA", "whole run", "Mend it")
    (message,) = (
        one
        for one in summary(fake_identification(findings=(finding, evolve(finding, column=None))))
        if "data check" in one
    )
    assert "the current and run loaded" in message
    note = evolve(finding, severity="note")
    assert "data check" not in " ".join(summary(fake_identification(findings=(note,))))


def test_summary_does_not_assume_a_model_that_a_message_doubts():
    message = "the fit leaves 22 times its white noise: `pmdc diagnose` tells what is missing"
    doubted = fake_identification(messages=(message,), doubts=(message,))
    assert MODEL_ASSUMPTION not in summary(doubted)
    assert MODEL_ASSUMPTION in summary(fake_identification(messages=("something else",)))


def test_summary_states_the_same_reason_only_once():
    partial = partial_identification()
    (one, *_) = partial.unidentified_directions
    twice = evolve(one, parameters=(*one.parameters, "friction"))
    sentences = summary(evolve(partial, unidentified_directions=(one, twice)))
    assert sum(one.mend in sentence for sentence in sentences) == 1


def test_summary_names_the_worst_hold_out_and_its_excess():
    complete = fake_identification()
    poor = evolve(complete.fit["prbs"], role="holdout", speed_rmse=3.0)
    sentences = " ".join(summary(fake_identification(fit={**complete.fit, "prbs": poor})))
    assert "The worst of 2 held-out runs, prbs," in sentences
    assert "the speed error is 5.0 times the measurement noise" in sentences


def test_json_has_the_documented_keys():
    found = identification_json(fake_identification())
    assert set(found["parameters"]) == set(TRUTH)
    assert set(found["parameters"]["R"]) == {"value", "stderr", "ci95", "unit", "status"}
    assert set(found["fit"]["drive"]) >= {
        *("role", "current_rmse", "speed_rmse", "current_fit_percent", "speed_fit_percent")
    }
    assert {"unidentified_directions", "noise", "converged", "seed", "seconds"} <= set(found)
    assert found["fit"]["loaded"]["load_offset"] == 0.0123


def test_json_has_null_for_unknown_values(tmp_path, capsys):
    unknown = Estimate(np.float64(0.2), float("nan"), (float("nan"), 1.0), "ohm", "not_identifiable")
    found = identification_json(fake_identification(parameters={"R": unknown}))
    assert found["parameters"]["R"]["stderr"] is None
    assert found["parameters"]["R"]["ci95"] is None
    write_json(found, tmp_path / "out.json")
    assert json.loads((tmp_path / "out.json").read_text(), parse_constant=pytest.fail) == found
    write_json(found, "-")
    assert json.loads(capsys.readouterr().out) == found


def test_files_are_written_atomically(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")

    def fails(self, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("pathlib.Path.replace", fails)
        with pytest.raises(InputError, match="it cannot be written"):
            files.write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    files.write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_or_a_device_is_written_through(tmp_path):
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    files.write_text(tmp_path / "link.json", "new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_text() == "new"
    files.write_text("/dev/null", "gone")
    assert Path("/dev/null").is_char_device()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_a_full_device_is_named():
    with pytest.raises(InputError, match="/dev/full: it cannot be written"):
        write_json({}, "/dev/full")


def test_an_output_that_is_an_input_is_refused(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="an input"):
        files.check_outputs({"--json": tmp_path / "a" / ".." / "run.csv"}, [tmp_path / "run.csv"])


def test_an_output_that_is_a_link_into_nowhere_is_refused(tmp_path):
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "nowhere" / "motor.json")
    with pytest.raises(InputError, match="does not exist"):
        files.check_outputs({"--save": link}, [])


@pytest.mark.parametrize(
    ("estimate", "expected"),
    [
        (Estimate(0.157312, 4.1e-4, (0.1565, 0.1581), "ohm", "identified"), ("157.31", "0.41", "mΩ")),
        (Estimate(8.4e-5, None, None, "H", "at_bound"), ("84.00", "–", "µH")),
        (Estimate(1.21e-3, 7e-6, None, "kg m^2", "identified"), ("1.2100", "0.0070", "×10⁻³ kg·m²")),
        (Estimate(12.0, 3.0, None, "N m/A", "identified"), ("12.0", "3.0", "N·m/A")),
        (Estimate(0.0, 1e-6, None, "N m s/rad", "identified"), ("0.0", "1.0", "µN·m·s/rad")),
        (Estimate(-5e-4, 0.08, (-0.28, 0.28), "rad", "identified"), ("0", "80", "mrad")),
        (Estimate(-0.002, 4e-5, None, "A", "identified"), ("−2.000", "0.040", "mA")),
        (Estimate(1.0, 0.0, (1.0, 1.0), "ohm", "known"), ("1.000", "–", "Ω")),
    ],
)
def test_engineering_notation(estimate, expected):
    written = notation.write_estimate(estimate)
    assert (written.value, written.stderr, written.unit) == expected


@pytest.mark.parametrize(
    ("value", "text"), [(2.1e-6, "2.10×10⁻⁶"), (-8.64e7, "−8.64×10⁷"), (0.0123, "0.0123"), (0.0, "0.00")]
)
def test_powers_of_ten(value, text):
    assert notation.significant(value) == text


def test_every_search_has_a_name():
    assert set(notation.SEARCH_NAMES) == set(METHODS)


def test_formulas_are_written_in_greek():
    assert notation.formula_text("coulomb_friction") == "T_f = T_c sign(ω)"
    assert "exp(−(ω / ω_s)^2)" in notation.formula_text("stribeck_friction")


@pytest.mark.parametrize(
    ("value", "text"), [(99.412, "99.41 %"), (12.34, "12.3 %"), (0.04, "0.040 %"), (-250.0, "−250 %"), (None, "–")]
)
def test_percent_notation(value, text):
    assert notation.percent(value).replace(notation.NARROW_SPACE, " ") == text


def test_tables_render_without_a_terminal(capsys):
    from rich.console import Console

    for identification in (fake_identification(400), partial_identification()):
        Console(width=100).print(identification_tables(identification))
    out = capsys.readouterr().out
    assert "not identifiable" in out
    assert "coast <down> & out" in out
