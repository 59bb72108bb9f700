"""The diagnosis: its algebra against plain least squares, its columns against full simulation, whole cases."""

from __future__ import annotations

from collections.abc import Sequence
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from benchmarks import virtual_bench as vb
from pmdc_jax import Recording
from pmdc_jax.diagnose import naming
from pmdc_jax.diagnose.assessment import Assessment
from pmdc_jax.diagnose.candidates import Scales
from pmdc_jax.diagnose.compare import Fitted
from pmdc_jax.diagnose.effect_relations import FULLER, are_rivals, is_simpler_form
from pmdc_jax.diagnose.evidence import Block, gather_evidence
from pmdc_jax.diagnose.experiment import difference_between
from pmdc_jax.diagnose.library import Change, Library
from pmdc_jax.diagnose.model import Model, RunSeries, model_of
from pmdc_jax.diagnose.naming import Naming, StepwiseSelection
from pmdc_jax.diagnose.periodic import common_line, spectrum
from pmdc_jax.diagnose.pipeline import may_be_absent
from pmdc_jax.diagnose.quantisation import ROUNDING_DRAWS, rounding_errors
from pmdc_jax.diagnose.response import kicks, path_of, respond, sensor_changes
from pmdc_jax.diagnose.rows import _batches
from pmdc_jax.diagnose.shortlist import effect_of, most_promising, shortlist
from pmdc_jax.diagnose.signals import Screen, Signal, gain_common_to_waves, log_p_value
from pmdc_jax.diagnose.starts import common_phase
from pmdc_jax.diagnose.trials import TRIALS
from pmdc_jax.effects import EFFECTS
from pmdc_jax.identify.identification import Estimate, Identification
from pmdc_jax.identify.noise_model import Series, whitener
from pmdc_jax.identify.polish import polish
from pmdc_jax.identify.prepare import prepare
from pmdc_jax.identify.problem import Unknowns
from pmdc_jax.identify.refine import Optimum
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.simulate import UNKNOWNS_PER_RUN, RunUnknowns, Tape, free_run

PAPER = {name: getattr(vb.paper_motor(), name) for name in PARAMETERS}
SCALES = Scales(10.0, 300.0, 10.0, 15.0, 0.5, PAPER["J"], 1e-3, 2.0, 500.0)


def promises_of(gains: dict[str, float], unexplained: float) -> Assessment:
    """Evidence of effects with such gains, the first of them the most significant."""
    candidates = [TRIALS[name].candidates(name, SCALES)[0] for name in gains]
    signals = [
        Signal(gain, -1e3 + k, candidate, Mock(spec=Block))
        for k, (gain, candidate) in enumerate(zip(gains.values(), candidates, strict=True))
    ]
    found = Mock(
        spec=Assessment,
        candidate_signals=signals,
        curve_signals=signals[:1],
        unexplained=unexplained,
    )
    found.screen = Mock(spec=Screen, candidates=candidates)
    found.clearest = max(signals, key=lambda s: s.gain)
    return found


@pytest.mark.parametrize(
    ("gains", "first"),
    [
        # what is left of a dead zone's own formula hides nothing that would explain fourteen times as much
        ({"input_dead_zone": 10.0, "coulomb_friction": 140.0}, ["coulomb_friction"]),
        # ... and leaves no room for what explains as little as it does itself
        ({"input_dead_zone": 10.0, "quadratic_drag": 11.0}, []),
    ],
)
def test_an_effects_own_formula_is_no_reason_to_leave_out_a_larger_one(gains, first):
    current = Mock(spec=Model, effects={"input_dead_zone": {"width_V": 0.8}})
    listed = shortlist(current, promises_of(gains, unexplained=0.05))
    assert [effect_of(signal) for signal in listed] == first


def test_every_effect_has_a_row():
    assert set(TRIALS) == set(EFFECTS)


