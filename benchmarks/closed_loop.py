"""Closed-loop simulations per second: `python -m benchmarks.closed_loop`.

1,024 PID loops of the paper's motor, 200 samples of 1 ms with a sample of delay, saturation and
back-calculation, double precision. Ours beside the same law in numba (with threads, and vectorised
where LLVM can); beside `control.forced_response`, compared without limits because it has none; and
beside the motor of gym-electric-motor, which has one constant for torque and back-EMF.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import virtual_bench as vb
from benchmarks.peers import closed_loop as peers
from benchmarks.timing import Row, interleaved, machine
from pmdc_jax.control import PID, Course, Hardware, Law, closed_loop
from pmdc_jax.control.law import SampledMotor
from pmdc_jax.motor import PARAMETERS, Motor

LOOPS = 1024  # simulated in one call
SAMPLES = 200  # of each
STEP = 1e-3  # sample time, s
SETPOINT = 481.0  # rad/s
VOLTS = 30.0  # limit of the voltage, V
UNLIMITED = 1e6  # V, which no loop reaches
MOTOR = Motor(**{name: getattr(vb.paper_motor(), name) for name in PARAMETERS})
ONE_CONSTANT = eqx.tree_at(lambda motor: motor.Kt, MOTOR, MOTOR.Kb)


def gains(count: int = LOOPS) -> np.ndarray:
    """Kp, Ki, Kd, filter time, set-point weight, tracking time, drawn about a good PID."""
    rng = np.random.default_rng(0)
    middle = np.array([0.2, 10.0, 3e-4, 1e-3, 1.0, 0.02])
    return middle * np.exp(0.3 * rng.standard_normal((count, 6)))


def motion() -> np.ndarray:
    """The exact step of the motor, (2, 3)."""
    with jax.enable_x64(True):
        model = SampledMotor.of(jax.tree.map(jnp.asarray, MOTOR), STEP)
        return np.array([[model.ii, model.iw, model.iv], [model.wi, model.ww, model.wv]], float)


@jax.jit
def _ours(motor, table, volts):
    model = SampledMotor.of(motor, STEP)
    course = Course(jnp.full(SAMPLES, SETPOINT), jnp.zeros(SAMPLES), jnp.zeros(SAMPLES))

    def one(row):
        kp, ki, kd, filter_time, weight, tracking = row
        controller = PID(kp, ki, kd, filter_time, weight, tracking)
        law = Law(controller, Hardware(STEP, volts, None, None, 1), model)
        speed = closed_loop(motor, law, course).speed
        return jnp.stack([speed[-1], speed.max()])

    return jax.vmap(one)(table)


def ours(count: int = LOOPS, volts: float = VOLTS, motor: Motor = MOTOR) -> Row:
    """Our loop, vmapped over gains."""
    with jax.enable_x64(True):
        table = jnp.asarray(gains(count))
        motor = jax.tree.map(jnp.asarray, motor)

    def run():
        with jax.enable_x64(True):
            return np.asarray(_ours(motor, table, volts))

    limited = "" if volts < UNLIMITED else ", no limit"
    return Row(f"ours{limited}, {count:,}", run, count)


def numba(count: int = LOOPS, volts: float = VOLTS) -> Row:
    """The same in numba."""
    given, moved = gains(count), motion()

    def run():
        return peers.numba_speeds(given, moved, SETPOINT, volts, STEP, SAMPLES - 1)

    return Row(f"numba, {count:,}", run, count)


def python_control(count: int = 32) -> Row:
    """`control.forced_response`, one loop after another."""
    given, moved = gains(count), motion()

    def run():
        return peers.control_speeds(given, moved, SETPOINT, STEP, SAMPLES)

    return Row(f"control.forced_response, no limit, {count:,}", run, count, 3)


def gym_electric_motor(count: int = 32) -> Row:
    """The same law around gym-electric-motor's PMDC motor, one loop after another."""
    given, motor = gains(count), {name: float(getattr(ONE_CONSTANT, name)) for name in PARAMETERS}

    def run():
        return peers.gym_speeds(given, motor, SETPOINT, VOLTS, STEP, SAMPLES - 1)

    return Row(f"gym-electric-motor, {count:,}", run, count, 3)


def table(title: str, rows: list[Row]) -> Table:
    """Loops per second, time relative to the first row, and the largest difference of the peak speeds."""
    timings = interleaved(rows)
    shown = Table(title=title, caption=machine())
    shown.add_column("way, loops")
    for heading in ("loops / s", "x first row", "first call s", "difference rad/s"):
        shown.add_column(heading, justify="right")
    best = timings[0]
    for timed in timings:
        count = min(len(timed.result), len(best.result))
        difference = np.abs(timed.result[:count, 1] - best.result[:count, 1]).max()
        shown.add_row(
            timed.row.name,
            f"{1e6 / timed.microseconds_per_unit:,.0f}",
            f"{timed.microseconds_per_unit / best.microseconds_per_unit:,.1f}",
            f"{timed.first:.2f}",
            f"{difference:.0e}",
        )
    return shown


def main() -> None:
    """Measure and print."""
    console = Console(width=110)
    console.print(table("PID on 30 V", [numba(), ours()]))
    console.print(table("Without limits", [ours(volts=UNLIMITED), python_control()]))
    console.print(table("Kt = Kb, 30 V", [ours(motor=ONE_CONSTANT), gym_electric_motor()]))


if __name__ == "__main__":
    main()
