"""Motors as JSON: what is written is read again, and every bad file is refused in one message."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import virtual_bench as vb
from pmdc_jax import InputError, load_motor, save_motor
from pmdc_jax.effects import EFFECTS
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.motor_file import load_uncertainty

PAPER = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
GOOD = {
    "parameters": PAPER,
    "effects": [{"name": "coulomb_friction", "parameters": {"torque_Nm": 0.1}}],
}


def fields(motor: Motor) -> dict[str, float]:
    return {name: float(getattr(motor, name)) for name in PARAMETERS}


def test_a_motor_with_every_effect_round_trips_to_the_last_digit(tmp_path):
    rng = np.random.default_rng(1)
    effects = tuple(
        effect(
            **{field: np.asarray(r.lower * rng.uniform(1, 2)) for field, r in effect.ranges.items()}
        )
        for effect in EFFECTS.values()
    )
    constants = {name: np.asarray(x * rng.uniform(1, 2)) for name, x in PAPER.items()}
    motor, path = Motor(**constants, effects=effects), tmp_path / "motor.json"
    save_motor(path, motor)
    again = load_motor(path)
    assert fields(again) == fields(motor)
    assert [type(e) for e in again.effects] == [type(e) for e in effects]
    for before, after in zip(effects, again.effects, strict=True):
        for field in before.ranges:
            assert float(getattr(after, field)) == float(getattr(before, field))
    assert [p.name for p in tmp_path.iterdir()] == ["motor.json"], "no draft is left behind"


def test_plain_numbers_can_be_saved(tmp_path):
    save_motor(tmp_path / "motor.json", Motor(**PAPER))
    assert fields(load_motor(tmp_path / "motor.json")) == PAPER


def test_a_file_by_hand_needs_the_six_numbers_only(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps({"parameters": PAPER | {"f": 0}}))
    motor = load_motor(path)
    assert fields(motor) == PAPER | {"f": 0.0}
    assert motor.effects == ()


def test_units_are_written_beside_the_values(tmp_path):
    save_motor(tmp_path / "motor.json", Motor(**PAPER))
    content = json.loads((tmp_path / "motor.json").read_text())
    assert content["units"] == PARAMETERS
    assert content["parameters"] == PAPER


def changed(*path, to):
    """The good file with one thing in it replaced."""
    content = json.loads(json.dumps(GOOD))
    inner = content
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = to
    return json.dumps(content)


def lacking(name: str) -> str:
    return json.dumps({"parameters": {n: x for n, x in PAPER.items() if n != name}})


BAD = {
    "empty": ("", "JSON"),
    "not JSON": ("{'parameters': 1}", "JSON"),
    "cut off": (json.dumps(GOOD)[:50], "JSON"),
    "not text": (b"\xff\xfe\x00\x80", "JSON"),
    "a list": ("[1, 2]", "object"),
    "a number": ("3", "object"),
    "null": ("null", "object"),
    "no parameters": ("{}", "parameters"),
    "parameters in a list": (changed("parameters", to=[1, 2, 3]), "parameters"),
    **{f"lacks {name}": (lacking(name), name) for name in PARAMETERS},
    "a text": (changed("parameters", "R", to="0.1"), "R"),
    "true": (changed("parameters", "R", to=True), "R"),
    "null value": (changed("parameters", "L", to=None), "L"),
    "a list for a number": (changed("parameters", "L", to=[1.0]), "L"),
    "zero": (changed("parameters", "J", to=0.0), "J"),
    "negative": (changed("parameters", "Kt", to=-0.05), "Kt"),
    "negative friction": (changed("parameters", "f", to=-1e-9), "f"),
    "not a number": (changed("parameters", "R", to=float("nan")), "R"),
    "infinite": (changed("parameters", "R", to=float("inf")), "R"),
    "infinite by digits": (changed("parameters", "R", to=7).replace("7", "1e999", 1), "R"),
    "three hundred digits": (changed("parameters", "R", to=10**400), "R"),
    "unknown effect": (changed("effects", 0, "name", to="magic"), "magic"),
    "effect without a name": (changed("effects", 0, to={"parameters": {}}), "effect"),
    "effect named by a list": (changed("effects", 0, "name", to=["coulomb_friction"]), "effect"),
    "effect as a text": (changed("effects", 0, to="coulomb_friction"), "coulomb_friction"),
    "effect as a number": (changed("effects", 0, to=3), "effect"),
    "effect without parameters": (
        changed("effects", 0, to={"name": "coulomb_friction"}),
        "torque_Nm",
    ),
    "effect's parameters in a list": (changed("effects", 0, "parameters", to=[0.1]), "coulomb"),
    "effect's parameter a text": (
        changed("effects", 0, "parameters", "torque_Nm", to="x"),
        "torque_Nm",
    ),
    "effect of negative size": (
        changed("effects", 0, "parameters", "torque_Nm", to=-1.0),
        "torque_Nm",
    ),
    "twice the same effect": (changed("effects", to=2 * GOOD["effects"]), "coulomb_friction"),
    "effects not in a list": (changed("effects", to={"coulomb_friction": 0.1}), "effect"),
    "effects null": (changed("effects", to=None), "effects"),
    "effects a number": (changed("effects", to=5), "effects"),
    "of a later version": (json.dumps(GOOD | {"format": "pmdc motor 2"}), "format"),
    "status a text": (json.dumps(GOOD | {"status": "identified"}), "status"),
}


@pytest.mark.parametrize(("content", "says"), BAD.values(), ids=BAD.keys())
def test_a_bad_file_is_refused(tmp_path, content, says):
    path = tmp_path / "bad.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=says) as refusal:
        load_motor(path)
    assert str(path) in str(refusal.value)
    assert refusal.value.mend


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "nowhere.json", tmp_path):
        with pytest.raises(InputError, match=path.name):
            load_motor(path)


ONE = {"names": ["R", "Kb"], "matrix": [[1e-4, 0.0], [0.0, 1e-4]]}
NO_COVARIANCE = {
    "a text": "small",
    "no names": {"matrix": ONE["matrix"]},
    "names of lists": ONE | {"names": [["R"], ["Kb"]]},
    "twice the same name": ONE | {"names": ["R", "R"]},
    "unknown name": ONE | {"names": ["R", "magic"]},
    "another size": ONE | {"matrix": [[1e-4]]},
    "a text within": ONE | {"matrix": [[1e-4, 0.0], [0.0, "x"]]},
    "not a number": ONE | {"matrix": [[1e-4, 0.0], [0.0, float("nan")]]},
    "beyond a double": ONE | {"matrix": [[1e-4, 0.0], [0.0, 10**400]]},
    "negative variance": ONE | {"matrix": [[1e-4, 0.0], [0.0, -1e-4]]},
    "not symmetric": ONE | {"matrix": [[1e-4, 1e-5], [0.0, 1e-4]]},
}


def test_a_covariance_is_read(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps(GOOD | {"covariance": ONE, "status": {"L": "not_identifiable"}}))
    found = load_uncertainty(path)
    assert (found.names, found.undetermined) == (("R", "Kb"), ("L",))
    assert found.covariance.tolist() == ONE["matrix"]


@pytest.mark.parametrize("given", NO_COVARIANCE.values(), ids=NO_COVARIANCE.keys())
def test_a_bad_covariance_is_refused(tmp_path, given):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps(GOOD | {"covariance": given}))
    with pytest.raises(InputError, match="covariance") as refusal:
        load_uncertainty(path)
    assert str(path) in str(refusal.value)
