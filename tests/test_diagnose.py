"""Parts of a diagnosis: regression against least squares by numpy, first-order responses against full simulation,
and the selection of effects."""

from __future__ import annotations

from collections.abc import Sequence
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from attrs import evolve
from linear_motor import PAPER
from scipy import stats
from scipy.linalg import block_diag
from scipy.signal import lfilter

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import InputError, Recording, diagnose, simulate
from pmdc_jax.diagnose.evidence.assessment import FALSE_ALARM, Assessment
from pmdc_jax.diagnose.evidence.moments import dispersion_by_moments
from pmdc_jax.diagnose.evidence.quantisation import ROUNDING_DRAWS, rounding_errors
from pmdc_jax.diagnose.evidence.regression import Block, gather_evidence
from pmdc_jax.diagnose.evidence.rows import Rows, _batches
from pmdc_jax.diagnose.evidence.screen import Findings
from pmdc_jax.diagnose.evidence.signals import Screen, Signal, gain_common_to_waves, log_p_value
from pmdc_jax.diagnose.experiment import difference_between
from pmdc_jax.diagnose.hypotheses.candidates import Scales
from pmdc_jax.diagnose.hypotheses.change import Change
from pmdc_jax.diagnose.hypotheses.curves import Curve
from pmdc_jax.diagnose.hypotheses.effect_relations import FULLER, are_rivals, is_simpler_form
from pmdc_jax.diagnose.hypotheses.library import Library
from pmdc_jax.diagnose.hypotheses.trials import TRIALS
from pmdc_jax.diagnose.judgement import _by_evidence, implausible_effect, may_be_absent
from pmdc_jax.diagnose.model import Model, model_of
from pmdc_jax.diagnose.response import respond, sensor_changes, state_increments, trajectory_of
from pmdc_jax.diagnose.selection import naming, proposals
from pmdc_jax.diagnose.selection.compare import DECISIVE_RATIO, Comparison, Fitted
from pmdc_jax.diagnose.selection.naming import Naming, StepwiseSelection
from pmdc_jax.diagnose.selection.proposals import Proposals
from pmdc_jax.diagnose.selection.refits import Refits
from pmdc_jax.diagnose.selection.rivals import _better_by_own_filter
from pmdc_jax.diagnose.selection.shortlist import most_promising, shortlist
from pmdc_jax.diagnose.selection.starts import Starts, common_phase
from pmdc_jax.effects import (
    EFFECTS,
    GearBacklash,
    GradualBrushDrop,
    ResistanceHeating,
    ShaftCompliance,
    StribeckFriction,
)
from pmdc_jax.identify.fit.fitted_runs import FittedRuns
from pmdc_jax.identify.fit.polish import fit_at
from pmdc_jax.identify.fit.refine import Optimum
from pmdc_jax.identify.fit.run_series import RunSeries
from pmdc_jax.identify.identification import Estimate, Identification
from pmdc_jax.identify.noise.noise_model import Series, fit_whitener, scaling_whitener
from pmdc_jax.identify.noise.spectral_lines import common_line, spectrum
from pmdc_jax.identify.prepare import prepare
from pmdc_jax.identify.problem import Unknowns
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.simulate import UNKNOWNS_PER_RUN, RunUnknowns, Tape, free_run

SCALES = Scales(10.0, 300.0, 10.0, 15.0, 0.5, PAPER["J"], 1e-3, 2.0, 500.0)


def assessment_of(gains: dict[str, float], unexplained: float) -> Assessment:
    """An assessment with these gains of effects, of which the first is the most significant."""
    candidates = [TRIALS[name].candidates(name, SCALES)[0] for name in gains]
    signals = [
        Signal(gain, -1e3 + k, candidate, Mock(spec=Block))
        for k, (gain, candidate) in enumerate(zip(gains.values(), candidates, strict=True))
    ]
    found = Mock(spec=Assessment, candidate_signals=signals, curve_signals=signals[:1], unexplained=unexplained)
    found.screen = Mock(spec=Screen, candidates=candidates)
    found.clearest = max(signals, key=lambda s: s.gain)
    return found


@pytest.mark.parametrize(
    ("gains", "first"),
    [
        # the formula error of a dead zone does not exclude an effect that explains fourteen times as much
        ({"input_dead_zone": 10.0, "coulomb_friction": 140.0}, ["coulomb_friction"]),
        # but one that explains hardly more than the dead zone itself
        ({"input_dead_zone": 10.0, "quadratic_drag": 11.0}, []),
    ],
)
def test_the_shortlist_has_an_effect_that_is_larger_than_a_formula_error(gains, first):
    current = Mock(spec=Model, effects={"input_dead_zone": {"width_V": 0.8}})
    listed = shortlist(current, assessment_of(gains, unexplained=0.05))
    assert [signal.effect for signal in listed] == first


def test_every_effect_has_trials():
    assert set(TRIALS) == set(EFFECTS)


@pytest.mark.parametrize("name", EFFECTS)
def test_candidates_are_within_the_ranges(name):
    """Each candidate can be built as an effect, and positive coefficients give valid parameters."""
    candidates = TRIALS[name].candidates(name, SCALES)
    starting_values = TRIALS[name].starts
    starts = starting_values(SCALES) if starting_values else []
    assert candidates or starts
    for values in starts:
        assert values.keys() == EFFECTS[name].ranges.keys()
        for field, r in EFFECTS[name].ranges.items():
            assert r.lower < values[field] < r.upper
    for candidate in candidates:
        assert candidate.effect == name
        for values in candidate.columns:
            EFFECTS[name](**{field: np.asarray(x) for field, x in values.items()})
        built = candidate.build(np.full(candidate.width, 0.3 * max(candidate.units)), 0.0)
        assert built is not None
        for field, r in EFFECTS[name].ranges.items():
            assert r.scale == "linear" or built[field] > 0


NOTHING_PROPOSED = dict.fromkeys(
    (
        "by_evidence",
        "by_largest_gain",
        "by_unfiltered_misfit",
        "by_earlier_evidence",
        "by_search_with_friction",
        "by_exchange",
        "by_swap",
        "in_other_forms",
    ),
    lambda *models: [],
)


