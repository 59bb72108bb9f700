"""The tables and figures of the wheelchair-motor paper, reproduced from its printed motor."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from attrs import field, frozen

from ..motor import PARAMETERS, Motor
from ..progress import ReportProgress, silent
from ..runtime.precision import double_precision
from .printed import LOADS, LOWER_SETPOINT, PRINTED, SETPOINT, TABLE_2, VOLTAGE

if TYPE_CHECKING:
    from ..control.loop import Response
    from ..control.tuning import Tuning
    from ..recordings.recording import Recording

# V, enough for the printed settling time of 0.08 s
SUFFICIENT_VOLTAGE = 25.0
NOISE = {"current": 0.1, "speed": 0.5}  # A, rad/s
# time constant of the derivative filter over Kd / Kp; the paper prints none, a tenth is the textbook value
FILTER_RATIO = 0.1


@frozen
class AsPrinted:
    """Simulation of the printed gains on the printed motor, 0 to 481 to 240.5 rad/s, without any limit."""

    overshoot: float  # %
    settling: float  # s
    peak_voltage: float  # V
    time: np.ndarray = field(repr=False)  # s
    speed: np.ndarray = field(repr=False)  # rad/s


@frozen
class Recovered:
    """Table 1 as identified from the virtual load test by one method."""

    method: str
    motor: Motor
    evaluations: int
    seconds: float
    best: np.ndarray  # best fitness after each generation

    @property
    def errors(self) -> dict[str, float]:
        """Relative error of each parameter, %."""
        return {name: 100 * (float(getattr(self.motor, name)) / getattr(PRINTED, name) - 1) for name in PARAMETERS}


@frozen
class Paper:
    """Reproduced tables and figures."""

    recovered: tuple[Recovered, ...]
    reach: float  # steady speed on 24 V, rad/s
    tunings: Mapping[str, Tuning]
    fastest: Mapping[float, float]  # fastest settling (s) by voltage limit (V)
    steps: Mapping[str, Response]  # 0 to 481 to 240.5 rad/s, by controller
    as_printed: Mapping[str, AsPrinted]  # for the controllers whose gains are printed


def reproduce(progress: ReportProgress | None = None) -> Paper:
    """Reproduce all tables and figures of the paper."""
    from ..control.pipeline import tune
    from ..control.time_optimal import fastest_settling

    report = progress or silent
    report("recovering Table 1", fraction=0.0)
    recovered = (recovered_by_paper_ga(), recovered_by_identify())
    tunings = {}
    for k, kind in enumerate(TABLE_2):
        report(f"tuning {kind}", fraction=0.4 + 0.15 * k)
        tunings[kind] = tune(
            PRINTED, kind, setpoint=SETPOINT, voltage_limit=SUFFICIENT_VOLTAGE, sample_time=1e-3, max_overshoot=0.5
        )
    fastest = {
        volts: fastest_settling(PRINTED, SETPOINT, volts) or float("nan")
        for volts in (24.0, 25.0, 26.0, 28.0, 30.0, 36.0, 48.0)
    }
    report("simulating Figs 7 and 8", fraction=0.9)
    steps = {kind: step_up_and_down(tuning) for kind, tuning in tunings.items()}
    gains = {kind: row.gains for kind, row in TABLE_2.items() if row.gains}
    as_printed = {kind: simulated_as_printed(*of_kind) for kind, of_kind in gains.items()}
    top_speed = float(PRINTED.steady_speed(VOLTAGE))
    return Paper(recovered, top_speed, tunings, fastest, steps, as_printed)


def load_test(seed: int = 0) -> Recording:
    """The virtual load test: 24 V from rest, then the load rises in steps to 1 N m; 1 ms samples, noisy sensors."""
    from ..recordings.recording import Recording
    from ..simulate import simulate

    rng = np.random.default_rng(seed)
    samples = 200 * len(LOADS)
    time = 1e-3 * np.arange(samples)
    load = np.repeat(LOADS, 200)
    voltage = np.full(samples, VOLTAGE)
    run = Recording("load test", time, voltage, np.zeros(samples), np.zeros(samples), load=load)
    clean = simulate(PRINTED, run)
    assert clean.current is not None and clean.speed is not None
    return attrs.evolve(
        clean,
        current=clean.current + NOISE["current"] * rng.standard_normal(samples),
        speed=clean.speed + NOISE["speed"] * rng.standard_normal(samples),
    )


@double_precision
def recovered_by_paper_ga(seed: int = 0) -> Recovered:
    """Identify by the paper's binary genetic algorithm alone: 20 chromosomes of 60 bits."""
    from ..identify.parameters import Parameters
    from ..identify.search.bounds import search_bounds
    from ..identify.search.evolution import global_search
    from ..simulate import Tape, on_even_clock

    run = load_test()
    begin = time.perf_counter()
    parameters = Parameters.of(search_bounds([run]))
    tape = Tape.from_recordings([on_even_clock(run)])
    noise = np.array([NOISE["current"], NOISE["speed"]])
    result = global_search(parameters, tape, noise, method="paper_ga", seed=seed)
    motor = jax.tree.map(float, parameters(jnp.asarray(result.candidates[0])))
    seconds = time.perf_counter() - begin
    return Recovered("the paper's GA", motor, result.evaluations, seconds, result.best)


