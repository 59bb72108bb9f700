"""Control laws as JSON files and as C code: written, read, compiled, and compared sample by sample."""

from __future__ import annotations

import json
import subprocess
from shutil import which

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_control import LAWS, MOTOR, SAMPLED, SETPOINT, course, run
from test_motor_file import with_value

from pmdc_jax import InputError, export, load_controller, save_controller
from pmdc_jax.control import Hardware, Law
from pmdc_jax.control.controllers import Memory
from pmdc_jax.control.law import LawState

HARDWARE = {
    "delay, current limit": Hardware(1e-3, 30.0, 60.0, 0.1, 1),
    "no delay, current limit": Hardware(1e-3, 30.0, 45.0, None, 0),
    "no delay, no current sensor": Hardware(1e-3, 30.0, 45.0, None, 0, False),
    "delay, no current sensor or limit": Hardware(5e-4, 30.0, None, None, 1, False),
}
MAIN = r"""
#include <stdio.h>
#include "controller.h"

int main(void)
{
    pmdc_state state;
    double reference, speed, current;
    pmdc_start(&state);
    while (scanf("%lf %lf %lf", &reference, &speed, &current) == 3)
        printf("%.17g\n", (double)pmdc_step(&state, (pmdc_real)reference, (pmdc_real)speed,
                                            (pmdc_real)current));
    return 0;
}
"""
needs_gcc = pytest.mark.skipif(which("gcc") is None, reason="there is no gcc")


@pytest.fixture(autouse=True)
def _double(x64):
    """Double precision in all tests of this file."""


def inputs() -> np.ndarray:
    """Reference, speed and current, (samples, 3), with which the law saturates, settles and reverses, in noise."""
    rng = np.random.default_rng(5)
    reference = np.repeat([481.0, 481.0, 240.5, -300.0, 0.0], 80)
    response = run(MOTOR, Law.of(LAWS["pid"], SAMPLED, MOTOR), course(400))
    speed = np.asarray(response.speed) * reference / SETPOINT + rng.standard_normal(400)
    current = np.asarray(response.current) + 5 * rng.standard_normal(400)
    return np.stack([reference, speed, current], axis=1)


@eqx.filter_jit
def in_python(law: Law, samples):
    zero = jnp.zeros(())
    start = LawState(Memory(zero, zero), zero, zero, zero)
    return jax.lax.scan(lambda state, now: law.step(state, *now), start, samples)[1]


def in_c(folder, *options: str, samples: np.ndarray) -> np.ndarray:
    """Compile without a warning and run."""
    (folder / "main.c").write_text(MAIN)
    program = folder / "program"
    command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", *options]
    subprocess.run([*command, str(folder / "main.c"), "-o", str(program)], check=True)
    text = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in samples)
    done = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), float)


@needs_gcc
@pytest.mark.parametrize("hardware", HARDWARE.values(), ids=HARDWARE.keys())
@pytest.mark.parametrize("name", LAWS)
def test_the_law_in_c_matches_python(tmp_path, name, hardware):
    law, samples = Law.of(LAWS[name], hardware, MOTOR), inputs()
    export(law, tmp_path / "controller.h")
    expected = np.asarray(in_python(law, tuple(jnp.asarray(samples.T))))
    assert np.ptp(expected) > 30, "the inputs do not excite the law enough"
    np.testing.assert_allclose(in_c(tmp_path, samples=samples), expected, rtol=0, atol=1e-9)
    # single precision: speeds of 481 are held to 3e-5, which the gains magnify; the limits hide the rest
    single = in_c(tmp_path, "-DPMDC_REAL=float", samples=samples)
    np.testing.assert_allclose(single, expected, rtol=0, atol=2e-2)


@needs_gcc
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_the_law_in_c_ignores_readings_that_are_no_numbers(tmp_path, bad):
    law, samples = Law.of(LAWS["pid"], HARDWARE["delay, current limit"], MOTOR), inputs()
    export(law, tmp_path / "controller.h")
    for row, column in ((50, 1), (51, 2), (200, 0)):
        samples = np.insert(samples, row, samples[row], axis=0)
        samples[row, column] = bad
    good = np.isfinite(samples).all(1)
    found = in_c(tmp_path, samples=samples)
    np.testing.assert_array_equal(found[good], in_c(tmp_path, samples=samples[good]))
    np.testing.assert_array_equal(found[~good], found[np.flatnonzero(~good) - 1])


@pytest.mark.parametrize("hardware", HARDWARE.values(), ids=HARDWARE.keys())
@pytest.mark.parametrize("name", LAWS)
def test_a_controller_file_round_trips_exactly(tmp_path, name, hardware):
    law, path = Law.of(LAWS[name], hardware, MOTOR), tmp_path / "controller.json"
    save_controller(path, law)
    loaded = load_controller(path)
    assert jax.tree.structure(loaded) == jax.tree.structure(jax.tree.map(float, law))
    assert jax.tree.leaves(loaded) == [float(leaf) for leaf in jax.tree.leaves(law)]


INVALID = {
    "no type": (("type",), "fuzzy", "type"),
    "gain missing": (("gains",), {}, "proportional"),
    "gain a text": (("gains", "integral"), "x", "integral"),
    "gain infinite": (("gains", "integral"), 1e999, "integral"),
    "gain true": (("gains", "integral"), True, "integral"),
    "no sample time": (("sample_time_s",), None, "sample_time_s"),
    "sample time zero": (("sample_time_s",), 0.0, "sample_time_s"),
    "no limits": (("limits",), None, "voltage_V"),
    "negative limit": (("limits", "current_A"), -1.0, "current_A"),
    "delay of two": (("delay_samples",), 2, "delay"),
    "no model": (("model",), None, "ii"),
    "type a list": (("type",), [], "type"),
    "gain of four hundred digits": (("gains", "integral"), 10**400, "integral"),
    "of a later version": (("format",), "pmdc controller 2", "Update pmdc_jax"),
    "a motor": (("format",), "pmdc motor 1", "Give the controller file that pmdc tune --save wrote"),
    "a result": (("seconds",), {}, "result of --json. .* tune --save wrote"),
}


@pytest.mark.parametrize(("path", "value", "expected"), INVALID.values(), ids=INVALID.keys())
def test_an_invalid_controller_file_is_refused(tmp_path, path, value, expected):
    file = tmp_path / "controller.json"
    save_controller(file, Law.of(LAWS["pi"], SAMPLED, MOTOR))
    file.write_text(json.dumps(with_value(json.loads(file.read_text()), *path, to=value)))
    with pytest.raises(InputError, match=expected) as refusal:
        load_controller(file)
    assert str(file) in str(refusal.value)


def test_a_missing_or_broken_controller_file_is_refused(tmp_path):
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    for path in (tmp_path / "nowhere.json", tmp_path, broken):
        with pytest.raises(InputError, match=path.name):
            load_controller(path)
