"""What do logs without load identify, alone and with the tie Kt = Kb?

`python -m experiments.unloaded`

Staircase, PRBS and slow triangle of the virtual bench, without load and declared as such. Two motors:
the paper's with Kt = Kb, and the paper's as printed, whose Kt is 1.8 % above its Kb.
"""

from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import virtual_bench as vb
from experiments.bench import acceptance_runs, record_all
from pmdc_jax import Identification, Recording, identify

FREE = ("staircase", "prbs", "triangle")
TIE = [("Kt", "Kb")]


def motors() -> dict[str, vb.BenchMotor]:
    """Both true motors."""
    paper = vb.paper_motor()
    return {"Kt = Kb": replace(paper, Kt=paper.Kb), "as printed": paper}


def recordings(motor: vb.BenchMotor) -> list[Recording]:
    """The unloaded logs, without a load column."""
    rng = np.random.default_rng(5)
    runs = {name: e for name, e in acceptance_runs(rng).items() if name in FREE}
    return record_all(motor, runs, rng, vb.Noise(), load_known=False)


def _cells(motor: vb.BenchMotor, result: Identification, name: str) -> tuple[str, str, str]:
    estimate = result.parameters[name]
    error = 100 * (estimate.value / getattr(motor, name) - 1)
    claimed = f"± {100 * estimate.stderr / estimate.value:.3f}" if estimate.stderr else "unknown"
    return estimate.status, f"{error:+.3f}", claimed


def table(name: str, motor: vb.BenchMotor, alone: Identification, tied: Identification) -> Table:
    """Status, error and standard error of every parameter, alone and with the tie."""
    shown = Table(title=f"Unloaded logs, motor {name}: errors in %")
    for heading in ("", "alone", "error", "claimed", "tied", "error", "claimed"):
        shown.add_column(heading, justify="right" if heading in ("error", "claimed") else "left")
    for parameter in vb.SIX:
        cells = (_cells(motor, result, parameter) for result in (alone, tied))
        shown.add_row(parameter, *(cell for three in cells for cell in three))
    return shown


def ratios(motor: vb.BenchMotor, result: Identification) -> str:
    """Errors of the ratios of Kt, J and f, which logs without load identify."""
    value = {name: estimate.value for name, estimate in result.parameters.items()}
    pairs = (("J", "Kt"), ("f", "Kt"))
    errors = (
        f"{a}/{b} {100 * (value[a] / value[b] / (getattr(motor, a) / getattr(motor, b)) - 1):+.3f} %" for a, b in pairs
    )
    return f"Ratios, alone: {', '.join(errors)}"


def main() -> None:
    """Identify both motors alone and tied; print."""
    console = Console(width=110)
    for name, motor in motors().items():
        runs = recordings(motor)
        alone = identify(runs, unloaded=True)
        tied = identify(runs, unloaded=True, tie=TIE)
        console.print(table(name, motor, alone, tied))
        console.print(ratios(motor, alone))
        for d in alone.unidentified_directions:
            console.print(f"Alone, unseen: {', '.join(d.parameters)}: {d.why}. {d.mend}.")
        for message in alone.messages:
            console.print(f"Alone: {message}")


if __name__ == "__main__":
    main()
