"""The motor's equations against python-control and closed forms."""

from __future__ import annotations

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_motor import PAPER

from pmdc_jax.motor import PARAMETERS, Drive, Motor


def motor(**changes) -> Motor:
    return Motor(**{n: np.asarray(x, float) for n, x in (PAPER | changes).items()})


def random_motors(count: int) -> list[dict[str, float]]:
    """Motors over four decades about the paper's."""
    rng = np.random.default_rng(1)
    return [{n: x * 10 ** rng.uniform(-2, 2) for n, x in PAPER.items()} for _ in range(count)]


MOTORS = {"paper": PAPER} | {f"drawn {k}": m for k, m in enumerate(random_motors(5))}
each_motor = pytest.mark.parametrize("m", MOTORS.values(), ids=MOTORS.keys())


def plant(m: dict[str, float]) -> control.StateSpace:
    """The motor by python-control, joined from its two halves as in a block diagram."""
    s = control.tf("s")
    electrical = control.ss(1 / (m["L"] * s + m["R"]))
    mechanical = control.ss(1 / (m["J"] * s + m["f"]))
    electrical.set_inputs(["armature"]), electrical.set_outputs(["current"])
    mechanical.set_inputs(["torque"]), mechanical.set_outputs(["speed"])
    return control.interconnect(
        [
            electrical,
            mechanical,
            control.ss([], [], [], [[1, -m["Kb"]]], inputs=["voltage", "speed"], outputs="armature"),
            control.ss([], [], [], [[m["Kt"], -1]], inputs=["current", "load"], outputs="torque"),
        ],
        inputs=["voltage", "load"],
        outputs=["current", "speed"],
    )


OMEGA = np.logspace(-3, 6, 50)


@each_motor
def test_state_space_matches_the_block_diagram(x64, m):
    A, B = motor(**m).state_space()
    ours = control.ss(A, B, np.eye(2), np.zeros((2, 2)))
    ours, reference = (ours.frequency_response(OMEGA).frdata, plant(m).frequency_response(OMEGA).frdata)
    np.testing.assert_allclose(ours, reference, rtol=1e-9)


@each_motor
def test_transfer_functions_match_the_block_diagram(x64, m):
    numerators, denominator = motor(**m).transfer_function()
    reference = plant(m).frequency_response(OMEGA)
    for name, numerator in numerators.items():
        source, target = name.split(" -> ")
        ours = control.tf(np.asarray(numerator), np.asarray(denominator))
        row, column = ["current", "speed"].index(target), ["voltage", "load"].index(source)
        expected = reference.frdata[row, column]
        np.testing.assert_allclose(ours(1j * OMEGA), expected, rtol=1e-9)


def test_the_motor_of_table_1_settles_at_480_rad_per_s(x64):
    """At 24 V without load, w = Kt v / (R f + Kt Kb), less than the paper's set point of 481."""
    A, B = (np.asarray(x) for x in motor().state_space())
    current, speed = np.linalg.solve(A, -B @ [24.0, 0.0])
    assert speed == pytest.approx(480.0, abs=0.05)
    assert speed == pytest.approx(PAPER["Kt"] * 24 / (PAPER["R"] * PAPER["f"] + PAPER["Kt"] * PAPER["Kb"]), rel=1e-12)
    assert current == pytest.approx(PAPER["f"] * speed / PAPER["Kt"], rel=1e-12)
    numerators, denominator = motor().transfer_function()
    gain = numerators["voltage -> speed"][-1] / denominator[-1]
    assert 24 * gain == pytest.approx(speed, rel=1e-12)


@each_motor
def test_eigenvalues_match_the_poles(x64, m):
    """Their sum and product by hand, and the roots of the denominator."""
    A, _ = motor(**m).state_space()
    poles = np.linalg.eigvals(A)
    assert np.sum(poles).real == pytest.approx(-m["R"] / m["L"] - m["f"] / m["J"], rel=1e-9)
    product = (m["R"] * m["f"] + m["Kt"] * m["Kb"]) / (m["L"] * m["J"])
    assert np.prod(poles).real == pytest.approx(product, rel=1e-6)
    assert np.all(poles.real < 0)
    _, denominator = motor(**m).transfer_function()
    np.testing.assert_allclose(np.sort(np.roots(denominator)), np.sort(poles), rtol=1e-6)