@pytest.mark.parametrize("name", EFFECTS)
def test_candidates_are_within_the_ranges(name):
    """Each shape is an effect that can be built, and of which a positive coefficient makes a legal one."""
    candidates = TRIALS[name].candidates(name, SCALES)
    begins = TRIALS[name].starts
    starts = begins(SCALES) if begins else []
    assert candidates or starts
    for values in starts:
        assert values.keys() == EFFECTS[name].ranges.keys()
        for field, r in EFFECTS[name].ranges.items():
            assert r.lower < values[field] < r.upper
    for candidate in candidates:
        assert candidate.effect == name
        for values in candidate.columns:
            EFFECTS[name](**{field: np.asarray(x) for field, x in values.items()})
        built = candidate.build(np.full(candidate.order, 0.3 * max(candidate.units)), 0.0)
        assert built is not None
        for field, r in EFFECTS[name].ranges.items():
            assert r.scale == "linear" or built[field] > 0


class Undecided(StepwiseSelection):
    """Two sets of effects, each of which looks better by the filter of the other one."""

    def __init__(self):
        self.base, self.one, self.other = (
            Mock(spec=Model, is_possible=True, effects=()) for _ in range(3)
        )
        self.superseded, self.trials = set(), 0
        self.comparison = Mock(ranked=lambda models, white: [Mock(spec=Fitted, model=models[-1])])

    def _trials(self, current, found):
        self.trials += 1
        assert self.trials < 5
        return [self.other if current is self.one else self.one]

    assess = staticmethod(lambda model: Mock(spec=Assessment, unexplained=np.inf, p_value=1.0))
    _by_unfiltered_misfit = staticmethod(lambda *models: None)
    _by_likeliest_effect = staticmethod(lambda *models: None)
    _best = staticmethod(lambda tried, white: tried[0])
    elimination = Mock(reduced=lambda model: model)
    _is_genuine_improvement = staticmethod(lambda *models: True)
    _equivalent_swaps = staticmethod(lambda *models: [])
    _naming = staticmethod(lambda model: Mock(spec=Naming, chosen=model))


def test_what_was_left_for_a_better_model_is_not_come_back_to():
    selection = Undecided()
    assert selection.name().chosen is selection.other
    assert selection.trials == 3


def test_what_only_mends_a_formula_does_not_hide_what_plain_squares_find():
    """A filter may swallow most of an effect: what it leaves then looks like the formula of another one."""
    selection = Undecided()
    selection._by_unfiltered_misfit = lambda current, found: selection.other
    selection._is_genuine_improvement = lambda current, found, better: better is selection.other
    selection._in_other_forms = lambda *models: []
    assert selection._step(selection.base, selection.assess(selection.base)) is selection.other


@pytest.mark.parametrize(
    ("gains", "least", "listed"),
    [
        # a fit far from the truth foretells badly: less than half as much is tried, too
        ({"stribeck_friction": 87.0, "quadratic_drag": 37.0, "cogging_torque": 2.0}, 18.0, 2),
        ({"stribeck_friction": 87.0, "quadratic_drag": 37.0}, 40.0, 1),
        ({"coulomb_friction": 87.0, "torque_ripple": 60.0}, 90.0, 0),
    ],
)
def test_what_promises_little_by_plain_squares_is_not_tried(gains, least, listed):
    found = most_promising(promises_of(gains, unexplained=0.0).candidate_signals, set(), least)
    assert [effect_of(signal) for signal in found] == list(gains)[:listed]


@pytest.mark.parametrize("settles", [True, False])
def test_of_what_promises_little_beside_a_curve_that_is_kept_which_settles_it(settles):
    """Friction and drag, which viscous friction makes up for: no single effect does much, and each more than it
    seems."""
    gains = {
        "torque_constant_saturation": 74.0,
        "stribeck_friction": 60.0,
        "brush_voltage_drop": 5.0,
    }
    found = promises_of(gains, unexplained=np.inf)
    found.p_value, found.may_be_model_form_error, found.is_sensor_ripple = (
        0.0,
        lambda model: False,
        lambda: False,
    )
    selection = StepwiseSelection.__new__(StepwiseSelection)
    tried = Mock(spec=Model, effects=("stribeck_friction",))
    selection.refits = Mock(with_signal=Mock(return_value=tried))
    selection.assess = lambda model: found
    selection._better = lambda current, found, models: models[-1] if models else None
    selection._in_other_forms = lambda *models: []
    selection._leaves_little = lambda current, better: settles
    better = selection._by_likeliest_effect(Mock(spec=Model, effects=()), found)
    assert better is (tried if settles else None)
    asked = [effect_of(call.args[1]) for call in selection.refits.with_signal.call_args_list]
    assert asked == list(gains)[:2]