class UndecidedSelection(StepwiseSelection):
    """A selection from two models, each of which fits better than the other by the filter of that."""

    def __init__(self):
        self.base, self.one, self.other = (Mock(spec=Model, is_possible=True, effects=()) for _ in range(3))
        self.superseded, self.equivalents, self.trials = set(), {}, 0
        self.comparison = Mock(ranked=lambda models, white: [Mock(spec=Fitted, model=models[-1])])
        self.assess = Mock(return_value=assessment_of({"quadratic_drag": 1.0}, np.inf))
        self.assess.return_value.p_value = 1.0
        self.proposals = Mock(spec=Proposals, **NOTHING_PROPOSED | {"by_evidence": self._other})

    def _other(self, current):
        self.trials += 1
        assert self.trials < 5
        return [self.other if current is self.one else self.one]

    _best = staticmethod(lambda tried, white: tried[0])
    _with_refined_runs = _at_better_optimum = _without_needless = staticmethod(lambda model: model)
    elimination = Mock(reduced=lambda model: model)
    _is_genuine_improvement = staticmethod(lambda *models: True)
    _naming = staticmethod(lambda model: Mock(spec=Naming, chosen=model))


def test_the_selection_does_not_return_to_a_superseded_model():
    selection = UndecidedSelection()
    assert selection.select().chosen is selection.other
    assert selection.trials == 3


def test_a_model_with_warm_runs_takes_the_place_of_one_in_which_all_begin_cold(monkeypatch):
    selection, effects = UndecidedSelection(), ("resistance_heating",)
    cold, warm = (
        Mock(spec=Model, effects=effects, fitted=Mock(prepared=runs), prepared=runs) for runs in ("cold", "warm")
    )
    selection.refits = Mock(spec=Refits, replace=lambda model: model)
    monkeypatch.setattr(naming, "with_initial_temperatures", lambda fitted: FittedRuns("warm", "fit"))
    monkeypatch.setattr(naming, "model_of", lambda fitted: warm if fitted.prepared == "warm" else None)
    for other in ("with_even_clock", "with_gradual_brushes"):
        monkeypatch.setattr(naming, other, lambda fitted: fitted)
    assert StepwiseSelection._with_refined_runs(selection, cold) is warm
    assert cold in selection.superseded
    monkeypatch.setattr(naming, "with_initial_temperatures", lambda fitted: fitted)
    assert StepwiseSelection._with_refined_runs(selection, cold) is cold


@pytest.mark.parametrize("genuine", [True, False])
@pytest.mark.parametrize("p_value", [0.0, 1.0])
@pytest.mark.parametrize(
    ("negligible", "unrelated", "misfit"),
    [(False, False, 2.0), (True, False, 2.0), (True, True, 2.0), (True, False, 9.0)],
)
def test_an_effect_that_only_led_to_a_better_optimum_is_not_kept(genuine, p_value, negligible, unrelated, misfit):
    """Torque ripple beside friction that sticks and slips: the fit without it, from where that with it ended, leaves
    no more, or so little that it would not have been tried."""
    selection = UndecidedSelection()
    both, one, none = (
        Mock(spec=Model, is_possible=True, effects=effects, fit=Mock(fitness=fitness))
        for effects, fitness in ((("a", "b"), 1.5), (("a",), misfit), ((), 99.0))
    )
    selection.refits = Mock(spec=Refits, without_each=lambda model, effects, white: [none, one])
    selection.comparison.filter_of = lambda model: "white"
    evidence = selection.assess.return_value
    evidence.p_value, evidence.is_negligible.return_value = p_value, negligible
    evidence.is_unrelated_to.return_value = unrelated
    selection._is_genuine_improvement = lambda smaller, model: genuine
    of_no_use = negligible and not unrelated and misfit < 1.5 * DECISIVE_RATIO
    needless = of_no_use or (p_value < FALSE_ALARM and not genuine)
    assert StepwiseSelection._without_needless(selection, both) is (one if needless else both)
    assert (both in selection.superseded) == needless


@pytest.mark.parametrize("found", [True, False])
def test_a_better_optimum_may_not_need_every_effect(found):
    """Cogging beside friction that sticks and slips: a population around both finds what friction alone explains."""
    selection = UndecidedSelection()
    both, better, one = (Mock(spec=Model) for _ in range(3))
    selection.refits = Mock(spec=Refits, searched_around=lambda model: better if found else both)
    selection._without_needless = {better: one}.get
    assert StepwiseSelection._at_better_optimum(selection, both) is (one if found else both)
    assert (both in selection.superseded) == found


@pytest.mark.parametrize("variable", ["speed", "current"])
@pytest.mark.parametrize("zero", [(), ("at_bound",), ("undetermined",), ("vanished",)])
def test_effects_that_would_need_a_negative_viscous_friction_are_not_those_missing(variable, zero):
    """An eddy-current brake, taken for Coulomb friction: its torque falls at high speed."""
    curve = Curve("mechanical", variable, "N m", np.linspace(-1.0, 1.0, 5))
    rest = Signal(1.0, -50.0, curve, Mock(spec=Block))
    screen = Mock(spec=Screen)
    screen.unfiltered.regress.side_effect = lambda blocks=(): Mock(squares=1.0 - 0.1 * bool(blocks))
    explained, share = (5.0, 0.01) if zero == ("vanished",) else (20.0, 0.5)
    found = Assessment(screen, [], [rest], 0.0, explained, explained_unfiltered=20.0, viscous_share=share)
    friction = {name: {"f"} if name in zero else set() for name in ("at_bound", "undetermined")}
    model = Mock(spec=Model, effects=("coulomb_friction",), fit=Mock(fitness=1.0), **friction)
    own = zero != ("vanished",)  # a curve over another variable that is as large is no form of friction either
    assert found.may_be_model_form_error(model) == (own and (variable == "current" or not zero))


def test_a_correction_of_a_formula_does_not_hide_an_effect_found_without_a_filter():
    """A filter may remove most of an effect; the rest then resembles a formula error of another one."""
    selection = UndecidedSelection()
    selection.proposals.by_unfiltered_misfit = lambda current: [selection.other]
    selection._is_genuine_improvement = lambda current, better: better is selection.other
    assert selection._step(selection.base) is selection.other


@pytest.mark.parametrize(
    ("gains", "min_gain", "listed"),
    [
        # predictions from a poor fit are inaccurate, so less than half of the largest gain is tried, too
        ({"stribeck_friction": 87.0, "quadratic_drag": 37.0, "cogging_torque": 2.0}, 18.0, 2),
        ({"stribeck_friction": 87.0, "quadratic_drag": 37.0}, 40.0, 1),
        ({"coulomb_friction": 87.0, "torque_ripple": 60.0}, 90.0, 0),
    ],
)
def test_effects_of_little_expected_gain_are_not_tried(gains, min_gain, listed):
    found = most_promising(assessment_of(gains, unexplained=0.0).candidate_signals, set(), min_gain)
    assert [signal.effect for signal in found] == list(gains)[:listed]


