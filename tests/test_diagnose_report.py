"""Sentences, tables, JSON and page of diagnoses that are made up, with plausible numbers."""

from __future__ import annotations

import io
import json
import re

import numpy as np
import pytest
from attrs import evolve
from rich.console import Console
from test_report import Page, fake_identification, partial_identification

from pmdc_jax.checks.alignment import LATE_SPEED
from pmdc_jax.diagnose.diagnosis import (
    Detectable,
    Diagnosis,
    EffectFound,
    Gap,
    LearnedCurve,
    NextExperiment,
    Region,
    breaks_electrical_equation,
    holdouts_show_more,
)
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.identification import Estimate
from pmdc_jax.recordings.recording import Finding
from pmdc_jax.report import notation
from pmdc_jax.report.diagnosis.drift import drifts
from pmdc_jax.report.diagnosis.figures import averages
from pmdc_jax.report.diagnosis.json import diagnosis_json
from pmdc_jax.report.diagnosis.page import write_diagnosis_report
from pmdc_jax.report.diagnosis.places import intervals_in_words
from pmdc_jax.report.diagnosis.sentences import verdict_sentences
from pmdc_jax.report.diagnosis.tables import diagnosis_tables
from pmdc_jax.report.experiment import write_experiment
from pmdc_jax.report.notation import formula_text

STRIBECK = {
    "coulomb_Nm": Estimate(0.0612, 4e-4, (0.0604, 0.0620), "N m", "identified"),
    "static_Nm": Estimate(0.148, 9e-4, (0.1462, 0.1498), "N m", "identified"),
    "speed_rad_s": Estimate(11.0, 0.2, (10.6, 11.4), "rad/s", "identified"),
}
COULOMB = {"torque_Nm": Estimate(0.05, 1e-3, (0.048, 0.052), "N m", "identified")}
GAP = Gap(4.9, 1.02, 1.0)


def named(**changes) -> Diagnosis:
    """A diagnosis of Stribeck friction; `changes` replace fields."""
    base = fake_identification(400)
    friction = evolve(base.parameters["f"], value=0.4 * base.parameters["f"].value)
    of_effect = {f"stribeck_friction.{field}": one for field, one in STRIBECK.items()}
    parameters = {**base.parameters, "f": friction, **of_effect}
    fields = {
        "verdict": "named",
        "effects": (EffectFound("stribeck_friction", "mechanical", STRIBECK, 1e-9),),
        "where": (
            Region("mechanical", "speed", (-20.0, 0.0), -31.0),
            Region("mechanical", "speed", (0.0, 18.0), 28.0),
            Region("mechanical", "time", (0.2, 0.4), 9.0),
        ),
        "gap": {"train": Gap(5.1, 1.0, 1.0), "holdout": GAP},
        "gap_of_run": dict.fromkeys(base.fit, GAP),
        "closed_fraction": 0.998,
        "rivals": (),
        "next_experiment": None,
        "curves": (),
        "detectable": (
            Detectable("constant_load", "torque_Nm", 0.004, "N m"),
            Detectable("torque_constant_saturation", "per_A2", 2e-6, "1/A^2"),
            Detectable("stribeck_friction", "static_Nm", 0.001, "N m"),
        ),
        "base": base,
        "final": evolve(base, parameters=parameters),
        "p_nothing": 1e-30,
        "electrical_misfit": 1.02,
        "electrical_misfit_before": 1.02,
        "seconds": {"total": 12.0},
    }
    return Diagnosis(**(fields | changes))


def none_detected() -> Diagnosis:
    base = partial_identification()
    return named(
        verdict="none_detected",
        effects=(),
        where=(),
        gap={"train": Gap(1.0, 1.0, 1.0)},
        gap_of_run=dict.fromkeys(base.fit, Gap(1.0, 1.0, 1.0)),
        closed_fraction=None,
        base=base,
        final=base,
        p_nothing=0.37,
    )


