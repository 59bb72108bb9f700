"""How close do tuned controllers come to the fastest possible settling? The paper's motor, 0 to 481 rad/s.

`python -m experiments.speed_control ideal|sampled|robust [--volts 30 36]`

ideal: 0.1 ms sampling, no delay, overshoot of 0.06 % allowed; the same gains are then simulated in
continuous time. sampled: 1 ms, one sample of delay, speed in steps of 0.1 rad/s, 0.5 % allowed.
robust: sampled, tuned for a spread of 10 % of every parameter and evaluated on 256 motors, also
relative to the fastest settling of each.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.continuous_loop import continuous_loop
from pmdc_jax.control import fastest_settling, step_metrics
from pmdc_jax.control.evaluation import Robustness
from pmdc_jax.control.pipeline import VALIDATION_MOTORS, robustness, tune
from pmdc_jax.control.spread import drawn_motors, even_spread
from pmdc_jax.control.tuning import Tuning
from pmdc_jax.paper.printed import PRINTED, SETPOINT

KINDS = ("pi", "pid", "state-feedback")
IDEAL = {"sample_time": 1e-4, "delay": 0, "max_overshoot": 0.06}
SAMPLED = {"sample_time": 1e-3, "delay": 1, "speed_step": 0.1, "max_overshoot": 0.5}


def tuned(kind: str, volts: float, **options) -> Tuning:
    """One tuning of the paper's motor."""
    return tune(PRINTED, kind, setpoint=SETPOINT, voltage_limit=volts, **options)


def in_continuous_time(tuning: Tuning) -> tuple[float, float]:
    """Settling time over the fastest possible, and overshoot (%), of the same gains without sampling."""
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, 3 * tuning.fastest_possible_settling, 6001)
        volts = tuning.hardware.voltage_limit
        response = continuous_loop(PRINTED, tuning.controller, times, SETPOINT, volts)
        found = step_metrics(response.time, response.speed, SETPOINT)
    return float(found.SettlingTime) / tuning.fastest_possible_settling, float(found.Overshoot)


def nominal_table(volts: list[float], options: dict, continuous: bool) -> Table:
    """Settling time over the fastest possible, overshoot and response to a load, per controller and voltage."""
    shown = Table(title=f"0 to {SETPOINT:g} rad/s, {options}")
    for heading in ("V", "controller", "limit s", "settling / limit", "overshoot %", "load N m"):
        shown.add_column(heading, justify="right")
    for heading in ("steady error rad/s", "to half, under load: ms, %", "sensitivity", "seconds"):
        shown.add_column(heading, justify="right")
    if continuous:
        shown.add_column("continuous: / limit, %", justify="right")
    for v in volts:
        for kind in KINDS:
            found = tuned(kind, v, **options)
            shown.add_row(*_cells(v, kind, found, continuous))
    return shown


def _cells(volts: float, kind: str, found: Tuning, continuous: bool) -> list[str]:
    limit, settling = found.fastest_possible_settling, found.metrics["SettlingTime"]
    second = found.tuned.second_step
    cells = [
        f"{volts:g}",
        kind,
        f"{limit:.4f}",
        "never" if settling is None else f"{settling / limit:.4f}",
        f"{found.metrics['Overshoot']:.3f}",
        f"{found.load_torque:.2f}",
        f"{found.load['SteadyStateError']:.3f}",
        f"{1e3 * (second['SettlingTime'] or float('inf')):.1f}, {second['Overshoot']:.1f}",
        f"{found.margins.sensitivity_peak or float('inf'):.2f}",
        f"{found.seconds['total']:.1f}",
    ]
    if continuous:
        cells.append("{:.4f}, {:.3f}".format(*in_continuous_time(found)))
    return cells


def own_limits(volts: float, seed: int) -> np.ndarray:
    """The fastest settling of each random motor, s; infinite if 481 rad/s is out of reach."""
    with jax.enable_x64(True):
        motors = drawn_motors(PRINTED, even_spread(0.1), VALIDATION_MOTORS, seed)
        each = [jax.tree.map(lambda leaf: leaf[k], motors) for k in range(VALIDATION_MOTORS)]  # noqa: B023
    return np.array([fastest_settling(m, SETPOINT, volts) or np.inf for m in each])


def robust_table(volts: list[float]) -> Table:
    """95th percentiles of robust tuning, tuning for the nominal motor only, and Ziegler-Nichols."""
    shown = Table(title="256 motors, every parameter spread by 10 %; limit of the nominal motor")
    for heading in ("V", "controller", "gains", "overshoot p95 %", "settling p95 / limit"):
        shown.add_column(heading, justify="right")
    for v in volts:
        own = np.quantile(own_limits(v, 1), 0.95, method="higher")
        nominal = fastest_settling(PRINTED, SETPOINT, v)
        shown.add_row(f"{v:g}", "any", "time-optimal for each", "0", f"{own / nominal:.3f}")
        for kind in ("pi", "pid", "state-feedback-integral"):
            robust = tuned(kind, v, **SAMPLED | {"max_overshoot": 1.0}, spread=0.1)
            alone = tuned(kind, v, **SAMPLED)
            for candidate in (robust.tuned, robust.textbook):
                name = "robust" if candidate.name == "tuned" else candidate.name
                shown.add_row(f"{v:g}", kind, name, *_percentiles(candidate.robust, nominal))
            cells = _percentiles(robustness(alone, 0.1, robust.seed), nominal)
            shown.add_row(f"{v:g}", kind, "nominal", *cells)
    return shown


def _percentiles(robust: Robustness | None, limit: float | None) -> list[str]:
    assert robust is not None and limit is not None
    slow = robust.SettlingTime_p95
    return [f"{robust.Overshoot_p95:.2f}", "never" if slow is None else f"{slow / limit:.3f}"]


def main() -> None:
    """Run one of the studies and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=("ideal", "sampled", "robust"))
    parser.add_argument("--volts", type=float, nargs="+", default=[25, 26, 28, 30, 36, 48])
    options = parser.parse_args()
    console = Console(width=170)
    if options.study == "robust":
        console.print(robust_table(options.volts))
        return
    ideal = options.study == "ideal"
    console.print(nominal_table(options.volts, IDEAL if ideal else SAMPLED, ideal))


if __name__ == "__main__":
    main()