@pytest.mark.parametrize(
    ("added", "misfit", "is_genuine"),
    [
        ("quadratic_drag", 4.0, True),  # 8 noise variances more than noise alone, and then 2
        ("quadratic_drag", 5.0, False),
        ("torque_constant_saturation", 4.0, True),  # of the torque, not the voltage
        ("inductance_saturation", 4.0, False),  # a voltage over the current, too
    ],
)
def test_a_decisive_effect_on_other_axes_is_no_model_form_error(added, misfit, is_genuine):
    """Beside a brush drop of another formula, which leaves far more than noise."""
    problem = Mock(perfect_fitness=2.0)
    current = Mock(spec=Model, effects=("brush_voltage_drop",), fit=Mock(fitness=10.0), problem=problem)
    better = Mock(spec=Model, effects=("brush_voltage_drop", added), fit=Mock(fitness=misfit), problem=problem)
    selection = StepwiseSelection.__new__(StepwiseSelection)
    selection._leaves_little = lambda current, better: False
    selection.assess = lambda model: Mock(spec=Assessment, exceeds_model_form_error=lambda model: False)
    assert selection._is_genuine_improvement(current, better) == is_genuine
    # near the noise, a little model-form error is a large share of what is left
    near = Mock(spec=Model, effects=current.effects, fit=Mock(fitness=2.3), problem=problem)
    nearer = Mock(spec=Model, effects=better.effects, fit=Mock(fitness=2.05), problem=problem)
    assert not selection._is_genuine_improvement(near, nearer)
    # the first effect has no other beside it, whose formula may be wrong
    current.effects = ()
    assert not selection._is_genuine_improvement(current, better)


@pytest.mark.parametrize("leaves_little", [True, False])
def test_an_effect_of_little_expected_gain_is_added_only_if_it_leaves_little(leaves_little):
    """Friction and drag, for which viscous friction compensates: no single effect gains much, but each more than
    predicted."""
    gains = {"torque_constant_saturation": 74.0, "stribeck_friction": 60.0, "brush_voltage_drop": 5.0}
    found = assessment_of(gains, unexplained=np.inf)
    found.p_value, found.may_be_model_form_error, found.is_sensor_error = (0.0, lambda model: False, lambda: False)
    selection = UndecidedSelection()
    tried = Mock(spec=Model, effects=("stribeck_friction",))
    refits = Mock(spec=Refits, with_signals=Mock(return_value=[tried]))
    selection.proposals.by_evidence = lambda current: []
    selection.proposals.by_largest_gain = Proposals(refits, lambda model: found, set()).by_largest_gain
    selection._better = lambda current, models: models[-1] if models else None
    selection._leaves_little = lambda current, better: leaves_little
    better = selection._step(Mock(spec=Model, effects=()))
    assert better is (tried if leaves_little else None)
    [call] = refits.with_signals.call_args_list
    assert [signal.effect for signal in call.args[1]] == list(gains)[:2]


def test_no_simpler_form_is_added_to_an_effect():
    """A gear with play has a shaft, and Stribeck friction has Coulomb friction."""
    gains = {"shaft_compliance": 90.0, "coulomb_friction": 80.0, "speed_sensor_lag": 70.0}
    found = assessment_of(gains, unexplained=np.inf)
    found.p_value, found.may_be_model_form_error, found.is_sensor_error = (0.0, lambda model: False, lambda: False)
    refits = Mock(spec=Refits, with_signals=Mock(return_value=[]))
    current = Mock(spec=Model, effects=("gear_backlash", "stribeck_friction"))
    Proposals(refits, lambda model: found, set()).by_largest_gain(current)
    [call] = refits.with_signals.call_args_list
    assert [signal.effect for signal in call.args[1]] == ["speed_sensor_lag"]


def test_signals_without_any_gain_are_no_effect():
    """As under a constant voltage without noise."""
    nothing = Signal(0.0, 0.0, Mock(spec=Curve), Mock(spec=Block))
    found = Assessment(Mock(spec=Screen), [], [nothing], p_value=1.0, explained=0.0, explained_unfiltered=0.0)
    assert found.best_candidate_share == 0.0
    assert not found.is_clearly_effect()


@pytest.mark.parametrize(("missed", "verdict"), [({}, "none_detected"), ({"current": 8.1}, "not_in_library")])
def test_a_small_ripple_of_the_speed_sensor_is_accepted_only_beside_white_noise(missed, verdict):
    """The inertia of a crank leaves such a ripple, too, but also residuals of the current far above its noise."""
    ripple = {"may_be_model_form_error": False, "leaves_small_ripple": True}
    found = Mock(spec=Naming, line=None, p_nothing=0.0, p_nothing_more=0.0, chosen=Mock(effects=()), **ripple)
    assert _by_evidence(found, Mock(spec=Identification, missed=missed)) == verdict


@pytest.mark.parametrize(("least_gain", "is_evidence"), [(0.0, True), (50.0, False)])
def test_what_an_uneven_clock_may_leave_is_no_evidence(monkeypatch, least_gain, is_evidence):
    """Its samples are simulated only approximately."""
    clear = Mock(spec=Signal, gain=40.0, log_p=-20.0)
    found = Mock(spec=Screen, candidates=[1], curves=[], least_gain=least_gain)
    monkeypatch.setattr(naming, "screen", lambda model, library: Findings(found, [clear], [], clear.log_p))
    selection = StepwiseSelection.__new__(StepwiseSelection)
    selection.base = Mock(spec=Model, effects=(), is_exact=False, fit=Mock(fitness=1.0), motor=Mock(f=1.0))
    selection.library = Mock(spec=Library)
    assert (selection._assess(selection.base).p_value < FALSE_ALARM) == is_evidence


@pytest.mark.parametrize(("count", "p_value", "exchanges"), [(3, 0.0, 1), (2, 0.0, 0), (3, 1.0, 0)])
def test_a_full_set_exchanges_the_effect_in_the_same_equation(monkeypatch, count, p_value, exchanges):
    """Of dry friction, a delay and an offset the first, if Stribeck friction has the largest expected gain."""
    effects = ("asymmetric_friction", "speed_sensor_delay", "current_sensor_offset")[:count]
    peak = Mock(spec=Signal, effect="stribeck_friction", gain=1.0)
    monkeypatch.setattr(proposals, "clear_new_signals", lambda current, found: [peak])
    exchanged = Mock(spec=Model)
    refits = Mock(spec=Refits, with_signals=lambda current, signals, found: [exchanged])
    refits.without.return_value = Mock(spec=Model)
    found = Mock(
        spec=Assessment,
        candidate_signals=[peak],
        p_value=p_value,
        is_negligible=lambda model: False,
        screen=Mock(spec=Screen, white="white"),
    )
    current = Mock(spec=Model, effects=effects)
    assert Proposals(refits, lambda model: found, set()).by_exchange(current) == ([exchanged] * exchanges)
    assert refits.without.call_count == exchanges
    if exchanges:
        refits.without.assert_called_with(current, "asymmetric_friction", "white")