def ambiguous() -> Diagnosis:
    time = np.arange(5) * 1e-3
    return named(
        verdict="ambiguous",
        effects=(EffectFound("coulomb_friction", "mechanical", COULOMB, 0.002),),
        rivals=(("brush_voltage_drop",), ("asymmetric_friction", "constant_load")),
        next_experiment=NextExperiment(
            "both explain these runs", "creep through zero, 6 s within 12 V", 0.93, time, 3 * time
        ),
    )


def not_in_library() -> Diagnosis:
    x = np.array([-100.0, 0.0, 40.0, 100.0])
    value, stderr = np.array([0.0, 0.001, -0.03, 0.0]), np.full(4, 0.002)
    curve = LearnedCurve("mechanical", "speed", "N m", x, value, stderr, 1e-8, reverses=False)
    return named(verdict="not_in_library", effects=(), curves=(curve,))


CASES = {one.__name__: one for one in (named, none_detected, ambiguous, not_in_library)}


def words(diagnosis: Diagnosis) -> str:
    return " ".join(verdict_sentences(diagnosis)).replace(notation.NARROW_SPACE, " ")


def test_a_wrong_formula_is_considered_if_residuals_exceed_the_noise():
    """Otherwise a named effect implies that its formula is that of the motor."""
    assert not any("another formula" in s for s in verdict_sentences(named()))
    assert any("another formula" in s for s in verdict_sentences(named(leaves_noise=False)))
    angle, ripple = np.linspace(0, 2 * np.pi / 14, 9), 0.01 * np.sin(np.linspace(0, 2 * np.pi, 9))
    curve = LearnedCurve("sensor", "angle", "", angle, ripple, 0.1 * ripple, 1e-9, False)
    sentences = verdict_sentences(named(leaves_noise=False, curves=(curve,)))
    assert any("oscillates 14.0 times per turn" in s for s in sentences)
    assert not any("another formula" in s for s in sentences)


def test_an_oscillation_of_the_speed_is_no_sensor_error_if_the_current_has_it_too():
    angle = np.linspace(0, np.pi, 9)
    curve = LearnedCurve("sensor", "angle", "", angle, 0.01 * np.sin(2 * angle), np.full(9, 1e-3), 1e-9, False)
    alone = not_in_library()
    alone = evolve(alone, curves=(curve,), final=evolve(alone.final, missed={"speed": 4.0}))
    assert "tachometer ripple" in words(alone)
    both = evolve(alone, final=evolve(alone.final, missed={"current": 8.11, "speed": 4.0}))
    assert "8.11 times its white noise. Something on the shaft varies with its angle" in words(both)


def test_sentences_for_a_named_effect():
    text = words(named())
    location = "disagree in the mechanical equation, below 20.0 rad/s, in both directions."
    found = "Stribeck friction (coulomb 61.20 mN·m, static 148.00 mN·m, speed 11.00 rad/s; p < 0.001)"
    assert location in text
    assert f"Missing: {found}. Added to the model." in text
    assert "Hold-out error from 4.90 to 1.02 times the noise: 99.80 % of the gap is closed." in text
    assert "f by −60.0 %" in text
    assert "constant load above 4.00 mN·m would have been detected" in text
    assert "static_Nm" not in text


def test_the_misfit_is_located_in_the_equation_that_lacks_the_effect():
    """Even if parameters that compensate for it cause a larger misfit of the other equation."""
    larger = Region("electrical", "current", (0.0, 4.0), 90.0)
    text = words(named(where=(larger, *named().where)))
    assert "disagree in the mechanical equation, below 20.0 rad/s" in text


def test_none_detected_states_which_effects_would_have_been_detected():
    text = words(none_detected())
    assert "No missing effect was detected" in text
    assert "p = 0.37" in text
    assert "Constant load above 4.00 mN·m would have been detected" in text
    assert "gap" not in text
    assert "--tie Kt=Kb" in text  # the messages of the identification are repeated


