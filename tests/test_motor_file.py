"""Motors as JSON files: they round-trip, and every invalid file is refused with one message."""

from __future__ import annotations

import json

import numpy as np
import pytest
from linear_motor import PAPER

from pmdc_jax import InputError, load_motor, save_motor
from pmdc_jax.effects import EFFECTS
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.motor_file import load_speed_noise, load_uncertainty

VALID = {"parameters": PAPER, "effects": [{"name": "coulomb_friction", "parameters": {"torque_Nm": 0.1}}]}


def fields(motor: Motor) -> dict[str, float]:
    return {name: float(getattr(motor, name)) for name in PARAMETERS}


def test_a_motor_with_every_effect_round_trips_exactly(tmp_path):
    rng = np.random.default_rng(1)
    effects = tuple(
        effect(**{field: np.asarray(r.lower * rng.uniform(1, 2)) for field, r in effect.ranges.items()})
        for effect in EFFECTS.values()
    )
    constants = {name: np.asarray(x * rng.uniform(1, 2)) for name, x in PAPER.items()}
    motor, path = Motor(**constants, effects=effects), tmp_path / "motor.json"
    save_motor(path, motor)
    loaded = load_motor(path)
    assert fields(loaded) == fields(motor)
    assert [type(e) for e in loaded.effects] == [type(e) for e in effects]
    for before, after in zip(effects, loaded.effects, strict=True):
        for field in before.ranges:
            assert float(getattr(after, field)) == float(getattr(before, field))
    assert [p.name for p in tmp_path.iterdir()] == ["motor.json"], "a temporary file is left behind"


def test_plain_numbers_can_be_saved(tmp_path):
    save_motor(tmp_path / "motor.json", Motor(**PAPER))
    assert fields(load_motor(tmp_path / "motor.json")) == PAPER


def test_a_hand_written_file_needs_the_six_parameters_only(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps({"parameters": PAPER | {"f": 0}}))
    motor = load_motor(path)
    assert fields(motor) == PAPER | {"f": 0.0}
    assert motor.effects == ()


def test_what_no_recording_determined_is_refused_where_it_is_needed(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps({"parameters": PAPER | dict.fromkeys(("R", "L", "Kb", "Kt"))}))
    assert float(load_motor(path, "torque").J) == PAPER["J"]
    with pytest.raises(InputError, match="R is null: no recording determined it"):
        load_motor(path)
    with pytest.raises(InputError, match="Kt is null"):
        load_motor(path, "current")
    with pytest.raises(InputError, match="R is null"):
        load_motor(path, "held")


def test_a_byte_order_mark_is_skipped(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps({"parameters": PAPER}), encoding="utf-8-sig")
    assert fields(load_motor(path)) == PAPER


def test_a_file_states_the_units_of_its_values(tmp_path):
    save_motor(tmp_path / "motor.json", Motor(**PAPER))
    content = json.loads((tmp_path / "motor.json").read_text())
    assert content["units"] == PARAMETERS
    assert content["parameters"] == PAPER


def with_value(content: dict, *path, to) -> dict:
    """A copy of the content of a JSON file with one value replaced."""
    content = json.loads(json.dumps(content))
    inner = content
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = to
    return content


def file_with(*path, to) -> str:
    """The valid file with one value replaced."""
    return json.dumps(with_value(VALID, *path, to=to))


def file_without(name: str) -> str:
    return json.dumps({"parameters": {n: x for n, x in PAPER.items() if n != name}})


def effect(name: str, *values: float) -> dict[str, object]:
    return {"name": name, "parameters": dict(zip(EFFECTS[name].ranges, values, strict=True))}


