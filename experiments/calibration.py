"""Do 95 % intervals contain the truth in 95 of 100 cases, in white and in coloured noise?

`python -m experiments.calibration [--repeats 200] [--noise white fast slow]`

The paper's motor, recorded repeatedly by the virtual bench with the same excitations (six of the
standard runs); only the noise differs. Torque noise is an Ornstein-Uhlenbeck process of
0.02 N m with a correlation time of 0.02 s (fast) or 0.2 s (slow). Every repeat is identified from
scratch with default options. The standard error of a coverage of 95 % in 200 repeats is 1.5 %.
"""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy import stats

from benchmarks import virtual_bench as vb
from experiments.bench import recording
from pmdc_jax import Recording, identify

NOISES = {
    "white": vb.Noise(),
    "fast": vb.Noise(torque_Nm=0.02, torque_correlation_s=0.02),
    "slow": vb.Noise(torque_Nm=0.02, torque_correlation_s=0.2),
}
MOTOR = vb.paper_motor()
TRUTH = np.array([getattr(MOTOR, name) for name in vb.SIX])


class Repeats(NamedTuple):
    """Estimates of each repeat, (repeats, 6)."""

    value: NDArray
    stderr: NDArray
    low: NDArray
    high: NDArray
    seconds: NDArray  # (repeats,)


def excitations() -> dict[str, vb.Excitation]:
    """The standard runs without the one for hold-out."""
    runs = vb.standard_excitations(np.random.default_rng(7))
    return {name: excitation for name, excitation in runs.items() if name != "drive"}


def recordings(noise: vb.Noise, repeats: int) -> Iterator[list[Recording]]:
    """The recordings of each repeat; without torque noise the motion is simulated only once."""
    runs = excitations()
    still = {name: vb.simulate(MOTOR, excitation) for name, excitation in runs.items()}
    for repeat in range(repeats):
        rng = np.random.default_rng([11, repeat])
        yield [
            recording(name, vb.record(MOTOR, excitation, rng, noise))
            if noise.torque_Nm
            else _measured(name, excitation, still[name], rng, noise)
            for name, excitation in runs.items()
        ]


def _measured(name, excitation, states, rng, noise) -> Recording:
    current = states[:, 0] + noise.current_A * rng.standard_normal(len(states))
    speed = states[:, 1] + noise.speed_rad_s * rng.standard_normal(len(states))
    time, voltage, load = excitation
    return Recording(name, time, voltage, current, speed, load=load)


def study(noise: vb.Noise, repeats: int) -> Repeats:
    """Identify every repeat from scratch."""
    rows, seconds = [], []
    progress = {"console": Console(stderr=True), "transient": True, "total": repeats}
    for runs in track(recordings(noise, repeats), **progress):
        found = identify(runs)
        estimates = [found.parameters[name] for name in vb.SIX]
        rows.append([(e.value, e.stderr, *e.ci95) for e in estimates])
        seconds.append(found.seconds["total"])
    return Repeats(*np.moveaxis(np.array(rows), -1, 0), np.array(seconds))


def table(studies: dict[str, Repeats]) -> Table:
    """Coverage, and standard error over actual scatter, of every parameter in every noise."""
    shown = Table(title="Coverage of 95 % intervals, %; claimed standard error / actual scatter")
    for heading in ("noise", "repeats", "", *vb.SIX, "all"):
        shown.add_column(heading, justify="right")
    for name, s in studies.items():
        inside = (s.low <= TRUTH) & (s.high >= TRUTH)
        coverage = 100 * inside.mean(0)
        ratio = s.stderr.mean(0) / s.value.std(0, ddof=1)
        bias = (s.value.mean(0) - TRUTH) / s.value.std(0, ddof=1)
        rows = {
            "coverage": (*(f"{c:.1f}" for c in coverage), f"{coverage.mean():.1f}"),
            "ratio": (*(f"{r:.2f}" for r in ratio), f"{ratio.mean():.2f}"),
            "bias / scatter": (*(f"{b:+.2f}" for b in bias), ""),
            "scatter, %": (*(f"{x:.3f}" for x in 100 * s.value.std(0, ddof=1) / TRUTH), ""),
        }
        for k, (what, cells) in enumerate(rows.items()):
            first = (name, str(len(s.value))) if k == 0 else ("", "")
            shown.add_row(*first, what, *cells, end_section=k == len(rows) - 1)
    return shown


def picture(studies: dict[str, Repeats]):
    """Coverage by parameter and noise, with the band in which correct intervals are by chance."""
    from experiments.figures import panels, save

    figure, axes = panels(1, 3.2)
    count = min(len(s.value) for s in studies.values())
    band = 100 * stats.binom.ppf([0.025, 0.975], count, 0.95) / count
    axes.axhspan(*band, color="0.9", label=f"95 % of right ones, {count} repeats")
    for k, (name, s) in enumerate(studies.items()):
        inside = 100 * ((s.low <= TRUTH) & (s.high >= TRUTH)).mean(0)
        axes.plot(np.arange(6) + 0.12 * (k - 1), inside, "o", label=name)
    axes.set_xticks(range(6), vb.SIX)
    axes.set(ylabel="coverage [%]", title="Coverage of 95 % intervals")
    axes.margins(y=0.15)
    axes.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    return save(figure, "calibration")


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--noise", nargs="+", choices=list(NOISES), default=list(NOISES))
    options = parser.parse_args()
    studies, console = {}, Console(width=130)
    for name in options.noise:
        studies[name] = study(NOISES[name], options.repeats)
        console.print(table({name: studies[name]}))
        console.print(f"Median time of one identification: {np.median(studies[name].seconds):.2f} s")
    console.print(f"Picture: {picture(studies)}")


if __name__ == "__main__":
    main()