@pytest.mark.parametrize(
    ("misfit", "preferred_by_own", "is_rival"), [(0.6, True, True), (0.6, False, False), (1.1, True, False)]
)
def test_a_gear_that_its_own_filter_prefers_is_a_rival_of_a_shaft(misfit, preferred_by_own, is_rival):
    shaft = Mock(spec=Model, effects=("shaft_compliance",), fit=Mock(fitness=1.0))
    gear = Mock(spec=Model, effects=("gear_backlash",), fit=Mock(fitness=misfit), is_possible=True)

    def ranked(models, white):
        gear_first = preferred_by_own and white == "gear's"
        criteria = {shaft: 100.0, gear: 50.0 if gear_first else 150.0}
        return [Fitted(m, criteria[m], criteria[m]) for m in sorted(models, key=criteria.get)]

    comparison = Mock(spec=Comparison, ranked=ranked, filter_of=lambda model: "gear's" if model is gear else "shaft's")
    refits = Mock(spec=Refits, models={frozenset({"gear_backlash"}): gear})
    found = list(_better_by_own_filter(shaft, ["shaft_compliance"], refits, comparison))
    assert found == ([gear] if is_rival else [])


def test_an_unstable_motor_suggests_no_experiment(x64):
    time, rest = 1e-3 * np.arange(1000), np.zeros(500)
    volts = np.append(rest, 10 + rest)
    unstable = {**PAPER, "L": -1e-6}
    motors = [Motor(**{n: np.asarray(x) for n, x in m.items()}) for m in (PAPER, unstable)]
    assert difference_between([motors[0], motors[0]], time, volts, np.ones(2)) == 0
    assert difference_between(motors, time, volts, np.ones(2)) == 0
    other = Motor(**{n: np.asarray(x) for n, x in {**PAPER, "R": 1.0}.items()})
    assert difference_between([motors[0], other], time, volts, np.ones(2)) > 1


def test_only_periods_that_the_samples_resolve_are_tried():
    """At 40 rad/s and samples of 20 ms a wave of seven periods per turn has 1.1 samples per period; over a tenth of a
    turn one of ten periods comes only once."""
    slowly_sampled = SCALES._replace(slow_speed=40.0, sample_time=0.02)
    tried = TRIALS["cogging_torque"].candidates
    assert [c.columns[0]["periods"] for c in tried("", slowly_sampled)] == list(range(1, 8))
    assert max(c.columns[0]["periods"] for c in tried("", SCALES)) == 48
    short = SCALES._replace(travel=0.1 * 2 * np.pi)
    assert min(c.columns[0]["periods"] for c in tried("", short)) == 10
    assert tried("", SCALES._replace(travel=0.0)) == []


@pytest.mark.parametrize(
    ("there", "effect", "least", "most"), [(1.0, 0.0, 1.0, 1.3), (5.0, 0.0, 13.0, 21.0), (1.0, 50.0, 1.0, 1.3)]
)
def test_gains_where_errors_are_large_are_worth_less(there, effect, least, most):
    """By their square over the mean square of all (25 / 1.48), but not those of an effect that explains them."""
    rng, count = np.random.default_rng(31), 20_000
    acts = np.arange(count) % 50 == 0
    noise = rng.normal(size=(count, 2)) * np.where(acts, there, 1.0)[:, None]
    shared, own = rng.normal(size=(2, count, 2, 1))
    column = np.stack([acts, np.zeros(count)], 1)[..., None]

    def series(values):
        return Series(values, np.ones(count, bool), (1e-3, (0, 1)))

    residual = series(noise + effect * column[..., 0] * rng.normal())
    fit = RunSeries(series(shared), series(own), residual, series(noise))
    rows = Rows(fit, np.zeros((count, 2, 2)), column, np.zeros((count, 2, 0)))
    white = scaling_whitener([series(noise)])
    evidence = gather_evidence([rows.filtered(0, white)], parameters=1, run_unknowns=1, timing_errors=(0.01, 0.03))
    block = Block((evidence.first_column,), per_run=False)
    assert least <= dispersion_by_moments(block, [rows], white, evidence) < most


def test_coulomb_friction_from_a_peak_alone_is_not_lost():
    peak = StribeckFriction(np.asarray(1e-10), np.asarray(0.3), np.asarray(20.0))
    assert FULLER["coulomb_friction"].to_simple(peak) == {"torque_Nm": pytest.approx(0.15)}


def test_a_shaft_from_a_gear_is_that_of_the_gear():
    values = {"stiffness_Nm_rad": 20.0, "damping_Nms_rad": 1e-3, "load_share": 0.6}
    gear = GearBacklash(**{field: np.asarray(x) for field, x in {"gap_rad": 0.01, **values}.items()})
    assert FULLER["shaft_compliance"].to_simple(gear) == values


SIMILAR = [(old, new) for old in TRIALS for new in TRIALS[old].alike]


@pytest.mark.parametrize(("old", "new"), SIMILAR)
def test_similar_effects_are_converted_into_each_other(old, new):
    """Converted back, they have the same parameters."""
    effect = EFFECTS[old](**dict.fromkeys(EFFECTS[old].ranges, np.asarray(3e-3)))
    values = TRIALS[old].alike[new](effect)
    assert values.keys() == EFFECTS[new].ranges.keys()
    other = EFFECTS[new](**{field: np.asarray(x) for field, x in values.items()})
    back = TRIALS[new].alike[old](other)
    assert back == {field: float(getattr(effect, field)) for field in effect.ranges}


@pytest.mark.parametrize("simple", FULLER)
def test_a_richer_form_starts_with_the_values_of_the_simple_one(simple):
    """It is possible, within its ranges, and as large as the simple one."""
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
    """The evidence from rows that come in two parts."""
    runs = (np.hstack([j, x, y[:, None], o]) for j, o, x, y in zip(J, own, X, r, strict=True))
    return gather_evidence(((rows[:150], rows[150:]) for rows in runs), J[0].shape[1], own[0].shape[1])