@pytest.mark.parametrize(("count", "p_value", "asked"), [(3, 0.0, 1), (2, 0.0, 0), (3, 1.0, 0)])
def test_a_full_set_exchanges_what_acts_in_the_same_equation(monkeypatch, count, p_value, asked):
    """Dry friction, a delay and an offset, where a peak of friction is what promises most."""
    effects = ("asymmetric_friction", "speed_sensor_delay", "current_sensor_offset")[:count]
    peak = Mock(spec=Signal, candidate=Mock(effect="stribeck_friction"), gain=1.0)
    monkeypatch.setattr(naming, "clear_signals", lambda found: [peak])
    selection = Undecided()
    selection.refits = Mock(without=Mock(return_value=Mock(spec=Model)))
    selection.refits.with_signal.return_value = Mock(spec=Model)
    selection.assess = lambda model: Mock(
        spec=Assessment, candidate_signals=[peak], screen=Mock(spec=Screen)
    )
    selection._better = lambda current, found, tried: tried[0] if tried else None
    found = Mock(
        spec=Assessment,
        p_value=p_value,
        is_negligible=lambda model: False,
        screen=Mock(white="white"),
    )
    current = Mock(spec=Model, effects=effects)
    better = selection._by_exchange(current, found)
    assert selection.refits.without.call_count == asked
    if asked:
        selection.refits.without.assert_called_with(current, "asymmetric_friction", "white")
        assert better is selection.refits.with_signal.return_value


def test_a_motor_that_cannot_be_simulated_suggests_no_run(x64):
    time, rest = 1e-3 * np.arange(1000), np.zeros(500)
    volts = np.append(rest, 10 + rest)
    unstable = {**PAPER, "L": -1e-6}
    motors = [Motor(**{n: np.asarray(x) for n, x in m.items()}) for m in (PAPER, unstable)]
    assert difference_between([motors[0], motors[0]], time, volts, np.ones(2)) == 0
    assert difference_between(motors, time, volts, np.ones(2)) == 0
    other = Motor(**{n: np.asarray(x) for n, x in {**PAPER, "R": 1.0}.items()})
    assert difference_between([motors[0], other], time, volts, np.ones(2)) > 1


def test_only_waves_that_records_show_are_tried():
    """At 40 rad/s, of samples of 20 ms, one of seven periods comes round in one and an eighth; and over a tenth of a
    turn one of ten comes round once."""
    seldom = SCALES._replace(slow_speed=40.0, sample_time=0.02)
    tried = TRIALS["cogging_torque"].candidates
    assert [c.columns[0]["periods"] for c in tried("", seldom)] == list(range(1, 8))
    assert max(c.columns[0]["periods"] for c in tried("", SCALES)) == 48
    short = SCALES._replace(travel=0.1 * 2 * np.pi)
    assert min(c.columns[0]["periods"] for c in tried("", short)) == 10
    assert tried("", SCALES._replace(travel=0.0)) == []


@pytest.mark.parametrize("simple", [s for s, form in FULLER.items() if form.to_simple])
def test_a_simple_form_begins_within_its_ranges(simple):
    """Even where the rich one was fitted with nothing but a peak."""
    rich = FULLER[simple].effect
    sizes = dict(zip(EFFECTS[rich].ranges, (1e-10, 0.3, 20.0), strict=False))
    effect = EFFECTS[rich](**{field: np.asarray(x) for field, x in sizes.items()})
    values = FULLER[simple].to_simple(effect)
    assert values.keys() == EFFECTS[simple].ranges.keys()
    for field, r in EFFECTS[simple].ranges.items():
        assert r.lower < values[field] < r.upper
        assert abs(values[field]) > 0.1 * sizes[list(sizes)[1]]


LIKE = [(old, new) for old in TRIALS for new in TRIALS[old].alike]


@pytest.mark.parametrize(("old", "new"), LIKE)
def test_what_is_alike_begins_alike(old, new):
    """There and back again is where it was."""
    effect = EFFECTS[old](**dict.fromkeys(EFFECTS[old].ranges, np.asarray(3e-3)))
    values = TRIALS[old].alike[new](effect)
    assert values.keys() == EFFECTS[new].ranges.keys()
    other = EFFECTS[new](**{field: np.asarray(x) for field, x in values.items()})
    back = TRIALS[new].alike[old](other)
    assert back == {field: float(getattr(effect, field)) for field in effect.ranges}


