"""The naming benchmark: its motors against an adaptive solver and closed forms; seeds; scores; baselines."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks import virtual_bench as vb
from benchmarks.naming import foreign, sparse, stepwise
from benchmarks.naming.cases import SUITES, SWEEP_PERCENT, VISIBLE, case, dump
from benchmarks.naming.excitations import HOLDOUT, jittered
from benchmarks.naming.hidden import FORMULAS, LIBRARY, STRANGERS
from benchmarks.naming.plant import Plant, simulate, substeps
from benchmarks.naming.score import canonical, gap_closed, intervals, outcome, right
from benchmarks.naming.strength import Gauge, amplitude_for, linear

PAPER = Plant(*(getattr(vb.paper_motor(), name) for name in vb.SIX))
HIDDEN = {**LIBRARY, **FORMULAS, **STRANGERS}


# ------------------------------------------------------------------------- against solve_ivp


def reference_slope(t, x, v, load, p):
    """The equations with all effects, written independently; dry elements always slip."""
    i, w, angle, w_load, twist, heat, slow, bristle, _, sag = x
    saturation = {
        0.0: lambda c: 1 / (1 + c * i**2),
        1.0: lambda c: np.tanh(np.sqrt(c) * i) / (np.sqrt(c) * i),
        2.0: lambda c: 1 / (1 + np.sqrt(c) * abs(i)),
    }
    Kt = p.Kt * (saturation[p.kt_curve](p.kt_saturation) if p.kt_saturation else 1)
    L = p.L * (saturation[p.l_curve](p.l_saturation) if p.l_saturation else 1)
    ripple = 1 + p.ripple * np.sin(p.ripple_periods * angle + p.ripple_phase)
    Kb = p.Kb * (ripple if p.ripple_in_emf else 1)
    R = p.R * (1 + heat + slow)
    u = np.sign(v) * max(abs(v) - p.dead_zone_V, 0) * (1 - sag / p.bus_V)
    brush = p.brush_V * (np.tanh(i / p.brush_onset_A) if p.brush_onset_A else np.sign(i))

    n = w / p.stribeck_speed_rad_s
    excess = np.exp(-(abs(n) ** p.stribeck_shape)) if p.stribeck_shape else 1 / (1 + n**2)
    level = p.friction_forward_Nm if w > 0 else p.friction_backward_Nm
    level += p.friction_excess_Nm * excess + p.seizing_Nm * (t >= p.seizing_from_s)
    dry, bristle_rate = np.sign(w) * level, 0.0
    if p.presliding_rad:
        stiffness = level / p.presliding_rad
        bristle_rate = w - stiffness * abs(w) / level * bristle
        dry = stiffness * bristle + p.bristle_damping * bristle_rate
    bump = p.bump_Nm * np.exp(-(((abs(w) - p.bump_speed_rad_s) / p.bump_width_rad_s) ** 2))
    drag = p.drag * abs(w) ** p.drag_exponent
    cogging = np.sin(p.cogging_periods * angle + p.cogging_phase)
    cogging += p.cogging_second * np.sin(2 * p.cogging_periods * angle + p.cogging_second_phase)
    opposing = p.f * w + dry + np.sign(w) * (bump + drag) + p.cogging_Nm * cogging

    load_torque = load + p.load_Nm
    load_torque += p.shake_Nm * np.sin(2 * np.pi * p.shake_Hz * t + p.shake_phase)
    load_torque += p.eccentric_Nm * np.sin(angle / p.eccentric_gear + p.eccentric_phase)
    shaft = p.stiffness * twist + p.damping * (w - w_load)
    if p.gap_rad:
        over = twist - np.clip(twist, -p.gap_rad / 2, p.gap_rad / 2)
        shaft = np.sign(over) * max(0, np.sign(over) * (p.stiffness * over + p.damping * (w - w_load)))
    if p.stiffness:
        rotor, accelerated = p.J * (1 - p.load_share), (shaft - load_torque) / (p.J * p.load_share)
        coupling_torque, slip = shaft, w - w_load
    else:
        rotor, accelerated, coupling_torque, slip = p.J, 0.0, load_torque, 0.0
    return [
        (u - R * i - Kb * w - brush) / L,
        (Kt * ripple * i - opposing - coupling_torque) / rotor,
        w,
        accelerated,
        slip,
        (p.heat_per_W * R * i**2 - heat) / p.heat_s,
        (p.slow_heat_per_W * R * i**2 - slow) / p.slow_heat_s,
        bristle_rate,
        (w - x[8]) / p.lag_s if p.lag_s else 0.0,
        (p.sag_ohm * i * v / p.bus_V - sag) / p.sag_s,
    ]


def reference(p, excitation, start, max_step=np.inf):
    """Tight solve_ivp from sample to sample; current, speed as read, and angle."""
    states, times = [np.array(start)], excitation.time
    for k in range(times.size - 1):
        held = (excitation.voltage[k], excitation.load[k], p)
        tight = {"rtol": 1e-9, "atol": 1e-11, "max_step": max_step}
        span = (times[k], times[k + 1])
        solved = solve_ivp(reference_slope, span, states[-1], args=held, **tight)
        states.append(solved.y[:, -1])
    states = np.array(states)
    speed = states[:, 8] if p.lag_s else states[:, 1]
    return np.column_stack([states[:, 0] + p.offset_A, speed, states[:, 2]]), states[:, 1]


@pytest.mark.parametrize("name", HIDDEN)
def test_every_effect_agrees_with_the_adaptive_reference(name):
    """Over forty samples of forward motion with positive current: dry elements slip, all others act."""
    rng = np.random.default_rng(3)
    hidden = HIDDEN[name]
    p = hidden.put_into(PAPER, hidden.draw(rng, PAPER))._replace(delay_s=0.0)
    p = p._replace(seizing_from_s=0.0, bump_speed_rad_s=60.0)  # within these forty samples
    time = np.arange(40) * 1e-3
    voltage = np.repeat([9.0, 14.0, 10.0, 16.0], 10)
    excitation = vb.Excitation(time, voltage, np.full(40, 0.3))
    start = [60.0, 50.0, 0.4, 50.0, 0.4 * p.gap_rad, 0.0, 0.0, 0.0, 50.0, 0.0]
    max_step = 1e-5 if p.gap_rad or p.seizing_Nm else np.inf  # the step control might miss corners
    expected, speed = reference(p, excitation, start, max_step)
    assert expected[:, 0].min() > 0 and speed.min() > 0
    initial = {"current": 60.0, "speed": 50.0, "angle": 0.4, "twist": 0.4 * p.gap_rad}
    found = simulate(p, *excitation, **initial, least=100 if p.gap_rad else 20)
    error = np.abs(found - expected).max(0)
    assert np.all(error < (1e-4 if p.gap_rad else 1e-6) * np.abs(expected).max(0))
    if name not in ("speed_sensor_delay",):
        bare = simulate(PAPER, *excitation, **initial)
        assert np.abs(found - bare)[:, :2].max() > 1e-3  # the effect is significant


def test_a_sensor_delay_shifts_the_speed():
    excitation = vb.staircase(duration=0.5)
    now = simulate(PAPER, *excitation)
    for whole in (1, 4):
        late = simulate(PAPER._replace(delay_s=whole * 1e-3), *excitation)
        np.testing.assert_allclose(late[whole:, 1], now[:-whole, 1], atol=1e-9)
        np.testing.assert_array_equal(late[:, 0], now[:, 0])
    half = simulate(PAPER._replace(delay_s=5e-4), *excitation, least=20)[1:, 1]
    finer = vb.Excitation(*(np.repeat(c, 2) for c in excitation))
    finer = finer._replace(time=np.arange(finer.time.size) * 5e-4)
    np.testing.assert_allclose(half, simulate(PAPER, *finer)[1:-1:2, 1], atol=1e-6)


# ----------------------------------------------------------------------------- closed forms and switching


@pytest.mark.parametrize("side", [1, -1])
def test_coasting_matches_the_closed_form_and_ends_in_standstill(side):
    """Brushes that never conduct open the circuit, so only friction acts, with its level for each direction."""
    p = PAPER._replace(brush_V=6.0, friction_forward_Nm=0.05, friction_backward_Nm=0.08)
    time = np.arange(800) * 1e-3
    current, speed, _ = simulate(p, time, 0 * time, 0 * time, speed=50.0 * side).T
    pull = {1: 0.05, -1: 0.08}[side] / p.f
    expected = (50.0 + pull) * np.exp(-p.f / p.J * time) - pull
    moving = expected > 0
    assert 100 < moving.sum() < 600
    np.testing.assert_allclose(side * speed[moving], expected[moving], rtol=1e-9, atol=1e-9)
    assert np.all(speed[~moving] == 0)
    assert np.all(current == 0)


@pytest.mark.parametrize("side", [1, -1])
def test_breaks_away_exactly_at_the_static_torque(side):
    p = PAPER._replace(friction_forward_Nm=0.05, friction_backward_Nm=0.05, friction_excess_Nm=0.1)
    time = np.arange(1000) * 1e-3
    current, speed, _ = side * simulate(p, time, side * 0.7 * time, 0 * time).T
    first = np.flatnonzero(speed)[0]
    assert p.Kt * current[first - 1] <= 0.15 < p.Kt * current[first]
    # friction falls when slip begins, so the rotor accelerates at once
    assert speed[first + 20] > 10 * p.Kt * 1e-3


def test_brushes_block_the_current_below_their_voltage_drop():
    p = PAPER._replace(brush_V=0.7)
    time = np.arange(1000) * 1e-3
    current = simulate(p, time, time, 0 * time)[:, 0]
    assert np.all(current[time <= 0.7] == 0)
    assert np.all(current[time > 0.7005] > 0)


def test_backlash_decouples_the_load_until_the_teeth_touch():
    """Within the gap the motor has the inertia of the rotor alone."""
    p = LIBRARY["gear_backlash"]
    drawn = p.draw(np.random.default_rng(0), PAPER) | {"gap_rad": 0.1}
    loose = p.put_into(PAPER, drawn)
    alone = PAPER._replace(J=PAPER.J * (1 - drawn["load_share"]))
    time = np.arange(20) * 1e-3
    voltage = np.full(20, 2.0)
    free = simulate(alone, time, voltage, 0 * time)
    found = simulate(loose, time, voltage, 0 * time, twist=-0.05)
    inside = free[:, 2] < 0.1
    assert 5 < inside.sum() < 20
    np.testing.assert_allclose(found[inside], free[inside], atol=1e-7)
    assert found[-1, 1] < free[-1, 1] - 0.1


def test_a_dead_zone_reduces_voltages_of_either_sign_by_its_width():
    p, time = PAPER._replace(dead_zone_V=0.4), np.arange(200) * 1e-3
    for v in (0.39, 5.0, -5.0):
        expected = np.sign(v) * max(0.0, abs(v) - 0.4)
        found = simulate(p, time, np.full(200, v), 0 * time)
        np.testing.assert_allclose(found, simulate(PAPER, time, np.full(200, expected), 0 * time), atol=1e-9)


def test_pulses_have_the_mean_of_the_command_and_cause_ripple():
    p, excitation = PAPER._replace(pwm_Hz=4000.0), vb.staircase(duration=0.5, amplitude=18.0)
    assert substeps(p, 1e-3) % 4 == 0
    difference = np.abs(simulate(p, *excitation) - simulate(PAPER, *excitation)).max(0)
    assert difference[1] < 0.05
    assert 1e-6 < difference[0] < 0.5  # sampled in the middle of an off time


# ----------------------------------------------------------------------------- strength and seeds


def gauge_of(excitations, noise=(0.1, 0.5)):
    return Gauge(PAPER, excitations, noise)


def test_the_strength_excludes_what_a_refit_absorbs():
    runs = {"a": vb.staircase(duration=2.0), "b": vb.loaded(np.random.default_rng(0), 2.0)}
    gauge = gauge_of(runs)
    before = [linear(PAPER, e) for e in runs.values()]

    def response(changed):
        return gauge([linear(changed, e) - b for e, b in zip(runs.values(), before, strict=True)])

    assert response(PAPER._replace(R=PAPER.R * 1.001, J=PAPER.J * 0.999)).residual < 1.001
    assert response(PAPER._replace(R=PAPER.R * 1.001)).peak < 0.01
    other = gauge([b + np.array([0.1, 0.0]) for b in (0 * b for b in before)])  # an offset of 1 sd
    assert 0.3 < other.peak < 1.0
    samples = sum(b.size for b in before)
    assert other.chi_square < samples / 2 + 1


@pytest.mark.parametrize("power", [0.7, 1.0, 2.0])
def test_the_amplitude_of_a_given_strength_is_found(power):
    for wanted in (0.01, 1.0, 50.0):
        factor = amplitude_for(wanted, lambda a: 3.0 * a**power, (1e-6, 1e6), tries=30)
        assert 3.0 * factor**power == pytest.approx(wanted, rel=0.25)
    assert amplitude_for(1e9, lambda a: a, (0.1, 10.0)) == pytest.approx(10.0, rel=0.5)


def test_the_linear_motor_matches_the_plant_without_effects():
    excitation = vb.loaded(np.random.default_rng(1), duration=1.0)
    expected = simulate(PAPER, *excitation)[:, :2]
    np.testing.assert_allclose(linear(PAPER, excitation), expected, atol=1e-5)


def test_a_case_is_reproducible_from_its_seed():
    first, again = case("outside", 0), case("outside", 0)
    other, report = case("outside", 5), case("outside", 0, "report")
    assert first.stranger == again.stranger and first.motor == again.motor
    for name, columns in first.runs.items():
        for key in columns:
            np.testing.assert_array_equal(columns[key], again.runs[name][key])
    assert len({tuple(c.motor.values()) for c in (first, other, report)}) == 3
    sizes = [c["time_s"].size for c in (*first.runs.values(), *first.holdout.values())]
    assert sum(sizes) == 33_000 and len(first.runs) == 6 and list(first.holdout) == [HOLDOUT]
    assert first.response is not None and first.response.residual > 1.3


def test_suites_cover_their_effects_and_noises():
    plans = {s: [plan(k, np.random.default_rng(k)) for k in range(60)] for s, plan in SUITES.items()}
    assert {p.hidden[0].name for p in plans["singles"]} == set(LIBRARY)
    assert {p.hidden[0].label for p in plans["formulas"]} == set(FORMULAS)
    assert {p.hidden[0].label for p in plans["outside"]} == set(STRANGERS)
    assert {p.percent for p in plans["noise_sweep"]} == set(SWEEP_PERCENT)
    assert {p.wanted[0] for p in plans["strengths"]} <= set(VISIBLE)
    assert len({p.noise for p in plans["nulls"]}) == 4
    for pairs in (plans["pairs"], plans["foreign_pairs"]):
        assert all(len({h.name for h in p.hidden}) == 2 for p in pairs)
    assert all(p.rough for p in plans["rough"])


def test_foreign_sensors_quantise_or_add_noise_as_specified():
    """Each of the first five motors has another kind of sensors."""
    made = {c.noise: c for c in (case("foreign", k) for k in range(5))}
    assert list(made) == list(foreign.SENSORS)
    runs = {kind: next(iter(c.runs.values())) for kind, c in made.items()}
    assert "speed_rad_s" not in runs["angle"]
    turned = np.diff(runs["angle"]["angle_rad"]) * 4096 / (2 * np.pi)
    np.testing.assert_allclose(turned, np.round(turned), atol=1e-6)
    counts = runs["encoder"]["speed_rad_s"]
    steps = np.diff(counts)
    line = np.min(np.abs(steps[np.abs(steps) > 1e-6]))  # over the time of two samples
    np.testing.assert_allclose(steps / line, np.round(steps / line), atol=1e-6)
    lines = np.pi / line / runs["encoder"]["time_s"][1]
    assert lines == pytest.approx(round(lines), abs=1e-6)
    # the voltage has noise in every sample, and a converter has few levels
    assert len(np.unique(runs["noisy_voltage"]["voltage_V"])) > 1000
    assert len(np.unique(runs["converter"]["current_A"])) < 513


def test_jittered_time_stamps_still_increase():
    even = vb.staircase()
    uneven = jittered(even, np.random.default_rng(0), 0.2)
    assert np.all(np.diff(uneven.time) > 0)
    assert np.diff(uneven.time).std() > 1e-4
    assert jittered(even, np.random.default_rng(0), 0.0) is even


def test_speeds_are_quantised_and_cases_are_written_as_files(tmp_path):
    made = case("nulls", 3)
    assert made.noise == "quantised"
    speed = made.runs["triangle"]["speed_rad_s"]
    steps = np.diff(np.unique(np.round(speed, 9)))
    np.testing.assert_allclose(steps / steps.min(), np.round(steps / steps.min()), atol=1e-6)
    dump(made, tmp_path)
    assert {p.stem for p in tmp_path.glob("*.csv")} == {*made.runs, *made.holdout}


# ----------------------------------------------------------------------------- scores


def answer_of(verdict, *names, also=()):
    effects = [{"name": n, "parameters": {}, "also_possible": list(also)} for n in names]
    return {"verdict": verdict, "effects": effects}


def test_equivalent_sets_of_effects_have_one_canonical_form():
    both = {"coulomb_friction", "constant_load"}
    assert canonical({"asymmetric_friction"}) == canonical(both) == both
    assert canonical({"stribeck_friction", "coulomb_friction"}) == {"stribeck_friction"}
    assert canonical({"asymmetric_friction"}, load_known=False) == {"coulomb_friction"}
    assert canonical({"gear_backlash"}) != canonical({"shaft_compliance"})


@pytest.mark.parametrize(
    ("expected", "truth", "answer", "result", "is_right"),
    [
        ("named", ["a"], answer_of("named", "a"), "exact", True),
        ("named", ["a"], answer_of("named", "b"), "wrong", False),
        ("named", ["a"], answer_of("named", "a", "b"), "wrong", False),
        ("named", ["a", "b"], answer_of("named", "a"), "incomplete", False),
        ("named", ["a"], answer_of("ambiguous", "b", also=["a"]), "rivals", False),
        ("named", ["a", "b"], answer_of("ambiguous", "c", also=["a + b"]), "rivals", False),
        ("named", ["a"], answer_of("ambiguous", "b", also=["c"]), "elsewhere", False),
        ("named", ["a"], answer_of("none_detected"), "missed", False),
        ("named", ["a"], {"verdict": "error"}, "error", False),
        ("none_detected", [], answer_of("none_detected"), "exact", True),
        ("none_detected", [], answer_of("not_in_library"), "wrong", False),
        ("outside", [], answer_of("named", "a"), "wrong", False),
        ("outside", [], answer_of("not_in_library"), "unlisted", True),
        ("outside", [], answer_of("ambiguous", "a"), "elsewhere", True),
        ("outside", [], answer_of("none_detected"), "missed", False),
        ("blind", ["a", "b"], answer_of("named", "a"), "wrong", False),
        ("blind", ["a"], answer_of("none_detected"), "missed", True),
    ],
)
def test_the_outcome_of_each_kind_of_answer(expected, truth, answer, result, is_right):
    assert outcome(expected, truth, answer) == result
    assert right(expected, result) == is_right


def test_coverage_of_intervals_and_closed_gap():
    answer = answer_of("named", "a")
    answer["effects"][0]["parameters"] = {
        "torque_Nm": {"value": 1.0, "ci95": [0.9, 1.1]},
        "width_V": {"value": 1.0, "ci95": [None, 1.1]},
        "phase": {"value": 1.0, "ci95": [0.9, 1.1]},
    }
    found = intervals({"a": {"torque_Nm": 1.2, "width_V": 0.1, "phase": 1.0}}, answer)
    assert [(i.parameter, i.covers) for i in found] == [("torque_Nm", False), ("width_V", True)]
    answer["gap"] = {"holdout": {"before": 3.0, "after": 1.0, "floor": 1.0}}
    assert gap_closed(json.loads(json.dumps(answer))) == 1.0
    assert gap_closed(answer_of("named", "a")) is None


# ----------------------------------------------------------------------------- baselines


def recorded(plant, seed=0):
    """Two short runs with white noise, columns by name."""
    rng = np.random.default_rng(seed)
    runs = {"steps": vb.staircase(duration=1.0), "loaded": vb.loaded(rng, duration=1.0)}
    made = {}
    for name, e in runs.items():
        read = simulate(plant, *e)[:, :2] + rng.standard_normal((e.time.size, 2)) * [0.1, 0.5]
        made[name] = {
            "time_s": e.time,
            "voltage_V": e.voltage,
            "current_A": read[:, 0],
            "speed_rad_s": read[:, 1],
            "load_torque_Nm": e.load,
        }
    return made


def test_stepwise_refits_motor_and_effect_in_simulation():
    truth = PAPER._replace(friction_forward_Nm=0.05, friction_backward_Nm=0.05, R=0.2, Kb=0.055, Kt=0.055, J=6e-4)
    bench = stepwise.Bench(recorded(truth))
    np.testing.assert_allclose(bench.noise, [0.1, 0.5], rtol=0.3)
    bare = stepwise.baseline(bench)
    started = stepwise.replace(bare, effects={"coulomb_friction": {"torque_Nm": 0.01}})
    found = stepwise.fit(bench, started)
    assert found.bic < bare.bic - 100
    key = ("coulomb_friction", "torque_Nm")
    assert abs(found.effects[key[0]][key[1]] - 0.05) < 4 * 0.05 * found.stderr[key]
    for name in ("R", "Kb", "Kt", "J"):
        assert abs(found.base[name] / getattr(truth, name) - 1) < 4 * found.stderr["", name]
    assert np.mean(found.residual**2) < 1.3


def test_the_terms_of_the_weak_form_satisfy_the_equations():
    """Weak-form terms of the true equations explain the change of current and speed."""
    excitation = vb.loaded(np.random.default_rng(0), duration=1.0, dt=1e-4)
    p = PAPER._replace(friction_forward_Nm=0.1, friction_backward_Nm=0.1, brush_V=0.5)
    read = simulate(p, *excitation)
    columns = dict(
        zip(("time_s", "voltage_V", "load_torque_Nm"), excitation, strict=True),
        current_A=read[:, 0],
        speed_rad_s=read[:, 1],
    )
    e, m = sparse.terms(columns)

    def largest_misfit(difference, signal):
        """The largest misfit of the windows in which the dry element never sticks."""
        held = np.convolve(signal == 0, np.ones(sparse.WINDOW + 1), "valid") > 0
        assert held.sum() < 200
        return np.abs(difference[~held]).max()

    volts = e["v"] - p.R * e["i"] - p.Kb * e["w"] - 0.5 * e["brush_voltage_drop"]
    assert largest_misfit(p.L * e["change"] - volts, read[:, 0]) < 3e-3 * np.abs(e["v"]).max()
    torque = p.Kt * m["i"] - p.f * m["w"] - m["load"] - 0.1 * m["coulomb_friction"]
    change = p.J * m["change"]
    assert largest_misfit(change - torque, read[:, 1]) < 3e-3 * np.abs(change).max()