def test_sentences_for_a_misfit_of_the_electrical_equation():
    left = "41.0 times what the sensor noise explains, which no torque can cause"
    assert left in words(evolve(not_in_library(), electrical_misfit=41.0))
    assert "times what the sensor noise" not in words(not_in_library())
    assert "the intervals do not cover this error" in words(not_in_library())
    assert "the intervals do not cover this error" not in words(named())


@pytest.mark.parametrize(
    ("before", "after", "breaks"),
    [
        (1.0, 1.0, False),
        (1.4, 1.4, False),  # a small misfit
        (12.0, 2.6, False),  # an approximate formula
        (2.9, 2.6, True),  # the added effect explains little of it
        (40.0, 3.5, True),
    ],
)
def test_only_a_large_unexplained_misfit_breaks_the_electrical_equation(before, after, breaks):
    assert breaks_electrical_equation(before, after) is breaks


def test_a_single_run_with_a_far_larger_error_is_mentioned():
    runs = fake_identification(400).fit
    first, *_ = (name for name, fit in runs.items() if fit.role == "train")
    gaps = {name: Gap(4.9, 30.0 if name == first else 1.0, 1.0) for name in runs}
    text = " ".join(verdict_sentences(named(gap_of_run=gaps, verdict="not_in_library")))
    assert f"The error is largest in the run {first}, 30.0 times that of any other" in text
    # only noise; the same error in all runs
    for changes in ({"gap_of_run": gaps}, {"verdict": "not_in_library"}):
        assert "The error is largest in" not in " ".join(verdict_sentences(named(**changes)))


def test_residuals_beyond_white_noise_are_mentioned():
    with_torque_noise = evolve(named().final, missed={"current": 22.4, "speed": 19.6})
    text = words(named(final=with_torque_noise))
    assert "22.4 times the white noise of the current and 19.6 times the white noise of the" in text
    assert "treated as noise" not in words(named())


def test_sentences_for_rivals_and_the_next_experiment():
    text = words(ambiguous())
    rivals = (
        "Coulomb friction or brush voltage drop or"
        " friction that differs with direction and constant load would explain them equally well"
    )
    assert rivals in text
    assert "Coulomb friction of 50.0 mN·m (p = 0.0020)" in text
    assert "record this: creep through zero, 6 s within 12 V." in text
    assert "93.00 %" in text
    assert "No experiment within" in words(evolve(ambiguous(), next_experiment=None))


def test_sentences_for_an_effect_that_is_not_in_the_library():
    text = words(not_in_library())
    assert "no effect of the library explains" in text
    assert "over speed, most significant with −30.0 mN·m at 40.0 rad/s" in text
    partial = words(evolve(not_in_library(), effects=named().effects))
    assert "Stribeck friction (" in partial
    assert "explains part of this and was added to the model; no effect of the library explains the rest." in partial
    gap = {"train": Gap(4.0, 1.0, 1.0), "holdout": Gap(5.0, 3.0, 1.0)}
    held_out = words(evolve(not_in_library(), effects=named().effects, gap=gap))
    assert "explains part of this and was added to the model." in held_out
    assert "The error of the held-out runs is 3.00 times that of the training runs" in held_out


def test_an_effect_that_increases_the_hold_out_error_is_mentioned():
    gap = {"train": Gap(1.2, 1.0, 1.0), "holdout": Gap(1.3, 1.6, 1.0)}
    text = words(evolve(not_in_library(), effects=named().effects, gap=gap))
    assert "The addition increases the error of the held-out runs" in text
    assert "explains the rest" not in text


@pytest.mark.parametrize(("after", "beyond"), [(2.4, None), (2.6, 2.6)])
def test_a_hold_out_error_beyond_that_of_the_training_runs_is_reported(after, beyond):
    gap = {"train": Gap(4.0, 1.0, 1.0), "holdout": Gap(5.0, after, 1.0)}
    assert named(gap=gap).beyond_fitted == beyond
    assert named(gap={"train": gap["train"]}).beyond_fitted is None