@pytest.mark.parametrize("simple", FULLER)
def test_a_fuller_form_begins_as_the_simple_one_with_more_to_it(simple):
    """Possible, within its ranges, and as large as the simple one."""
    about = EFFECTS[simple].ranges
    effect = EFFECTS[simple](**{field: np.asarray(0.3) for field in about})
    fuller = FULLER[simple]
    values = fuller.from_simple(effect, SCALES)
    full = EFFECTS[fuller.effect](**{field: np.asarray(x) for field, x in values.items()})
    assert full.is_possible()
    assert set(fuller.extra) < set(values) == set(full.ranges)
    for field, r in full.ranges.items():
        assert r.lower < values[field] < r.upper
    assert [values[field] for field in values if field not in fuller.extra] == [0.3] * len(about)


# ------------------------------------------------------------------------------- the evidence


def evidence_of(J, own, X, r):
    """By rows given in two parts."""
    runs = (np.hstack([j, x, y[:, None], o]) for j, o, x, y in zip(J, own, X, r, strict=True))
    return gather_evidence(
        ((rows[:150], rows[150:]) for rows in runs), J[0].shape[1], own[0].shape[1]
    )


def random_evidence(seed: int, runs: int = 3, rows: int = 400):
    rng = np.random.default_rng(seed)
    J, own, X = ([rng.normal(size=(rows, n)) for _ in range(runs)] for n in (4, 2, 5))
    r = [rng.normal(size=rows) + j @ np.arange(4) + x[:, 0] for j, x in zip(J, X, strict=True)]
    return J, own, X, r


@pytest.mark.parametrize("own_phase", [False, True])
def test_regression_is_plain_least_squares(own_phase):
    """Against numpy on the whole matrix, with every run's own columns written out."""
    J, own, X, r = random_evidence(0)
    evidence = evidence_of(J, own, X, r)
    fit = evidence.regress([Block((4, 6), own_phase)])
    chosen = [x[:, [0, 2]] for x in X]
    locals_of = [np.hstack([o, x]) for o, x in zip(own, chosen, strict=True)] if own_phase else own
    shared = J if own_phase else [np.hstack([j, x]) for j, x in zip(J, chosen, strict=True)]
    wide = np.zeros((sum(map(len, r)), sum(o.shape[1] for o in locals_of)))
    row = column = 0
    for o in locals_of:
        wide[row : row + len(o), column : column + o.shape[1]] = o
        row, column = row + len(o), column + o.shape[1]
    matrix = np.hstack([np.concatenate(shared), wide])
    y = np.concatenate(r)
    solution, squares, *_ = np.linalg.lstsq(matrix, y)
    errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))
    assert fit.squares == pytest.approx(squares[0], rel=1e-10)
    np.testing.assert_allclose(fit.parameter_changes, solution[:4], rtol=1e-8)
    if own_phase:
        first = 4 + own[0].shape[1]
        np.testing.assert_allclose(fit.coefficients[0][0], solution[first : first + 2], rtol=1e-8)
    else:
        np.testing.assert_allclose(fit.coefficients[0], solution[4:6], rtol=1e-8)
        np.testing.assert_allclose(fit.errors[0], errors[4:6], rtol=1e-8)


def test_a_column_that_says_nothing_new_changes_nothing():
    J, own, X, r = random_evidence(1)
    X = [np.hstack([x, j[:, :1]]) for x, j in zip(X, J, strict=True)]
    evidence = evidence_of(J, own, X, r)
    with_it = evidence.regress([Block((4 + 5,))])
    assert with_it.squares == pytest.approx(evidence.regress().squares, rel=1e-9)


def test_a_column_that_belongs_to_the_run_as_well_says_nothing():
    """But for rounding, which is no evidence."""
    J, own, X, r = random_evidence(2)
    X = [np.hstack([x, o[:, :1] + 1e-7 * x[:, :1]]) for x, o in zip(X, own, strict=True)]
    fit = evidence_of(J, own, X, r).regress([Block((4 + 5,))])
    assert fit.coefficients[0] == fit.errors[0] == 0.0