def random_evidence(seed: int, runs: int = 3, rows: int = 400):
    rng = np.random.default_rng(seed)
    J, own, X = ([rng.normal(size=(rows, n)) for _ in range(runs)] for n in (4, 2, 5))
    r = [rng.normal(size=rows) + j @ np.arange(4) + x[:, 0] for j, x in zip(J, X, strict=True)]
    return J, own, X, r


def test_late_readings_are_noise_of_their_own_covariance():
    """Regressed with what is known of them, they leave as much as generalised least squares."""
    J, own, X, r = random_evidence(1)
    late, deviation = [x[:, :1] for x in X], 0.03
    pieces = [[np.hstack(p)] for p in zip(J, late, X, [y[:, None] for y in r], own, strict=True)]
    evidence = gather_evidence(pieces, J[0].shape[1], own[0].shape[1], timing_errors=[deviation])

    c = np.concatenate(late)[:, 0]
    white = np.linalg.cholesky(np.linalg.inv(np.eye(len(c)) + deviation**2 * np.outer(c, c))).T
    A = white @ np.hstack([np.concatenate(J), block_diag(*own)])
    y = white @ np.concatenate(r)
    left = y - A @ np.linalg.lstsq(A, y)[0]
    assert evidence.regress().squares == pytest.approx(left @ left, rel=1e-9)


@pytest.mark.parametrize("own_phase", [False, True])
def test_regression_matches_least_squares_by_numpy(own_phase):
    """Applied to the whole matrix, with separate columns for each run's own unknowns."""
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


def test_a_linearly_dependent_column_changes_nothing():
    J, own, X, r = random_evidence(1)
    X = [np.hstack([x, j[:, :1]]) for x, j in zip(X, J, strict=True)]
    evidence = evidence_of(J, own, X, r)
    with_it = evidence.regress([Block((4 + 5,))])
    assert with_it.squares == pytest.approx(evidence.regress().squares, rel=1e-9)


def test_a_column_that_depends_on_the_runs_own_columns_has_no_coefficient():
    """Up to rounding errors, which are no evidence."""
    J, own, X, r = random_evidence(2)
    X = [np.hstack([x, o[:, :1] + 1e-7 * x[:, :1]]) for x, o in zip(X, own, strict=True)]
    fit = evidence_of(J, own, X, r).regress([Block((4 + 5,))])
    assert fit.coefficients[0] == fit.errors[0] == 0.0


@pytest.mark.parametrize("freedom", [1, 2, 12, 42])
def test_the_approximate_tail_matches_the_exact_one(freedom):
    """The leading term of the tail of chi-squared, where the exact one can still be computed."""
    for gain in (520.0, 700.0):
        exact = stats.chi2.logsf(gain, freedom)
        assert log_p_value(gain, freedom) == pytest.approx(exact, abs=0.1 * freedom)


@pytest.mark.parametrize(
    ("effect", "field", "interval", "may_be_zero"),
    [
        ("torque_ripple", "amplitude", (2e-5, 0.64), True),
        ("torque_ripple", "amplitude", (0.1, 0.64), False),
        ("torque_ripple", "amplitude", None, False),
        ("constant_load", "torque_Nm", (-0.1, 0.8), True),
        ("constant_load", "torque_Nm", (1e-3, 0.8), False),
    ],
)
def test_an_amplitude_with_an_interval_down_to_zero_may_be_none(effect, field, interval, may_be_zero):
    estimate = Estimate(0.35, 0.1, interval, "", "identified")
    found = Mock(spec=Identification, parameters={f"{effect}.{field}": estimate})
    assert may_be_absent(found, effect, field) is may_be_zero


@pytest.mark.parametrize(("damping_ratio", "implausible"), [(0.05, None), (3.0, "shaft_compliance")])
def test_a_shaft_that_cannot_ring_is_implausible(damping_ratio, implausible):
    """The ends of s J and (1 - s) J oscillate at sqrt(k / (s (1 - s) J)), damped by d / (2 s (1 - s) J)."""
    stiffness, share = 2.0, 0.6
    reduced = share * (1 - share) * PAPER["J"]
    rate = np.sqrt(stiffness / reduced)
    shaft = ShaftCompliance(*map(np.asarray, (stiffness, damping_ratio * 2 * rate * reduced, share)))
    motor = Motor(**{n: np.asarray(x) for n, x in PAPER.items()}, effects=(shaft,))
    assert implausible_effect(motor) == implausible


@pytest.mark.parametrize(("time_constant", "implausible"), [(0.5, None), (0.1, "resistance_heating")])
def test_a_winding_that_warms_up_at_once_is_implausible(time_constant, implausible):
    """A tenth of a second is the bound of the search. The smallest coreless windings take half a second."""
    heating = ResistanceHeating(np.asarray(1e-3), np.asarray(time_constant))
    motor = Motor(**{n: np.asarray(x) for n, x in PAPER.items()}, effects=(heating,))
    assert implausible_effect(motor) == implausible


def test_a_gain_common_to_waves_of_all_periods_is_no_evidence():
    """As with slow residuals: the evidence for one period of cogging is its gain beyond the others."""
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
    slow[3] = 500.0  # a true wave does not raise the median
    assert common(slow) == {"cogging_torque": pytest.approx(40.0, abs=2.0)}


def test_rounding_errors_of_a_coarse_reading_are_no_evidence():
    """Twenty constant speeds, rounded to whole rad/s: a curve over the speed seems to explain the errors."""
    false_alarms = {"as if white": 0, "by rounding": 0}
    for seed in range(50):
        speed = np.random.default_rng(seed).uniform(-6, 6, 20).repeat(100)[:, None]
        kind, known = (1e-3, (1,)), np.ones(len(speed), bool)
        shared, own, residual, simulated = (
            Series(x, known, kind)
            for x in (speed[..., None], np.ones((len(speed), 1, 1)), np.round(speed) - speed, speed)
        )
        errors = rounding_errors(RunSeries(shared, own, residual, simulated), [1.0], seed)
        parts = (shared.values, (speed * np.abs(speed))[..., None], errors, residual.values[..., None])
        rows = np.concatenate([*parts, own.values], -1)[:, 0] * np.sqrt(12)
        evidence, drag = (gather_evidence([[rows]], 1, 1, rounding_errors=ROUNDING_DRAWS), Block((1,)))
        gain = evidence.regress().squares - evidence.regress([drag]).squares
        noise = evidence.rounding_dispersion(drag)
        false_alarms["as if white"] += stats.chi2.sf(gain, 1) < 0.01
        false_alarms["by rounding"] += stats.chi2.sf(gain / noise, 1) < 0.01
    assert false_alarms["as if white"] > 25
    assert false_alarms["by rounding"] <= 3


