"""Complete identifications, ours beside scripts: `python -m benchmarks.identify_end_to_end`.

Seven runs, 33,000 samples, from one random motor; every method fits all seven. `solving` is the
median of interleaved repeats in one warm process, `first` the first call there, and `process` a
fresh interpreter that reads the seven CSV files, identifies and exits, with warm caches on disk.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

# only what all methods need: the fresh processes below include the time of their own imports
from benchmarks.timing import Row, Timed, interleaved, machine

ROOT = Path(__file__).parents[1]
Runs = Mapping[str, Mapping[str, np.ndarray]]


def read(folder: Path) -> Runs:
    """The columns of every CSV file of a folder."""
    runs = {}
    for path in sorted(folder.glob("*.csv")):
        with path.open(encoding="utf-8") as lines:
            header = next(lines).strip().split(",")
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        runs[path.stem] = dict(zip(header, table.T, strict=True))
    return runs


def ours(runs: Runs) -> dict[str, float]:
    """`pmdc_jax.identify`."""
    import pmdc_jax
    from pmdc_jax.recordings.recording import Recording

    def recording(name, c):
        signals = (c[n] for n in ("time_s", "voltage_V", "current_A", "speed_rad_s"))
        return Recording(name, *signals, load=c["load_torque_Nm"])

    recordings = [recording(name, columns) for name, columns in runs.items()]
    result = pmdc_jax.identify(recordings, holdout=[], seed=0)
    return {name: estimate.value for name, estimate in result.parameters.items()}


def script(runs: Runs) -> dict[str, float]:
    """The hand-written numba script with its own Levenberg-Marquardt."""
    from benchmarks.peers.scipy_identify import identify

    return identify(list(runs.values()))


def script_least_squares(runs: Runs) -> dict[str, float]:
    """The same under scipy `least_squares`."""
    from benchmarks.peers.scipy_identify import identify_by_least_squares

    return identify_by_least_squares(list(runs.values()))


WAYS: dict[str, Callable[[Runs], dict[str, float]]] = {
    "script": script,
    "script-least-squares": script_least_squares,
    "ours": ours,
}
NAMES = {
    "script": "numba script, own LM",
    "script-least-squares": "numba script, scipy least_squares",
    "ours": "pmdc_jax.identify",
}


@cache
def truth():
    """The random motor of which the runs are."""
    from benchmarks import virtual_bench as vb

    return vb.drawn_motor(np.random.default_rng(0))


def write_runs(folder: Path) -> None:
    """Record the standard case into CSV files."""
    from benchmarks import virtual_bench as vb

    for name, columns in vb.standard_runs(np.random.default_rng(1), truth()).items():
        vb.write_csv(folder / f"{name}.csv", columns)


def process_seconds(way: str, folder: Path, repeats: int = 3) -> float:
    """Median wall time of a fresh interpreter, after one that fills the caches on disk."""
    command = [sys.executable, "-m", __spec__.name, way, str(folder)]

    def once() -> float:
        begin = perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        return perf_counter() - begin

    once()
    return median(once() for _ in range(repeats))


def worst_error_percent(found: Mapping[str, float]) -> float:
    """Largest relative error of a parameter."""
    return 100 * max(abs(value / getattr(truth(), name) - 1) for name, value in found.items())


def table(timings: list[Timed], processes: list[float]) -> Table:
    """Seconds of each method, relative to the script, and its largest error."""
    shown = Table(title="Whole identification, 7 runs, 33,000 samples", caption=machine())
    shown.add_column("way")
    for heading in ("solving s", "x script", "first s", "process s", "worst parameter error %"):
        shown.add_column(heading, justify="right")
    for timed, process in zip(timings, processes, strict=True):
        ratio = timed.seconds / timings[0].seconds
        cells = (f"{timed.seconds:.3f}", f"{ratio:.1f}", f"{timed.first:.2f}", f"{process:.2f}")
        shown.add_row(timed.row.name, *cells, f"{worst_error_percent(timed.result):.3f}")
    return shown


def row(way: str, runs: Runs) -> Row:
    """One method as a row of the table."""
    return Row(NAMES[way], lambda: WAYS[way](runs), repeats=5)


def main() -> None:
    """Measure and print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_runs(folder)
        runs = read(folder)
        timings = interleaved([row(way, runs) for way in WAYS])
        processes = [process_seconds(way, folder) for way in WAYS]
    Console(width=110).print(table(timings, processes))


if __name__ == "__main__":
    if len(sys.argv) > 1:  # the fresh process of `process_seconds`
        print(WAYS[sys.argv[1]](read(Path(sys.argv[2]))))
    else:
        main()