INVALID = {
    "empty": ("", "JSON"),
    "not JSON": ("{'parameters': 1}", "JSON"),
    "cut off": (json.dumps(VALID)[:50], "JSON"),
    "not text": (b"\xff\xfe\x00\x80", "JSON"),
    "a list": ("[1, 2]", "object"),
    "a number": ("3", "object"),
    "null": ("null", "object"),
    "no parameters": ("{}", "parameters"),
    "parameters in a list": (file_with("parameters", to=[1, 2, 3]), "parameters"),
    **{f"lacks {name}": (file_without(name), name) for name in PARAMETERS},
    "a text": (file_with("parameters", "R", to="0.1"), "R"),
    "true": (file_with("parameters", "R", to=True), "R"),
    "null value": (file_with("parameters", "L", to=None), "L"),
    "a list for a number": (file_with("parameters", "L", to=[1.0]), "L"),
    "zero": (file_with("parameters", "J", to=0.0), "J"),
    "negative": (file_with("parameters", "Kt", to=-0.05), "Kt"),
    "negative friction": (file_with("parameters", "f", to=-1e-9), "f"),
    "not a number": (file_with("parameters", "R", to=float("nan")), "R"),
    "infinite": (file_with("parameters", "R", to=float("inf")), "R"),
    "infinite by digits": (file_with("parameters", "R", to=7).replace("7", "1e999", 1), "R"),
    "three hundred digits": (file_with("parameters", "R", to=10**400), "R"),
    "unknown effect": (file_with("effects", 0, "name", to="magic"), "magic"),
    "effect without a name": (file_with("effects", 0, to={"parameters": {}}), "effect"),
    "effect named by a list": (file_with("effects", 0, "name", to=["coulomb_friction"]), "effect"),
    "effect as a text": (file_with("effects", 0, to="coulomb_friction"), "coulomb_friction"),
    "effect as a number": (file_with("effects", 0, to=3), "effect"),
    "effect without parameters": (file_with("effects", 0, to={"name": "coulomb_friction"}), "torque_Nm"),
    "effect's parameters in a list": (file_with("effects", 0, "parameters", to=[0.1]), "coulomb"),
    "effect's parameter a text": (file_with("effects", 0, "parameters", "torque_Nm", to="x"), "torque_Nm"),
    "effect of negative size": (file_with("effects", 0, "parameters", "torque_Nm", to=-1.0), "torque_Nm"),
    "effect of no size": (file_with("effects", 0, "parameters", "torque_Nm", to=0), "torque_Nm"),
    "more than the whole inertia behind a shaft": (
        file_with("effects", to=[effect("shaft_compliance", 50.0, 1e-3, 1.5)]),
        "load_share",
    ),
    "twice the same effect": (file_with("effects", to=2 * VALID["effects"]), "coulomb_friction"),
    "effects not in a list": (file_with("effects", to={"coulomb_friction": 0.1}), "effect"),
    "effects null": (file_with("effects", to=None), "effects"),
    "effects a number": (file_with("effects", to=5), "effects"),
    "of a later version": (json.dumps(VALID | {"format": "pmdc motor 2"}), "Update pmdc_jax"),
    "a result": (json.dumps(VALID | {"seconds": {}}), "result of --json. .* identify --save wrote"),
    "a controller": (
        json.dumps(VALID | {"format": "pmdc controller 1"}),
        "Give the motor file that pmdc identify --save wrote",
    ),
    "another unit": (file_with("units", to={"R": "ohm", "L": "mH"}), "the unit of L is 'mH', but values are read in H"),
    "units a text": (file_with("units", to="SI"), "units"),
    "status a text": (json.dumps(VALID | {"status": "identified"}), "status"),
}


@pytest.mark.parametrize(("content", "expected"), INVALID.values(), ids=INVALID.keys())
def test_an_invalid_file_is_refused(tmp_path, content, expected):
    path = tmp_path / "bad.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=expected) as refusal:
        load_motor(path)
    assert str(path) in str(refusal.value)
    assert refusal.value.mend


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "nowhere.json", tmp_path):
        with pytest.raises(InputError, match=path.name):
            load_motor(path)


COVARIANCE = {"names": ["R", "Kb"], "matrix": [[1e-4, 0.0], [0.0, 1e-4]]}
INVALID_COVARIANCES = {
    "a text": "small",
    "no names": {"matrix": COVARIANCE["matrix"]},
    "names of lists": COVARIANCE | {"names": [["R"], ["Kb"]]},
    "twice the same name": COVARIANCE | {"names": ["R", "R"]},
    "unknown name": COVARIANCE | {"names": ["R", "magic"]},
    "another size": COVARIANCE | {"matrix": [[1e-4]]},
    "a text within": COVARIANCE | {"matrix": [[1e-4, 0.0], [0.0, "x"]]},
    "not a number": COVARIANCE | {"matrix": [[1e-4, 0.0], [0.0, float("nan")]]},
    "beyond a double": COVARIANCE | {"matrix": [[1e-4, 0.0], [0.0, 10**400]]},
    "negative variance": COVARIANCE | {"matrix": [[1e-4, 0.0], [0.0, -1e-4]]},
    "not symmetric": COVARIANCE | {"matrix": [[1e-4, 1e-5], [0.0, 1e-4]]},
}


def assert_refused(tmp_path, entry: str, value: object, load) -> None:
    """The valid file with this entry is refused, in a message that names both."""
    path = tmp_path / "motor.json"
    path.write_text(json.dumps(VALID | {entry: value}))
    with pytest.raises(InputError, match=entry) as refusal:
        load(path)
    assert str(path) in str(refusal.value)


def test_a_covariance_is_read(tmp_path):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps(VALID | {"covariance": COVARIANCE, "status": {"L": "not_identifiable"}}))
    found = load_uncertainty(path)
    assert (found.names, found.undetermined) == (("R", "Kb"), ("L",))
    assert found.covariance.tolist() == COVARIANCE["matrix"]


@pytest.mark.parametrize("covariance", INVALID_COVARIANCES.values(), ids=INVALID_COVARIANCES.keys())
def test_an_invalid_covariance_is_refused(tmp_path, covariance):
    assert_refused(tmp_path, "covariance", covariance, load_uncertainty)


@pytest.mark.parametrize(("noise", "read"), [({}, None), ({"speed_rad_s": None}, None), ({"speed_rad_s": 0.3}, 0.3)])
def test_the_noise_of_the_speed_is_read(tmp_path, noise, read):
    path = tmp_path / "motor.json"
    path.write_text(json.dumps(VALID))
    assert load_speed_noise(path) is None
    path.write_text(json.dumps(VALID | {"noise": noise}))
    assert load_speed_noise(path) == read


@pytest.mark.parametrize("noise", [0.3, "low", {"speed_rad_s": -1.0}, {"speed_rad_s": "low"}])
def test_an_invalid_noise_is_refused(tmp_path, noise):
    assert_refused(tmp_path, "noise", noise, load_speed_noise)