@pytest.mark.parametrize(("before", "unlike"), [(5.0, True), (20.0, False)])
def test_a_small_rest_of_a_large_hold_out_gap_does_not_refute_an_effect(before, unlike):
    """15 noise variances are left, of 24 or of 399."""
    gap = {"train": Gap(4.0, 1.0, 1.0), "holdout": Gap(before, 4.0, 1.0)}
    assert holdouts_show_more(gap) == unlike
    assert "The error of the held-out runs is 4.00 times" in words(named(gap=gap))


@pytest.mark.parametrize(
    ("variable", "intervals", "reach", "text"),
    [
        ("speed", [(-20.0, 0.0), (0.0, 18.0)], 100.0, "below 20.0 rad/s, in both directions"),
        ("speed", [(-99.0, 99.0)], 100.0, "at every speed, in both directions"),
        ("speed", [(-60.0, -30.0), (32.0, 60.0)], None, "from 30.0 to 60.0 rad/s, in both directions"),
        ("speed", [(5.0, 20.0), (20.0, 30.0)], None, "from 5.00 to 30.0 rad/s"),
        ("speed", [(-100.0, -50.0), (5.0, 20.0)], None, "from −100 to −50.0 rad/s and from 5.00 to 20.0 rad/s"),
        ("current", [(3.0, 4.0)], None, "at a current from 3.00 to 4.00 A"),
        ("time", [(0.25, 0.5)], None, "from 25.0 % to 50.0 % of the run"),
    ],
)
def test_intervals_in_words(variable, intervals, reach, text):
    assert intervals_in_words(variable, intervals, reach).replace(notation.NARROW_SPACE, " ") == text


@pytest.mark.parametrize("effect", EFFECTS)
def test_words_for_parameters_contain_no_units(effect):
    for field, about in EFFECTS[effect].ranges.items():
        text = notation.parameter_words(effect, field)
        assert "_" not in text
        assert not re.search(r"\d|Nm\b|\bper\b|\brad\b|\bs$|\bV$|\bA$", text), text
        assert notation.value_with_unit(0.00123, about.unit)
        assert "m1" not in notation.value_with_unit(0.00123, about.unit)


@pytest.mark.parametrize("case", CASES)
def test_json_has_the_documented_keys(case):
    diagnosis = CASES[case]()
    found = diagnosis_json(diagnosis)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["verdict"] == case
    assert found["summary"] == verdict_sentences(diagnosis)
    assert set(found) >= {"parameters", "unidentified_directions", "fit", "noise", "converged", "seed", "seconds"}
    assert set(found["gap"]) == {"train", "holdout", "closed_fraction"}
    for effect in found["effects"]:
        assert set(effect) == {"name", "equation", "parameters", "p_value", "also_possible"}
        for estimate in effect["parameters"].values():
            assert set(estimate) >= {"value", "stderr", "ci95", "unit"}
    for region in found["where"]:
        assert set(region) == {"equation", "variable", "region", "z"}


def test_json_contains_the_values():
    found = diagnosis_json(named())
    assert found["gap"]["holdout"] == {"before": 4.9, "after": 1.02, "floor": 1.0}
    assert found["where"][0]["region"] == [-20.0, 0.0]
    assert found["effects"][0]["parameters"]["static_Nm"]["ci95"] == [0.1462, 0.1498]
    assert found["before"]["parameters"]["f"]["value"] > found["parameters"]["f"]["value"]
    unknown = {"before": None, "after": None, "floor": None}
    assert diagnosis_json(none_detected())["gap"]["holdout"] == unknown
    assert found["next_experiment"] is None
    assert set(diagnosis_json(ambiguous())["next_experiment"]) == {"why", "description", "power"}
    assert diagnosis_json(not_in_library())["curves"][0]["value"] == [0.0, 0.001, -0.03, 0.0]