@pytest.mark.parametrize(
    ("read", "coarse"),
    [
        (lambda exact, rng: np.round(exact), True),
        (lambda exact, rng: np.round(exact + 2 * rng.normal(size=exact.shape)), False),
        # encoder counts from sample to sample: errors do not last
        (lambda exact, rng: np.diff(np.round(np.cumsum(exact, 0)), axis=0, prepend=0), False),
    ],
    ids=["rounded", "dithered", "counted"],
)
def test_only_rounding_without_dither_is_coarse(read, coarse):
    exact, known = np.linspace(0, 20, 2000)[:, None], np.ones(2000, bool)
    left, simulated = (
        Series(0.5 * x, known, (1e-3, (0,))) for x in (read(exact, np.random.default_rng(0)) - exact, exact)
    )
    fit = RunSeries(simulated, simulated, left, simulated)
    errors = rounding_errors(fit, [0.5], seed=0)
    assert bool(errors.any()) is coarse
    assert np.abs(errors).max() <= 0.25 + 1e-12
    assert np.array_equal(errors, rounding_errors(fit, [0.5], seed=0))


# ---------------------------------------------------------------------------------- the noise


def coloured(seed: int, samples: int, scale: float) -> np.ndarray:
    """Residuals of speed, and a little of current, under a slowly fluctuating torque, with white sensor noise."""
    rng = np.random.default_rng(seed)
    slow = np.zeros(samples)
    for k in range(1, samples):
        slow[k] = 0.97 * slow[k - 1] + rng.normal()
    return scale * (np.stack([0.1 * slow, slow], 1) + rng.normal(size=(samples, 2)) * [0.3, 2.0])


def test_filtered_residuals_are_white():
    known = np.ones(6000, bool)
    series = [Series(coloured(k, 6000, s), known, (1e-3, (0, 1))) for k, s in enumerate((1.0, 5.0))]
    white = fit_whitener(series)
    for k, s in enumerate(series):
        rows = white(k, s).reshape(-1, 2)
        np.testing.assert_allclose(np.cov(rows.T), np.eye(2), atol=0.05)
        for lag in range(1, 40):
            correlation = rows[lag:].T @ rows[:-lag] / len(rows)
            assert np.abs(correlation).max() < 5 / np.sqrt(len(rows)), lag


def test_runs_of_different_colours_have_filters_of_their_own():
    known, kind = np.ones(4000, bool), (1e-3, (0, 1))
    plain = np.random.default_rng(3).normal(size=(4000, 2))
    series = [Series(values, known, kind) for values in (plain, coloured(0, 4000, 1.0), coloured(1, 4000, 1.0))]
    white = fit_whitener(series)
    for k, s in enumerate(series):
        rows = white(k, s).reshape(-1, 2)
        for lag in range(1, 40):
            correlation = rows[lag:].T @ rows[:-lag] / len(rows)
            assert np.abs(correlation).max() < 5 / np.sqrt(len(rows)), (k, lag)
    assert not len(white.filters[0])
    alike = fit_whitener(series[1:])
    np.testing.assert_array_equal(*alike.filters)


def test_slow_noise_far_below_that_of_a_sensor_is_whitened():
    """Hardly correlated from sample to sample, but for a hundred samples: a tenth of the power."""
    rng, known = np.random.default_rng(4), np.ones(6000, bool)
    slow = lfilter([1.0], [1.0, -0.99], rng.normal(size=6000))
    values = rng.normal(size=(6000, 2)) + np.array([0.3, 0.0]) * (slow / slow.std())[:, None]
    series = Series(values, known, (1e-3, (0, 1)))
    white = fit_whitener([series])

    def slow_power(rows: np.ndarray) -> float:
        return float(np.mean(np.abs(np.fft.rfft(rows[:, 0])[1:16]) ** 2) / len(rows) / np.var(rows[:, 0]))

    assert slow_power(values) > 8
    assert slow_power(white(0, series).reshape(-1, 2)) < 2


def test_the_filter_omits_rows_that_need_missing_samples():
    """Whatever values the missing samples have."""
    values = coloured(0, 3000, 1.0)
    known = np.ones(3000, bool)
    known[1000:1010] = False
    damaged = values.copy()
    damaged[~known] = 1e9
    clean = Series(values, known, (1e-3, (0, 1)))
    white = fit_whitener([clean])
    np.testing.assert_array_equal(white(0, clean), white(0, clean._replace(values=damaged)))


def test_gaps_do_not_prevent_whitening():
    """Twelve samples of a hundred, scattered, so that hardly thirty in a row were measured."""
    known = np.random.default_rng(3).random(8000) > 0.2
    white = fit_whitener([Series(coloured(0, 8000, 1.0), known, (1e-3, (0, 1)))])
    assert len(white.filters[0]) >= 2


@pytest.mark.parametrize("samples", [3, 16, 25, 31, 45])
def test_a_few_readings_are_scaled_like_the_other_runs_of_their_kind(samples):
    kind = (1e-3, (0, 1))
    short = Series(coloured(1, samples, 1.0), np.ones(samples, bool), kind)
    long = Series(coloured(2, 4000, 1.0), np.ones(4000, bool), kind)
    assert np.isfinite(fit_whitener([short]).scales[0]).all()
    white = fit_whitener([long, short])
    assert np.abs(np.log(np.diag(white.scales[1]) / np.diag(white.scales[0]))).max() < 0.7


def test_too_few_readings_are_not_diagnosed():
    time = 1e-3 * np.arange(400)
    run = simulate(Motor(**PAPER), Recording("run", time, 12 * np.sign(np.sin(400 * time))))
    outputs = np.stack([run.current, run.speed]) + np.random.default_rng(2).normal(0, 0.1, (2, 400))
    apart = [np.where(np.arange(400) % 2 == k, x, np.nan) for k, x in enumerate(outputs)]
    with pytest.raises(InputError, match="read together only 0 times"):
        diagnose(Recording("apart", time, run.voltage, *apart), unloaded=True)
    with pytest.raises(InputError, match="read together only 30 times"):
        diagnose(Recording("short", time[:30], run.voltage[:30], *outputs[:, :30]), unloaded=True)


# ------------------------------------------------------------------------- lines in the spectrum


def spectra_with_oscillations(hertz: Sequence[float], drive_hertz: float | None = None, size: float = 1.5):
    """Spectra of runs of 4, 6, 8, ... s of coloured noise, each with an oscillation of a given frequency."""
    found = []
    for k, f in enumerate(hertz):
        time = 1e-3 * np.arange(4000 + 2000 * k)
        noise = coloured(k, len(time), 1.0)
        noise[:, 1] += size * noise.std() * np.sin(2 * np.pi * f * time + k)
        drive = np.random.default_rng(k).normal(size=(len(time), 1))
        if drive_hertz is not None:
            drive[:, 0] += np.sin(2 * np.pi * drive_hertz * time)
        found.append(spectrum(noise, drive, 1e-3))
    return found


