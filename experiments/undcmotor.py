"""How well does the linear motor reproduce the speed of a laboratory motor from its voltage?

`python -m experiments.undcmotor`; data: see experiments/data.py.

PRBS record at 50 Hz, volts and deg/s, no current. Identified on its first half; the second half is
simulated in free run from its first sample, with the load of the first half. Without current only
the gain, natural frequency and damping are identifiable: three numbers for six parameters. The owners
fit a delay of 20 ms; the linear motor has none, and too large an L compensates for it.
"""

from typing import NamedTuple

import attrs
import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.data import data_file
from pmdc_jax import Identification, Recording, identify, simulate

DEGREE = np.pi / 180


class Fit(NamedTuple):
    """A fit, and the error on the second half of an equivalent model in the README of the data."""

    name: str
    options: dict
    peer: str
    peer_rmse: float  # deg/s


FITS = (
    Fit("unloaded", {"unloaded": True}, "first order", 19.8),
    Fit("unknown constant load", {}, "first order + offset", 14.8),
)


def halves() -> tuple[Recording, Recording]:
    """The first and the second half of the PRBS record."""
    path = data_file("undcmotor", "DCmotor_prbs_open_exp.csv")
    time, voltage, speed = np.loadtxt(path, delimiter=",", skiprows=1).T
    middle = len(time) // 2
    parts = (("first half", slice(middle)), ("second half", slice(middle, None)))
    return tuple(Recording(n, time[s], voltage[s], speed=speed[s] * DEGREE) for n, s in parts)


def ours(fit: Fit) -> Identification:
    """Identified from the first half only."""
    return identify([halves()[0]], **fit.options)


def simulated(result: Identification, run: Recording) -> np.ndarray:
    """Speed in deg/s, in free run with the load that the identification found."""
    load = result.fit["first half"].load_offset or 0.0
    return simulate(result.motor, attrs.evolve(run, load=np.full(len(run), load))).speed / DEGREE


def rmse(result: Identification, run: Recording) -> float:
    """Root mean square error of the free run, deg/s."""
    return float(np.sqrt(np.mean((run.speed / DEGREE - simulated(result, run)) ** 2)))


def table(results: dict[str, Identification]) -> Table:
    """Errors of the free run beside those of first-order models."""
    shown = Table(title="UNDCMotor: free-run error of speed, deg/s")
    for heading in ("ours", "first half", "second half", "peer", "second half, peer"):
        shown.add_column(heading, justify="left" if heading in ("ours", "peer") else "right")
    for fit in FITS:
        errors = (f"{rmse(results[fit.name], run):.1f}" for run in halves())
        shown.add_row(fit.name, *errors, fit.peer, f"{fit.peer_rmse:.1f}")
    return shown


def _load(result: Identification) -> str:
    load = result.fit["first half"].load_offset
    return "" if load is None else f"; load {load:.3g} N m"


def unseen(name: str, result: Identification) -> str:
    """The parameters that the record does not determine, and why."""
    status = ", ".join(f"{n} {e.status}" for n, e in result.parameters.items())
    reasons = (f"  {', '.join(d.parameters)}: {d.why}. {d.mend}." for d in result.unidentified_directions)
    return "\n".join((f"{name}: {status}{_load(result)}", *reasons))


def seen(name: str, result: Identification) -> str:
    """Gain, natural frequency and damping, which the record determines."""
    numerators, denominator = result.motor.transfer_function()
    gain = float(numerators["voltage -> speed"][0] / denominator[2]) / DEGREE
    inertial, resistive, stiff = (float(c) for c in denominator)
    frequency, damping = np.sqrt(stiff / inertial), resistive / 2 / np.sqrt(inertial * stiff)
    return f"{name}: {gain:.1f} deg/s per V, {frequency:.1f} rad/s, damping ratio {damping:.2f}"


def picture(results: dict[str, Identification]):
    """Measured and simulated speed on a stretch of the second half, and the errors."""
    from experiments.figures import panels, save

    run = halves()[1]
    shown = slice(500, 900)
    figure, (above, below) = panels(2, 2.8, sharex=True)
    above.plot(run.time[shown], run.speed[shown] / DEGREE, "0.6", lw=3, label="measured")
    for fit in FITS:
        speed = simulated(results[fit.name], run)
        above.plot(run.time[shown], speed[shown], lw=1, label=fit.name)
        below.plot(run.time[shown], (run.speed / DEGREE - speed)[shown], lw=1)
    above.set(ylabel="speed [deg/s]", title="Second half of the PRBS record, free run")
    above.set_ylim(170, 470)
    above.legend(ncols=3, loc="upper center")
    below.set(xlabel="time [s]", ylabel="error [deg/s]")
    return save(figure, "undcmotor")


def main() -> None:
    """Make both fits, print, draw."""
    results = {fit.name: ours(fit) for fit in FITS}
    console = Console(width=120)
    console.print(table(results))
    for fit in FITS:
        console.print(seen(fit.name, results[fit.name]))
        console.print(unseen(fit.name, results[fit.name]))
    console.print(f"Picture: {picture(results)}")


if __name__ == "__main__":
    main()