@pytest.mark.parametrize("freedom", [1, 2, 12, 42])
def test_chance_far_out_meets_the_exact_one(freedom):
    """The leading term of the tail, where the exact one can still be computed."""
    for gain in (520.0, 700.0):
        exact = stats.chi2.logsf(gain, freedom)
        assert log_p_value(gain, freedom) == pytest.approx(exact, abs=0.1 * freedom)


@pytest.mark.parametrize(
    ("effect", "field", "interval", "nothing"),
    [
        ("torque_ripple", "amplitude", (2e-5, 0.64), True),
        ("torque_ripple", "amplitude", (0.1, 0.64), False),
        ("torque_ripple", "amplitude", None, False),
        ("constant_load", "torque_Nm", (-0.1, 0.8), True),
        ("constant_load", "torque_Nm", (1e-3, 0.8), False),
    ],
)
def test_an_amplitude_that_may_be_next_to_nothing(effect, field, interval, nothing):
    estimate = Estimate(0.35, 0.1, interval, "", "identified")
    found = Mock(spec=Identification, parameters={f"{effect}.{field}": estimate})
    assert may_be_absent(found, effect, field) is nothing


def test_what_waves_of_any_period_gain_is_evidence_for_none():
    """As where the residuals are slow: one period of cogging is asked for by what it gains beyond the others."""
    evidence = evidence_of(*random_evidence(0))
    cogging = TRIALS["cogging_torque"].candidates("cogging_torque", SCALES)
    others = TRIALS["constant_load"].candidates("constant_load", SCALES)
    freedom = 2 * 3  # cosine and sine in each of three runs
    blocks = [Block((0, 1), per_run=True)] * len(cogging)

    def common(gains):
        loads = [(load, Block((2,)), 1000.0) for load in others]
        return gain_common_to_waves(evidence, [*zip(cogging, blocks, gains, strict=True), *loads])

    rng = np.random.default_rng(1)
    by_chance = stats.chi2.rvs(freedom, size=len(cogging), random_state=rng)
    assert common(by_chance)["cogging_torque"] < 2.0
    slow = 40.0 + by_chance
    slow[3] = 500.0  # one that is there raises the median by nothing
    assert common(slow) == {"cogging_torque": pytest.approx(40.0, abs=2.0)}


def test_what_a_coarse_reading_leaves_is_evidence_for_nothing():
    """Speeds that stand still twenty times, read in whole rad/s: what bends with the speed explains the errors."""
    alarms = {"as if white": 0, "by rounding": 0}
    for seed in range(50):
        speed = np.random.default_rng(seed).uniform(-6, 6, 20).repeat(100)[:, None]
        kind, known = (1e-3, (1,)), np.ones(len(speed), bool)
        shared, own, residual, simulated = (
            Series(x, known, kind)
            for x in (speed[..., None], np.ones((len(speed), 1, 1)), np.round(speed) - speed, speed)
        )
        errors = rounding_errors(RunSeries(shared, own, residual, simulated), seed)
        parts = (
            shared.values,
            (speed * np.abs(speed))[..., None],
            errors,
            residual.values[..., None],
        )
        rows = np.concatenate([*parts, own.values], -1)[:, 0] * np.sqrt(12)
        evidence, drag = gather_evidence([[rows]], 1, 1, ROUNDING_DRAWS), Block((1,))
        gain = evidence.regress().squares - evidence.regress([drag]).squares
        noise = evidence.rounding_dispersion(drag)
        alarms["as if white"] += stats.chi2.sf(gain, 1) < 0.01
        alarms["by rounding"] += stats.chi2.sf(gain / noise, 1) < 0.01
    assert alarms["as if white"] > 25
    assert alarms["by rounding"] <= 3