def test_state_space_matches_equation_8_with_its_signs_corrected(x64):
    """The paper prints +R/L, with which the motor would be unstable, and the load multiplied by the voltage."""
    A, B = motor().state_space()
    m = PAPER
    expected = [[-m["R"] / m["L"], -m["Kb"] / m["L"]], [m["Kt"] / m["J"], -m["f"] / m["J"]]]
    np.testing.assert_allclose(A, expected, rtol=1e-14)
    np.testing.assert_allclose(B, [[1 / m["L"], 0], [0, -1 / m["J"]]], rtol=1e-14)
    printed = np.array(A) * [[-1, 1], [1, 1]]
    assert np.linalg.eigvals(printed).real.max() > 0 > np.linalg.eigvals(A).real.max()


@each_motor
def test_the_derivative_matches_the_state_space(x64, m):
    rng = np.random.default_rng(2)
    A, B = (np.asarray(x) for x in motor(**m).state_space())
    for x, u in rng.standard_normal((5, 2, 2)):
        state = motor(**m).initial_state(jnp.asarray(x[0]), jnp.asarray(x[1]))
        rate = motor(**m).derivative(state, jnp.asarray(u[0]), jnp.asarray(u[1]))
        np.testing.assert_allclose([rate.current, rate.speed], A @ x + B @ u, rtol=1e-9)
        assert rate.extra == {}


DRIVES = {"current": Drive(0.0, 1.0, 0.0), "torque": Drive(0.0, 0.0, 1.0)}


@pytest.mark.parametrize("kind", DRIVES)
def test_a_current_or_torque_drives_the_mechanical_half_alone(x64, kind):
    """The electrical equation is switched off, whatever R, L and Kb are."""
    drive, gain = DRIVES[kind], {"current": PAPER["Kt"], "torque": 1.0}[kind]
    half = motor(R=7.0, L=3.0, Kb=11.0)
    A, B = half.state_space(drive)
    np.testing.assert_allclose(A, [[0, 0], [0, -PAPER["f"] / PAPER["J"]]], rtol=1e-14, atol=0)
    np.testing.assert_allclose(B, [[0, 0], [gain / PAPER["J"], -1 / PAPER["J"]]], rtol=1e-14)
    state = half.initial_state(jnp.asarray(0.0), jnp.asarray(40.0))
    rate = half.derivative(state, jnp.asarray(2.0), jnp.asarray(0.1), drive)
    assert rate.current == 0
    expected = (gain * 2.0 - PAPER["f"] * 40.0 - 0.1) / PAPER["J"]
    assert rate.speed == pytest.approx(expected, rel=1e-12)


def test_a_population_matches_its_members(x64):
    """Fields of a common shape give matrices with that shape as their last axes."""
    members = random_motors(7)
    together = Motor(**{n: np.array([m[n] for m in members]) for n in PARAMETERS})
    A, B = together.state_space()
    numerators, denominator = together.transfer_function()
    assert (A.shape, B.shape, denominator.shape) == ((2, 2, 7), (2, 2, 7), (3, 7))
    for k, m in enumerate(members):
        alone = motor(**m)
        np.testing.assert_array_equal(A[..., k], alone.state_space()[0])
        np.testing.assert_array_equal(B[..., k], alone.state_space()[1])
        np.testing.assert_array_equal(denominator[:, k], alone.transfer_function()[1])
        for name, numerator in alone.transfer_function()[0].items():
            np.testing.assert_array_equal(numerators[name][:, k], numerator)


def test_a_motor_may_have_plain_numbers():
    plain = Motor(**PAPER)
    np.testing.assert_allclose(plain.state_space()[0], motor().state_space()[0], rtol=1e-6)
    assert plain.states == ()
    numerators, _ = plain.transfer_function()
    assert float(numerators["voltage -> speed"][0]) == pytest.approx(PAPER["Kt"])


def test_a_motor_is_a_pytree_of_its_six_parameters():
    assert len(jax.tree.leaves(motor())) == 6
    doubled = jax.tree.map(lambda x: 2 * x, motor())
    assert float(doubled.J) == 2 * PAPER["J"]
