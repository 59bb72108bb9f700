"""How does a recording affect the controller? From data to a closed-loop metric, differentiated in one line.

`python -m experiments.data_to_gains`

Samples -> estimate (a Gauss-Newton step at the optimum, which is the estimate to first order) -> motor
-> sampled PID loop with limits -> overshoot and settling time. The gradient by the samples shows how
each volt, ampere and rad/s of the recording affects the loop, and that by the estimate how the
uncertainty of each parameter does. Both are checked against finite differences of the whole chain.
"""

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from pmdc_jax import identify, read_recording
from pmdc_jax.control import PID, Course, Hardware, Law, closed_loop
from pmdc_jax.control.metrics import smooth_overshoot, smooth_settling
from pmdc_jax.demo import SAMPLE
from pmdc_jax.motor import PARAMETERS, Motor
from pmdc_jax.simulate import Tape, free_run, on_even_clock

RUNS = ("prbs", "loaded")
SETPOINT = 200.0  # rad/s
VOLTS = 18.0  # limit of the voltage, V
SAMPLES = 200  # of 1 ms in the simulated step
GAINS = PID(0.3, 25.0, 0.0003, 0.001, 1.0, 0.2)


def motor_of(logarithms) -> Motor:
    """The motor from the logarithms of R, L, Kb, Kt, J, f."""
    return Motor(*jnp.exp(logarithms))


def loop_metrics(logarithms, nominal: Motor):
    """Overshoot (%) and settling time (s) of a loop designed for `nominal`, with the estimated motor."""
    law = Law.of(GAINS, Hardware(1e-3, VOLTS, None, None, 1), nominal)
    course = Course(jnp.full(SAMPLES, SETPOINT), jnp.zeros(SAMPLES), jnp.zeros(SAMPLES))
    response = closed_loop(motor_of(logarithms), law, course, 4)
    settling = smooth_settling(response.time, response.speed, SETPOINT, 0.0, 0.1)
    return jnp.stack([smooth_overshoot(response.speed, SETPOINT, 0.0, 0.05), settling])


def outputs(logarithms, tape: Tape):
    """Simulated current and speed of every sample."""
    return free_run(motor_of(logarithms), tape)


def estimate(measured, at, tape: Tape, scale):
    """The least-squares estimate as a function of the samples, to first order about `at`."""
    weight = tape.weight / scale[:, None]
    jacobian = jax.jacfwd(outputs)(at, tape) * weight[..., None]
    J = jax.lax.stop_gradient(jacobian.reshape(-1, at.size))
    residual = ((measured - outputs(at, tape)) * weight).reshape(-1)
    return at + jnp.linalg.solve(J.T @ J, J.T @ residual)


def main() -> None:
    """Identify, differentiate, check, print."""
    runs = [read_recording(SAMPLE / f"{name}.csv") for name in RUNS]
    found = identify(runs)
    noise = np.array([found.noise["current_A"], found.noise["speed_rad_s"]], float)
    with jax.enable_x64(True):
        tape = jax.tree.map(jnp.asarray, Tape.from_recordings([on_even_clock(run) for run in runs]))
        at = jnp.log(jnp.asarray([float(getattr(found.motor, n)) for n in PARAMETERS]))
        nominal, scale = motor_of(at), jnp.asarray(noise)

        def chain(measured):
            return loop_metrics(estimate(measured, at, tape, scale), nominal)

        by_data = np.asarray(jax.jacrev(chain)(tape.measured))  # the one line
        by_estimate = np.asarray(jax.jacfwd(loop_metrics)(at, nominal))
        report(found, np.asarray(at), by_estimate, by_data, tape)
        check(chain, tape, by_data)


def report(found, at, by_estimate, by_data, tape: Tape) -> None:
    """The effect of each parameter's uncertainty, and of each recording, on the metrics."""
    console = Console(width=110)
    covariance = np.asarray(found.covariance)
    shown = Table(title="What uncertainty of each parameter costs the loop")
    for heading in ("", "value", "overshoot, % per unit", "settling, s per unit"):
        shown.add_column(heading, justify="right")
    shown.add_column("overshoot, % per standard error", justify="right")
    for k, name in enumerate(PARAMETERS):
        value = np.exp(at[k])
        per_unit = by_estimate[:, k] / value
        cells = [f"{value:.5g}", f"{per_unit[0]:.4g}", f"{per_unit[1]:.4g}"]
        shown.add_row(name, *cells, f"{by_estimate[0, k] * np.sqrt(covariance[k, k]):.2g}")
    console.print(shown)
    spread = np.sqrt(np.einsum("mi,ij,mj->m", by_estimate, covariance, by_estimate))
    console.print(f"All together: overshoot +- {spread[0]:.2g} %, settling +- {1e3 * spread[1]:.2g} ms.")
    sizes = np.sqrt((by_data**2).sum(axis=(3,)))
    for r, name in enumerate(RUNS):
        mine = np.asarray(tape.run) == r
        current, speed = np.sqrt((sizes[0][mine] ** 2).sum(axis=0))
        console.print(
            f"Overshoot by the samples of {name}: {current:.2g} % per A, {speed:.2g} % per rad/s (root sum of squares)"
        )


def check(chain, tape: Tape, by_data) -> None:
    """The gradient by the data along a random direction, against a central difference."""
    direction = np.random.default_rng(0).standard_normal(tape.measured.shape)
    step = 1e-5
    moved = [np.asarray(chain(tape.measured + s * step * direction)) for s in (1, -1)]
    difference = (moved[0] - moved[1]) / (2 * step)
    gradient = np.einsum("mbcs,bcs->m", by_data, direction)
    error = np.abs(gradient / difference - 1).max()
    Console().print(f"Against finite differences of the whole chain: {error:.1e} relative.")


if __name__ == "__main__":
    main()