@pytest.mark.parametrize(
    ("read", "coarse"),
    [
        (lambda exact, rng: np.round(exact), True),
        (lambda exact, rng: np.round(exact + 2 * rng.normal(size=exact.shape)), False),
        # counts of an encoder from sample to sample: no error lasts
        (lambda exact, rng: np.diff(np.round(np.cumsum(exact, 0)), axis=0, prepend=0), False),
    ],
    ids=["rounded", "blurred", "counted"],
)
def test_only_steps_that_nothing_blurs_are_coarse(read, coarse):
    exact, known = np.linspace(0, 20, 2000)[:, None], np.ones(2000, bool)
    left, simulated = (
        Series(0.5 * x, known, (1e-3, (0,)))
        for x in (read(exact, np.random.default_rng(0)) - exact, exact)
    )
    errors = rounding_errors(RunSeries(simulated, simulated, left, simulated), 0)
    assert bool(errors.any()) is coarse
    assert np.abs(errors).max() <= 0.25 + 1e-12
    assert np.array_equal(
        errors, rounding_errors(RunSeries(simulated, simulated, left, simulated), 0)
    )


# ---------------------------------------------------------------------------------- the noise


def coloured(seed: int, samples: int, scale: float) -> np.ndarray:
    """A torque that fluctuates slowly, seen in speed and a little in current, and white sensors."""
    rng = np.random.default_rng(seed)
    slow = np.zeros(samples)
    for k in range(1, samples):
        slow[k] = 0.97 * slow[k - 1] + rng.normal()
    return scale * (np.stack([0.1 * slow, slow], 1) + rng.normal(size=(samples, 2)) * [0.3, 2.0])


def test_what_is_filtered_is_white():
    known = np.ones(6000, bool)
    series = [Series(coloured(k, 6000, s), known, (1e-3, (0, 1))) for k, s in enumerate((1.0, 5.0))]
    white = whitener(series)
    for k, s in enumerate(series):
        rows = white(k, s).reshape(-1, 2)
        np.testing.assert_allclose(np.cov(rows.T), np.eye(2), atol=0.05)
        for lag in range(1, 40):
            correlation = rows[lag:].T @ rows[:-lag] / len(rows)
            assert np.abs(correlation).max() < 5 / np.sqrt(len(rows)), lag


def test_filter_does_not_look_across_what_is_missing():
    """A sample that is missing spoils no row: the rows that need it are left out."""
    values = coloured(0, 3000, 1.0)
    known = np.ones(3000, bool)
    known[1000:1010] = False
    spoiled = values.copy()
    spoiled[~known] = 1e9
    clean = Series(values, known, (1e-3, (0, 1)))
    white = whitener([clean])
    np.testing.assert_array_equal(white(0, clean), white(0, clean._replace(values=spoiled)))


# ------------------------------------------------------------------------- lines in the spectrum


def shaken(hertz: Sequence[float], driven: float | None = None, size: float = 1.5):
    """Spectra of runs of 4, 6, 8, ... s of coloured noise, each with an oscillation of its own frequency."""
    found = []
    for k, f in enumerate(hertz):
        time = 1e-3 * np.arange(4000 + 2000 * k)
        noise = coloured(k, len(time), 1.0)
        noise[:, 1] += size * noise.std() * np.sin(2 * np.pi * f * time + k)
        drive = np.random.default_rng(k).normal(size=(len(time), 1))
        if driven is not None:
            drive[:, 0] += np.sin(2 * np.pi * driven * time)
        found.append(spectrum(noise, drive, 1e-3))
    return found


def test_a_periodic_torque_from_outside_is_found_at_its_frequency():
    line = common_line(shaken([7.3] * 4))
    assert line.low < 7.3 < line.high
    assert line.high - line.low < 0.3


def test_a_slow_one_too_where_it_is_strong():
    """Six turns of it in a run, where noise is strongest."""
    line = common_line(shaken([1.26] * 4, size=6.0))
    assert line.low < 1.26 < line.high


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_one_run_alone_must_show_a_line_far_more_clearly(size):
    assert common_line(shaken([7.3], size=size)) is None


@pytest.mark.parametrize("hertz", [[7.3, 9.1, 12.4, 31.0], [7.3, 7.3, 21.0, 31.0]])
def test_a_line_of_few_runs_is_none(hertz):
    assert common_line(shaken(hertz)) is None


def test_a_line_that_drives_is_none():
    assert common_line(shaken([7.3] * 4, driven=7.3)) is None