def test_an_external_periodic_torque_is_found_at_its_frequency():
    line = common_line(spectra_with_oscillations([7.3] * 4))
    assert line.low < 7.3 < line.high
    assert line.high - line.low < 0.3


def test_a_slow_periodic_torque_is_found_if_it_is_strong():
    """Few periods in a run, at frequencies where the noise is strongest."""
    line = common_line(spectra_with_oscillations([1.26] * 4, size=6.0))
    assert line.low < 1.26 < line.high


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_weak_line_in_a_single_run_is_ignored(size):
    assert common_line(spectra_with_oscillations([7.3], size=size)) is None


@pytest.mark.parametrize("hertz", [[7.3, 9.1, 12.4, 31.0], [7.3, 7.3, 21.0, 31.0]])
def test_a_line_in_few_of_the_runs_is_ignored(hertz):
    assert common_line(spectra_with_oscillations(hertz)) is None


def test_a_line_of_the_drive_is_ignored():
    assert common_line(spectra_with_oscillations([7.3] * 4, drive_hertz=7.3)) is None


def test_a_line_to_which_a_controller_reacts_is_found():
    """It is in the voltage, too, but far weaker. Two runs are enough if it is far clearer in one of them."""
    free, controlled = spectra_with_oscillations([7.3] * 2, size=6.0)
    controlled = controlled._replace(driving=np.maximum(controlled.driving, controlled.residual / 20))
    line = common_line([free, controlled])
    assert line.low < 7.3 < line.high
    driven = controlled._replace(driving=controlled.residual)
    assert common_line([free, driven]) is None


def test_harmonics_of_a_periodic_drive_are_ignored():
    """A wrong friction model causes lines at harmonics that the drive itself may lack."""
    rng, time = np.random.default_rng(0), np.arange(8000) * 1e-3
    wave = np.sin(2 * np.pi * 1.3 * time)
    residuals = 3 * np.sin(2 * np.pi * 3 * 1.3 * time)[:, None] + rng.normal(size=(8000, 2))
    once = rng.normal(size=(8000, 1)).cumsum(0)
    assert common_line([spectrum(residuals, wave[:, None], 1e-3)] * 3) is None
    assert common_line([spectrum(residuals, once, 1e-3)] * 3) is not None


def test_the_frequency_of_a_line_is_that_of_the_longest_run_without_a_periodic_drive():
    *others, longest = spectra_with_oscillations([7.3] * 4)
    line = common_line([*others, longest._replace(residual=np.zeros_like(longest.residual))])
    assert line.low < 7.3 < line.high


@pytest.mark.parametrize("seed", range(20))
def test_coloured_noise_has_no_line(seed):
    rng = np.random.default_rng(seed)
    runs = [coloured(100 * seed + k, 5000, 1.0) for k in range(3)]
    assert common_line([spectrum(x, rng.normal(size=(5000, 1)), 1e-3) for x in runs]) is None


# ------------------------------------------------------------------------- first-order responses


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


# effects that act through a parameter, with a state of their own, of a sensor, and over the angle, at which runs may
# begin anywhere
SMOOTH = {
    "torque_constant_saturation": {"per_A2": 1e-9, "emf_share": 0.0},
    "resistance_heating": {"rise_per_W": 1e-8, "time_constant_s": 0.2},
    "speed_sensor_delay": {"delay_s": 2.5e-3},
    "cogging_torque": {"amplitude_Nm": 1e-6, "phase_rad": 0.3, "periods": 3.0},
}
INITIAL_ANGLES = jnp.array([0.4, 2.0])  # rad


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_the_first_order_response_matches_the_change_of_the_simulation(x64, name):
    """The change is that between two full simulations, one with a very small effect."""
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings(runs()))
    bare = Motor(**{n: jnp.asarray(x) for n, x in PAPER.items()})
    effect = EFFECTS[name](**{f: jnp.asarray(x) for f, x in SMOOTH[name].items()})
    motor = Motor(**{n: jnp.asarray(x) for n, x in PAPER.items()}, effects=(effect,))
    own = RunUnknowns.as_recorded(tape)._replace(angle=INITIAL_ANGLES)
    without, with_it = (free_run(m, tape, own) for m in (bare, motor))
    path = trajectory_of(without, tape, INITIAL_ANGLES, False, False)
    if EFFECTS[name].equation == "sensor":
        found = sensor_changes(motor, bare, tape, path)
    else:
        found = respond(bare, tape, path, state_increments(motor, bare, tape, path)[..., None])[..., 0]
    expected = (with_it - without).transpose(2, 1, 0)
    weight = np.asarray(tape.weight).transpose(2, 1, 0)
    for c in range(2):
        scale = np.abs(expected[:, c] * weight[:, c]).max()
        error = np.abs((found - expected)[:, c] * weight[:, c]).max()
        assert error <= 0.02 * scale + 1e-12, (name, c, error, scale)


def test_the_response_lasts_while_the_rotor_coasts(x64):
    """Where the brushes block the current, no back-EMF brakes."""
    time, zero = 1e-3 * np.arange(500), np.zeros(500)
    run = Recording("coasting", time, np.where(time < 0.15, 12.0, 5.0), zero, zero, load=zero)
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings([run]))
    brushes = EFFECTS["brush_voltage_drop"](voltage_V=jnp.asarray(3.0))
    drag = EFFECTS["quadratic_drag"](drag_Nms2_rad2=jnp.asarray(1e-9))
    bare = Motor(**{n: jnp.asarray(x) for n, x in PAPER.items()})
    own = RunUnknowns.as_recorded(tape)
    without, with_it = (free_run(bare.with_effects(e), tape, own) for e in ([brushes], [brushes, drag]))
    path = trajectory_of(without, tape, jnp.zeros(1), False, True)
    motor = bare.with_effects([drag])
    found = respond(bare, tape, path, state_increments(motor, bare, tape, path)[..., None])[..., 0]
    expected = tape.samples_of(0, with_it - without, 500)
    found = tape.samples_of(0, found.transpose(2, 1, 0), 500)
    assert np.mean(without[:, 0] == 0) > 0.4
    np.testing.assert_allclose(found[:, 1], expected[:, 1], atol=0.05 * np.ptp(expected[:, 1]))
    assert abs(expected[499, 1]) > 3 * abs(expected[140, 1])


