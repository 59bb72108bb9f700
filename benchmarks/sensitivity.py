"""Residuals with all sensitivities of one motor beside one simulation: `python -m benchmarks.sensitivity`.

26,000 samples of the standard case, six parameters and each run's own unknowns, double precision. "One
simulation" is the fastest of ours for one motor, `free_run`; beside it the same motor under scipy `lfilter`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import virtual_bench as vb
from benchmarks.peers import scipy_lfilter
from benchmarks.peers.held import Run
from benchmarks.timing import Row, interleaved, machine

NAMES = ("R", "L", "Kb", "Kt", "J", "f")


def main() -> None:
    """Print the table."""
    with jax.enable_x64(True):
        timings = interleaved(_rows())
    shown = Table(title="One motor, 26,000 samples, six parameters", caption=machine())
    for heading in ("way", "ms", "x one simulation", "first call s"):
        shown.add_column(heading, justify="left" if heading == "way" else "right")
    simulation = next(t.seconds for t in timings if t.row.name == "one simulation")
    for timed in timings:
        ratio = timed.seconds / simulation
        cells = (f"{1e3 * timed.seconds:.2f}", f"{ratio:.1f}", f"{timed.first:.2f}")
        shown.add_row(timed.row.name, *cells)
    Console(width=120).print(shown)


def _rows() -> list[Row]:
    from pmdc_jax.motor import Motor
    from pmdc_jax.recordings.recording import Recording
    from pmdc_jax.simulate import Tape, free_run, sensitivities

    truth = vb.paper_motor()
    runs = vb.standard_runs(np.random.default_rng(0), truth, all_at_1_ms=True)
    columns = {name: c for name, c in list(runs.items()) if name != "load_cycles"}
    recordings = [
        Recording(name, c["time_s"], c["voltage_V"], c["current_A"], c["speed_rad_s"], c["load_torque_Nm"])
        for name, c in columns.items()
    ]
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings(recordings))
    values = np.array([getattr(truth, name) for name in NAMES])
    motor = Motor(*(jnp.asarray(v) for v in values))
    logarithms = jnp.log(jnp.asarray(values))

    def assemble(logarithms):
        return Motor(*jnp.exp(logarithms))

    def one_simulation():
        return jax.block_until_ready(free_run(motor, tape))

    def with_sensitivities():
        return jax.block_until_ready(sensitivities(assemble, logarithms, tape))

    def filtered():
        return [scipy_lfilter.squared_errors(values[None], Run.of(c)) for c in columns.values()]

    return [
        Row("one simulation", one_simulation),
        Row("with all sensitivities", with_sensitivities),
        Row("scipy lfilter, errors alone", filtered),
    ]


if __name__ == "__main__":
    main()