def test_a_line_that_a_controller_answers_to_is_one():
    """It stands out of the voltage, too, but far less. Two runs are enough if one of them shows it far more clearly."""
    free, answered = shaken([7.3] * 2, size=6.0)
    answered = answered._replace(driving=np.maximum(answered.driving, answered.residual / 20))
    line = common_line([free, answered])
    assert line.low < 7.3 < line.high
    driven = answered._replace(driving=answered.residual)
    assert common_line([free, driven]) is None


def test_harmonics_of_a_drive_that_repeats_itself_are_none():
    """A wrong friction has lines at harmonics that the drive itself may lack."""
    rng, time = np.random.default_rng(0), np.arange(8000) * 1e-3
    wave = np.sin(2 * np.pi * 1.3 * time)
    residuals = 3 * np.sin(2 * np.pi * 3 * 1.3 * time)[:, None] + rng.normal(size=(8000, 2))
    once = rng.normal(size=(8000, 1)).cumsum(0)
    assert common_line([spectrum(residuals, wave[:, None], 1e-3)] * 3) is None
    assert common_line([spectrum(residuals, once, 1e-3)] * 3) is not None


@pytest.mark.parametrize("seed", range(20))
def test_coloured_noise_has_no_line(seed):
    rng = np.random.default_rng(seed)
    runs = [coloured(100 * seed + k, 5000, 1.0) for k in range(3)]
    assert common_line([spectrum(x, rng.normal(size=(5000, 1)), 1e-3) for x in runs]) is None


# ------------------------------------------------------------------------------- the responses


def runs() -> list[Recording]:
    """Steps through standstill; the second run carries a load."""
    rng, found = np.random.default_rng(2), []
    for k, samples in enumerate((500, 300)):
        time = 1e-3 * np.arange(samples)
        levels = rng.uniform(-12, 12, 20)
        voltage = levels[(time / 0.05).astype(int)]
        zero, load = np.zeros(samples), np.full(samples, 0.1 * k)
        found.append(Recording(f"run {k}", time, voltage, current=zero, speed=zero, load=load))
    return found


# one effect that acts through a parameter, one with a state of its own, one of a sensor, one of the angle, where runs
# begin anywhere in the turn
SMOOTH = {
    "torque_constant_saturation": {"per_A2": 1e-9, "emf_share": 0.0},
    "resistance_heating": {"rise_per_W": 1e-8, "time_constant_s": 0.2},
    "speed_sensor_delay": {"delay_s": 2.5e-3},
    "cogging_torque": {"amplitude_Nm": 1e-6, "phase_rad": 0.3, "periods": 3.0},
}
BEGUN = jnp.array([0.4, 2.0])  # rad


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_response_is_the_change_of_the_simulation(x64, name):
    """First-order columns against two full simulations, one with a very small effect."""
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings(runs()))
    bare = Motor(**{n: jnp.asarray(x) for n, x in PAPER.items()})
    effect = EFFECTS[name](**{f: jnp.asarray(x) for f, x in SMOOTH[name].items()})
    motor = Motor(**{n: jnp.asarray(x) for n, x in PAPER.items()}, effects=(effect,))
    own = RunUnknowns.as_recorded(tape)._replace(angle=BEGUN)
    without, with_it = (free_run(m, tape, own) for m in (bare, motor))
    path = path_of(without, tape, BEGUN, False)
    if EFFECTS[name].equation == "sensor":
        found = sensor_changes(motor, bare, tape, path)
    else:
        found = respond(bare, tape, path, kicks(motor, bare, tape, path)[..., None])[..., 0]
    expected = (with_it - without).transpose(2, 1, 0)
    weight = np.asarray(tape.weight).transpose(2, 1, 0)
    for c in range(2):
        scale = np.abs(expected[:, c] * weight[:, c]).max()
        error = np.abs((found - expected)[:, c] * weight[:, c]).max()
        assert error <= 0.02 * scale + 1e-12, (name, c, error, scale)


@pytest.mark.parametrize("most", [1, 4, 5, 32])
def test_columns_are_the_same_however_many_stand_side_by_side(most):
    rng = np.random.default_rng(3)
    kicks, seen = rng.standard_normal((2, 10, 2, 3, 13))
    changes = [Change(kicks[..., a:b], seen[..., a:b]) for a, b in ((0, 5), (5, 6), (6, 13))]
    parts = list(_batches(changes, most))
    assert all(part.kicks.shape[-1] == most for part, _ in parts)
    for field, whole in (("kicks", kicks), ("seen", seen)):
        together = [getattr(part, field)[..., :width] for part, width in parts]
        np.testing.assert_array_equal(np.concatenate(together, -1), whole)