@pytest.mark.parametrize("group_size", [1, 4, 5, 32])
def test_columns_are_the_same_in_groups_of_any_size(group_size):
    values = np.random.default_rng(3).standard_normal((10, 2, 3, 13)).astype(np.float32)
    cuts = ((0, 5, False), (5, 6, False), (6, 8, True), (8, 13, False))
    changes = [Change(values[..., a:b], by_sensor) for a, b, by_sensor in cuts]
    parts = list(_batches(changes, group_size))
    assert all(part.by_sensor or part.values.shape[-1] == group_size for part, _ in parts)
    together = [part.values[..., :width] for part, width in parts]
    np.testing.assert_array_equal(np.concatenate(together, -1), values)


# --------------------------------------------------------------------------------- sets of effects


@pytest.mark.parametrize(
    ("one", "other", "rivals"),
    [
        ("brush_voltage_drop", "input_dead_zone", True),
        ("coulomb_friction", "quadratic_drag", True),
        ("coulomb_friction", "stribeck_friction", False),  # one contains the other
        # the same torque in motion
        ("coulomb_friction constant_load", "asymmetric_friction", False),
        ("coulomb_friction", "coulomb_friction quadratic_drag", False),  # a subset
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
def test_a_second_torque_over_the_angle_keeps_the_phase_of_the_first(periods):
    """Cogging of six periods leaves the initial angle of each run open by some of its periods; once these offsets are
    corrected, the second torque has the same phase in all runs."""
    rng = np.random.default_rng(5)
    whole = 2 * np.pi * np.arange(6) / 6
    offsets = np.append(0.0, rng.choice(whole, 7))
    phases = 0.8 + periods * offsets + 0.05 * rng.normal(size=8)
    sizes = rng.uniform(0.5, 2.0, 8)
    both = sizes[:, None] * np.stack([np.cos(phases), np.sin(phases)], 1)
    phase, corrections = common_phase(both, [np.zeros(1), *[whole] * 7], periods)
    assert phase == pytest.approx(0.8, abs=0.1)
    np.testing.assert_allclose(np.cos(periods * (corrections - offsets)), 1.0, atol=1e-6)
    assert all(np.min(np.abs(whole - angle)) == 0 for angle in corrections)


def test_runs_of_unknown_initial_angle_are_aligned_with_the_first():
    phases = np.array([0.3, 2.0, -3.0, 1.0])
    both = np.stack([np.cos(phases), np.sin(phases)], 1)
    phase, corrections = common_phase(both, [np.zeros(1), None, None, None], 7.0)
    assert phase == pytest.approx(0.3, abs=0.03)  # the resolution of the search
    np.testing.assert_allclose(np.cos(phases - phase - 7.0 * corrections), 1.0, atol=1e-3)


def model_at(coordinates: list[float], effects: tuple[str, ...] = (), **missing: None) -> Model:
    """A motor, not fitted, with these search coordinates, and a run of the bench without what is `missing`."""
    rng = np.random.default_rng(7)
    columns = vb.record(vb.BenchMotor(**PAPER), vb.prbs(rng, 2.0), rng, vb.Noise())
    run = evolve(recording("run", columns), load=None, **missing)
    given = prepare([run], [], effects=[EFFECTS[e] for e in effects], unloaded=True)
    start = Unknowns(jnp.asarray(coordinates), RunUnknowns(*jnp.zeros((UNKNOWNS_PER_RUN, 1))))
    point = Optimum(start, np.inf, ())
    return model_of(FittedRuns(given, fit_at(given.problem, point)))


def test_an_undetermined_effect_without_start_values_is_kept_as_it_is(x64):
    """As of one that a global search added: friction too small for the runs, to which another effect is added."""
    coordinates = np.log([*(PAPER[n] for n in PARAMETERS), 2e-10]).tolist()
    model = model_at(coordinates, ("coulomb_friction",))
    assert model.undetermined == {"coulomb_friction.torque_Nm"}
    values = {"current_sensor_offset": {"offset_A": 0.5}}
    effects = ("coulomb_friction", "current_sensor_offset")
    prepared, point = Starts(SCALES).from_model(model, effects, values)
    start = np.asarray(point.unknowns.coordinates)
    np.testing.assert_allclose(start[:-1], coordinates)
    assert prepared.problem.parameters.value("current_sensor_offset.offset_A", start) == pytest.approx(0.5)


def test_a_parameter_that_only_a_fuller_form_has_is_kept_as_it_is(x64):
    """The onset of a brush drop that was first fitted as a constant one, where no run is sensitive to it."""
    constant = model_at(np.log([*(PAPER[n] for n in PARAMETERS), 2e-5]).tolist(), ("brush_voltage_drop",))
    gradual = constant.prepared.with_effects([GradualBrushDrop])
    unknowns = constant.fit.unknowns._replace(coordinates=jnp.append(constant.fit.coordinates, np.log(3.0)))
    model = model_of(FittedRuns(gradual, fit_at(gradual.problem, Optimum(unknowns, np.inf, ()))))
    assert "brush_voltage_drop.onset_A" in model.undetermined
    starts = Starts(SCALES)
    starts.first_values["brush_voltage_drop"] = {"voltage_V": 0.5}
    effects = ("brush_voltage_drop", "current_sensor_offset")
    prepared, point = starts.from_model(model, effects, {"current_sensor_offset": {"offset_A": 0.5}})
    start = np.asarray(point.unknowns.coordinates)
    assert prepared.problem.parameters.value("brush_voltage_drop.voltage_V", start) == pytest.approx(0.5)
    assert prepared.problem.parameters.value("brush_voltage_drop.onset_A", start) == pytest.approx(3.0)


def test_effects_that_need_a_current_are_not_tried_without_one(x64):
    """Voltage and speed alone do not determine the scale of the current."""
    base = model_at([np.log(PAPER[n]) for n in PARAMETERS], current=None)
    tried = {candidate.effect for candidate in Library(base).candidates}
    assert {"coulomb_friction", "speed_sensor_delay"} <= tried
    assert not any(EFFECTS[name].needs_current for name in tried)


def test_no_voltage_is_missing_from_runs_driven_by_a_current(x64):
    base = model_at([np.log(PAPER[n]) for n in ("Kt", "J", "f")], voltage=None)
    tried = {candidate.effect for candidate in Library(base).candidates}
    assert {"coulomb_friction", "torque_constant_saturation", "speed_sensor_delay"} <= tried
    assert not tried & {"input_dead_zone", "brush_voltage_drop", "resistance_heating", "inductance_saturation"}