@pytest.mark.parametrize(("effect", "warns"), [("speed_sensor_delay", False), ("coulomb_friction", True)])
def test_a_warning_is_not_repeated_for_a_motor_with_the_effect_of_which_it_warns(effect, warns):
    finding = Finding("run", "speed", "warning", "late", "at edges", "shift", LATE_SPEED)
    values = dict.fromkeys(EFFECTS[effect].ranges, 0.01)
    motor = named().final.motor.with_effects([EFFECTS[effect](**values)])
    found = named(final=evolve(named().final, findings=(finding,), motor=motor))
    assert ("The data check warns" in words(found)) == warns


def test_json_has_null_for_unknown_values():
    region = Region("mechanical", "speed", (0.0, 1.0), float("inf"))
    assert diagnosis_json(named(where=(region,)))["where"][0]["z"] is None


@pytest.mark.parametrize("case", CASES)
def test_tables_show_runs_effects_and_changes(case):
    diagnosis = CASES[case]()
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(diagnosis_tables(diagnosis))
    text = console.export_text()
    assert "nan" not in text.lower()
    for run in diagnosis.base.fit:
        assert run in text
    for effect in diagnosis.effects:
        assert EFFECTS[effect.name].label in text
    assert ("Change" in text) == bool(diagnosis.effects)
    assert ("Detectable with" in text) == (case == "none_detected")


@pytest.mark.parametrize("case", CASES)
def test_the_page_is_complete_and_self_contained(case, tmp_path):
    diagnosis = CASES[case]()
    write_diagnosis_report(diagnosis, tmp_path / "d.html")
    html = (tmp_path / "d.html").read_text(encoding="utf-8")
    page = Page(html)
    assert page.open == []
    assert len(html) < 6_000_000
    assert all(url.startswith(("#", "data:")) for url in page.loads), page.loads
    assert not re.search(r"\b(nan|NaN|inf|Infinity|None)\b", page.text)
    for sentence in verdict_sentences(diagnosis):
        assert sentence in page.text
    assert "if nothing were missing" in page.text
    for effect in diagnosis.effects:
        assert formula_text(effect.name, effect.parameters) in page.text
    expected_figures = 1 + len(diagnosis.curves) + (diagnosis.next_experiment is not None)
    expected_figures += len(diagnosis.base.fit) * (2 if diagnosis.effects else 1)
    expected_figures += bool(diagnosis.where)
    expected_figures += 1  # the mean residual over a variable
    expected_figures += 2 if len(diagnosis.final.search.best) else 0
    assert len(page.figures) == expected_figures


def test_averages_recover_a_residual_that_is_a_function_of_speed():
    """A residual that is a function of speed comes out as that function."""
    fit = fake_identification(3000).fit["triangle"]
    with_offset = evolve(fit, speed=fit.speed_simulated + 0.1 * np.sign(fit.speed_simulated))
    x, mean = averages({"one": with_offset}, "speed", "speed")
    clear = np.abs(x) > 5
    np.testing.assert_allclose(mean[clear], 0.1 * np.sign(x[clear]), rtol=1e-9)


def test_drifts_are_of_the_parameters_that_both_motors_have():
    found = {one.name: one.percent for one in drifts(named())}
    assert set(found) == {"R", "L", "Kb", "Kt", "J", "f"}
    assert found["f"] == pytest.approx(-60)
    assert found["R"] == 0


def test_no_change_is_stated_for_a_parameter_that_was_at_a_bound():
    base = named().base
    at_bound = evolve(base.parameters["f"], status="at_bound", stderr=None, ci95=None)
    text = words(named(base=evolve(base, parameters={**base.parameters, "f": at_bound})))
    assert "changed f by" in words(named())
    assert "changed f by" not in text


def test_the_next_experiment_is_written_as_csv(tmp_path):
    path = tmp_path / "next.csv"
    assert write_experiment(ambiguous(), path)
    header, *rows = path.read_text().splitlines()
    assert header == "time_s,voltage_V"
    table = np.array([row.split(",") for row in rows], float)
    np.testing.assert_allclose(table[:, 1], 3 * table[:, 0])
    assert not write_experiment(named(), tmp_path / "none.csv")
    assert not (tmp_path / "none.csv").exists()
