"""The reproduction of the wheelchair paper: the response with the printed gains, and the written report."""

import json

import control
import numpy as np
import pytest

from pmdc_jax.paper.pipeline import paper
from pmdc_jax.paper.printed import PRINTED, SETPOINT, TABLE_1, TABLE_2
from pmdc_jax.paper.reproduction import FILTER_RATIO, Paper, Recovered, simulated_as_printed
from pmdc_jax.report.paper.tables import table_1


@pytest.mark.parametrize("kind", ["pi", "pid"])
def test_response_with_printed_gains_matches_python_control(kind):
    R, L, Kb, Kt, J, f = TABLE_1.values()
    proportional, integral, derivative = TABLE_2[kind].gains
    s, lag = control.tf("s"), FILTER_RATIO * derivative / proportional
    motor = Kt / ((L * s + R) * (J * s + f) + Kt * Kb)
    law = proportional + integral / s + derivative * s / (lag * s + 1)
    loop = control.feedback(law * motor)
    expected = control.step_info(loop, T=np.arange(0, 0.2, 1e-5))
    found = simulated_as_printed(proportional, integral, derivative)
    assert found.overshoot == pytest.approx(expected["Overshoot"], rel=1e-4)
    assert found.settling == pytest.approx(expected["SettlingTime"], abs=1e-4)
    voltage = control.step_response(control.feedback(law, motor), np.arange(0, 0.2, 1e-5))
    assert found.peak_voltage == pytest.approx(SETPOINT * voltage.outputs.max(), rel=1e-3)


def test_table_1_states_the_units():
    found = Recovered("ours", PRINTED, evaluations=9, seconds=1.0, best=np.ones(3))
    made_up = Paper((found,), 0.0, *4 * ({},))
    assert [row[0] for row in table_1(made_up)[1]][:3] == ["R [Ω]", "L [H]", "Kb [V·s/rad]"]


@pytest.mark.slow
def test_report_compares_printed_results_with_the_physical_limits(tmp_path):
    result = paper(tmp_path)
    written = json.loads((tmp_path / "paper.json").read_text())
    assert max(map(abs, written["table_1"]["ours"]["error_percent"].values())) < 1.0
    for kind, row in written["table_2"].items():
        fastest = written["fastest_possible_settling_s"]["25 V"]
        assert fastest <= row["ours"]["SettlingTime"] < 1.05 * fastest, kind
        assert row["printed"]["SettlingTime"] == TABLE_2[kind].settling
    assert set(result.as_printed) == {"pi", "pid"}
    assert written["reach_rad_s"]["24 V"] < SETPOINT
    page = (tmp_path / "paper.html").read_text(encoding="utf-8")
    assert "printed gains" in page
