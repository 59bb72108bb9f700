"""Cost of a population of candidate motors on one record: `python -m benchmarks.population [--sizes 20 256 1024 8192]`.

2,000 samples at 1 ms, current and speed, double precision. Ours beside the peers in one run; the
ratio is to the numba roofline of the same number of candidates, or of the most. `error` is the
largest relative difference of a cost from the exact one; a solver with one explicit step per sample
has a large one if the motor is stiff. Ours runs on JAX's default device: an accelerator, if any.
"""

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks import virtual_bench as vb
from benchmarks.peers import diffrax_vmap, roofline, scipy_lfilter, scipy_solve_ivp
from benchmarks.peers.held import Run
from benchmarks.timing import Row, Timed, interleaved, machine
from pmdc_jax.effects import EFFECTS
from pmdc_jax.motor import Motor
from pmdc_jax.recordings.recording import Recording
from pmdc_jax.simulate import Tape, squared_errors

SIZES = (20, 256, 1024, 8192)
ROOFLINE = "numba exact step (roofline)"
COULOMB_NM, DROP_V, ALPHA, RTH, THERMAL_S = 0.05, 0.8, 0.0039, 3.0, 20.0


def columns() -> vb.Columns:
    """The record: known steps of the load together with steps of the voltage, in both directions."""
    rng = np.random.default_rng(0)
    return vb.record(vb.paper_motor(), vb.loaded(rng, duration=2.0), rng)


def candidates(count: int) -> NDArray[np.float64]:
    """Motors drawn about the paper's, shape (count, 6)."""
    rng = np.random.default_rng(1)
    paper = np.array([getattr(vb.paper_motor(), n) for n in vb.SIX])
    return paper * np.exp(0.25 * rng.standard_normal((count, 6)))


def recording(record: vb.Columns) -> Recording:
    """The same record as a recording of the package."""
    load = record.get("load_torque_Nm")
    signals = (record[n] for n in ("time_s", "voltage_V", "current_A", "speed_rad_s"))
    return Recording("bench", *signals, load=load)


def _our_motors(count: int, effects: bool) -> Motor:
    def of(value):
        return jnp.full(count, value)

    added = (
        EFFECTS["coulomb_friction"](torque_Nm=of(COULOMB_NM)),
        EFFECTS["brush_voltage_drop"](voltage_V=of(DROP_V)),
        EFFECTS["resistance_heating"](rise_per_W=of(ALPHA * RTH), time_constant_s=of(THERMAL_S)),
    )
    return Motor(*jnp.asarray(candidates(count)).T, effects=added if effects else ())


def _single_precision(tree):
    def narrowed(leaf):
        return leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(narrowed, tree)


def ours(count: int, effects: bool = False, double: bool = True) -> Row:
    """Our `squared_errors`."""
    with jax.enable_x64(True):
        tape = jax.tree.map(jnp.asarray, Tape.from_recordings([recording(columns())]))
        case = (_our_motors(count, effects), tape)
        motors, tape = case if double else _single_precision(case)

    def run():
        with jax.enable_x64(True):
            return np.array(jax.block_until_ready(squared_errors(motors, tape)))

    precision = "" if double else ", float32"
    return Row(f"ours{precision}, {count:,}", run, count)


def peer(name: str, cost, count: int, repeats: int = 9) -> Row:
    """A peer's cost of the first `count` candidates."""
    run, motors = Run.of(columns()), candidates(count)
    return Row(f"{name}, {count:,}", lambda: cost(motors, run), count, repeats)


def roofline_with_effects(count: int) -> Row:
    """Numba RK4 with friction and drop smoothed over 1 rad/s and 1 A."""
    run, motors = Run.of(columns()), candidates(count)
    constants = [COULOMB_NM, 1.0, DROP_V, 1.0, ALPHA, RTH, THERMAL_S]
    effects = np.tile(constants, (count, 1))
    cost = roofline.squared_errors_with_effects
    return Row(f"numba RK4 (roofline), {count:,}", lambda: cost(motors, effects, run), count)


def linear_rows(sizes: Sequence[int]) -> list[Row]:
    """The linear motor; the roofline of the largest population comes first."""
    *smaller, most = sizes
    return [
        *(peer(ROOFLINE, roofline.squared_errors, size) for size in (most, *smaller)),
        *(ours(size) for size in sizes),
        ours(most, double=False),
        peer("scipy lfilter", scipy_lfilter.squared_errors, 100),
        peer("diffrax Tsit5 under vmap, one step a sample", diffrax_vmap.squared_errors, 200, 3),
        peer("diffrax Tsit5 under vmap, 1e-6", diffrax_vmap.squared_errors_adaptive, 200, 3),
        peer("scipy solve_ivp RK45, 1e-6", scipy_solve_ivp.squared_errors, 1, 3),
    ]


def effects_rows(sizes: Sequence[int]) -> list[Row]:
    """With friction, brush drop and heating; ours has exact sticking, which the roofline smooths."""
    *smaller, most = sizes
    peers = [roofline_with_effects(size) for size in (most, *smaller)]
    return [*peers, *(ours(size, effects=True) for size in sizes)]


def table(title: str, timings: list[Timed], with_error: bool) -> Table:
    """Microseconds per candidate, ratio to the roofline, largest relative error of a cost."""
    shown = Table(title=title, caption=machine())
    shown.add_column("way, candidates")
    for heading in ("µs / candidate", "x roofline", "first call s", "error"):
        shown.add_column(heading, justify="right")
    best = timings[0]
    rooflines = {t.row.work: t for t in timings if "roofline" in t.row.name}
    for timed in timings:
        beside = rooflines.get(timed.row.work, best)
        cells = [
            f"{timed.microseconds_per_unit:,.2f}",
            f"{timed.microseconds_per_unit / beside.microseconds_per_unit:,.1f}",
            f"{timed.first:.2f}",
        ]
        count = min(timed.result.shape[1], best.result.shape[1])
        error = np.abs(timed.result[:, :count] / best.result[:, :count] - 1).max()
        shown.add_row(timed.row.name, *cells, f"{error:.0e}" if with_error else "-")
    return shown


def main() -> None:
    """Measure and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    sizes = sorted(parser.parse_args().sizes)
    console = Console(width=110)
    console.print(table("Linear motor", interleaved(linear_rows(sizes)), True))
    console.print(table("Friction, brush drop, heating", interleaved(effects_rows(sizes)), False))


if __name__ == "__main__":
    main()