def recovered_by_identify(seed: int = 0) -> Recovered:
    """Identify by `identify`: evolution strategy, then least squares."""
    from ..identify import identify

    run = load_test()
    begin = time.perf_counter()
    identification = identify([run], seed=seed)
    seconds = time.perf_counter() - begin
    motor = jax.tree.map(float, identification.motor)
    search = identification.search
    best = np.append(search.best, search.refined[:1])
    return Recovered("ours", motor, search.evaluations, seconds, best)


def load_errors(motor: Motor) -> dict[str, np.ndarray]:
    """Figs 5 and 6: error (%) of steady speed and current on 24 V at each load torque in `LOADS`."""
    speed, printed_speed = (np.asarray(m.steady_speed(VOLTAGE, LOADS)) for m in (motor, PRINTED))
    current = np.asarray(motor.steady_current(speed, LOADS))
    printed_current = np.asarray(PRINTED.steady_current(printed_speed, LOADS))
    return {"speed": 100 * (speed / printed_speed - 1), "current": 100 * (current / printed_current - 1)}


@double_precision
def step_up_and_down(tuning: Tuning) -> Response:
    """Simulated step from rest to 481 rad/s and, 200 samples later, to 240.5 rad/s."""
    from ..control.loop import Course, Response, closed_loop_jit

    reference = jnp.repeat(jnp.asarray([SETPOINT, LOWER_SETPOINT]), 200)
    course = Course(reference, 0.0 * reference, 0.0 * reference)
    response = closed_loop_jit(tuning.motor, tuning.law, course, 4)
    return Response(*(np.asarray(x) for x in response))


@double_precision
def simulated_as_printed(proportional: float, integral: float, derivative: float) -> AsPrinted:
    """Ideal loop of equation (9) with PI or PID, filtered derivative of the error; simulated by `scipy.signal`."""
    from scipy.signal import lsim

    from ..control.metrics import step_metrics

    s, lag = np.poly1d([1.0, 0.0]), FILTER_RATIO * derivative / proportional
    controller_numerator = (proportional * s + integral) * (lag * s + 1) + derivative * s * s
    controller_denominator = s * (lag * s + 1)
    numerators, denominator = jax.tree.map(jnp.asarray, PRINTED).transfer_function()
    motor_numerator = np.poly1d(np.asarray(numerators["voltage -> speed"]))
    motor_denominator = np.poly1d(np.asarray(denominator))
    closed = controller_denominator * motor_denominator + controller_numerator * motor_numerator
    samples, step = 4000, 1e-4
    time = step * np.arange(samples)
    reference = np.where(time < 0.5 * samples * step, SETPOINT, LOWER_SETPOINT)
    to_speed = controller_numerator * motor_numerator
    to_voltage = controller_numerator * motor_denominator
    _, speed, _ = lsim((to_speed.coeffs, closed.coeffs), reference, time, interp=False)
    _, voltage, _ = lsim((to_voltage.coeffs, closed.coeffs), reference, time, interp=False)
    first = slice(0, samples // 2)
    metrics = step_metrics(jnp.asarray(time[first]), jnp.asarray(speed[first]), SETPOINT)
    overshoot, settling = float(metrics.Overshoot), float(metrics.SettlingTime)
    return AsPrinted(overshoot, settling, float(np.abs(voltage).max()), time, speed)