# --------------------------------------------------------------------------------- sets of effects


@pytest.mark.parametrize(
    ("one", "other", "rivals"),
    [
        ("brush_voltage_drop", "input_dead_zone", True),
        ("coulomb_friction", "quadratic_drag", True),
        ("coulomb_friction", "stribeck_friction", False),  # the one contains the other
        ("coulomb_friction constant_load", "asymmetric_friction", False),  # one torque in motion
        ("coulomb_friction", "coulomb_friction quadratic_drag", False),  # a part
        ("coulomb_friction quadratic_drag", "stribeck_friction quadratic_drag", False),
        ("coulomb_friction quadratic_drag", "coulomb_friction cogging_torque", True),
        ("speed_sensor_lag", "speed_sensor_delay", True),
    ],
)
def test_rivals_differ_in_more_than_form(one, other, rivals):
    a, b = set(one.split()), set(other.split())
    assert are_rivals(a, b) == are_rivals(b, a) == rivals


def test_a_simpler_form_is_within_a_richer_one():
    drag = {"quadratic_drag"}
    assert is_simpler_form({"coulomb_friction"} | drag, {"stribeck_friction"} | drag)
    assert not is_simpler_form({"stribeck_friction"} | drag, {"coulomb_friction"} | drag)
    assert not is_simpler_form({"coulomb_friction"}, {"stribeck_friction"} | drag)


@pytest.mark.parametrize("periods", [4.0, 9.0, 14.0])
def test_a_second_torque_over_the_angle_leaves_the_first_in_place(periods):
    """Runs begin where a cogging of six periods put them, each off by some of its periods; the second torque has one
    phase in all of them once these are undone."""
    rng = np.random.default_rng(5)
    whole = 2 * np.pi * np.arange(6) / 6
    off = np.append(0.0, rng.choice(whole, 7))
    phases = 0.8 + periods * off + 0.05 * rng.normal(size=8)
    sizes = rng.uniform(0.5, 2.0, 8)
    both = sizes[:, None] * np.stack([np.cos(phases), np.sin(phases)], 1)
    phase, turned = common_phase(both, [np.zeros(1), *[whole] * 7], periods)
    assert phase == pytest.approx(0.8, abs=0.1)
    np.testing.assert_allclose(np.cos(periods * (turned - off)), 1.0, atol=1e-6)
    assert all(np.min(np.abs(whole - angle)) == 0 for angle in turned)


def test_runs_that_may_begin_turned_by_any_angle_are_turned_to_the_first():
    phases = np.array([0.3, 2.0, -3.0, 1.0])
    both = np.stack([np.cos(phases), np.sin(phases)], 1)
    phase, turned = common_phase(both, [np.zeros(1), None, None, None], 7.0)
    assert phase == pytest.approx(0.3, abs=0.03)  # as finely as it is looked for
    np.testing.assert_allclose(np.cos(phases - phase - 7.0 * turned), 1.0, atol=1e-3)


def test_sizes_in_amperes_are_not_tried_where_no_current_was_measured(x64):
    """Voltage and speed alone say nothing of what a current does."""
    rng = np.random.default_rng(7)
    columns = vb.record(vb.BenchMotor(**PAPER), vb.prbs(rng, 2.0), rng, vb.Noise())
    time, voltage, speed = (columns[q] for q in ("time_s", "voltage_V", "speed_rad_s"))
    given = prepare([Recording("silent", time, voltage, speed=speed)], [], unloaded=True)
    coordinates = jnp.log(jnp.asarray([PAPER[n] for n in PARAMETERS]))
    start = Unknowns(coordinates, RunUnknowns(*jnp.zeros((UNKNOWNS_PER_RUN, 1))))
    base = model_of((), given, polish(given.problem, Optimum(start, np.inf, (), False), steps=0))
    tried = {candidate.effect for candidate in Library(base).candidates}
    assert {"coulomb_friction", "speed_sensor_delay"} <= tried
    assert not any(EFFECTS[name].needs_current for name in tried)
