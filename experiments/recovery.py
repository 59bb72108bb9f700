"""Are all parameters found within 3 standard errors and 1 %, whatever the motor? 20 drawn motors.

`python -m experiments.recovery [--motors 20] [--first 1000]`

Each motor is drawn about the paper's Table 1 (log-normal, 25 %) and recorded by the virtual bench:
staircase, PRBS, slow triangle, loaded, 60 s of load cycles, with current noise of 0.02 to 0.2 A and
speed noise of 0.1 to 1 rad/s. `identify` gets only the recordings. Of 120 correct estimates
with correct standard errors 0.3 lie beyond 3 by chance.
"""

import argparse
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy import stats

from benchmarks import virtual_bench as vb
from experiments.bench import acceptance_runs, record_all
from pmdc_jax import Identification, identify

ERRORS, PERCENT = 3.0, 1.0


class Case(NamedTuple):
    """One motor, the noise of its recordings, and the identification."""

    seed: int
    motor: vb.BenchMotor
    noise: vb.Noise
    found: Identification

    def percent(self, name: str) -> float:
        """Error of one parameter in %."""
        return 100 * (self.found.parameters[name].value / getattr(self.motor, name) - 1)

    def standard_errors(self, name: str) -> float:
        """Error of one parameter in its standard errors; infinite if it has none."""
        estimate = self.found.parameters[name]
        error = estimate.value - getattr(self.motor, name)
        return error / estimate.stderr if estimate.stderr else float("inf")

    @property
    def passed(self) -> bool:
        """Whether every parameter is within both limits."""
        return not any(self.misses(name) for name in vb.SIX)

    def misses(self, name: str) -> bool:
        """Whether this parameter is beyond either limit."""
        return abs(self.percent(name)) > PERCENT or abs(self.standard_errors(name)) > ERRORS


def drawn_noise(rng: np.random.Generator) -> vb.Noise:
    """Noise of a cheap to a good logger, log-uniform."""
    current, speed = np.exp(rng.uniform(np.log([0.02, 0.1]), np.log([0.2, 1.0])))
    return vb.Noise(current_A=float(current), speed_rad_s=float(speed))


def case(seed: int) -> Case:
    """Draw, record and identify one motor."""
    rng = np.random.default_rng(seed)
    motor, noise = vb.drawn_motor(rng), drawn_noise(rng)
    return Case(seed, motor, noise, identify(record_all(motor, acceptance_runs(rng), rng, noise)))


def table(cases: list[Case]) -> Table:
    """Error of every parameter of every motor: per cent, and standard errors in brackets."""
    shown = Table(title="Error of each parameter: % (in standard errors)")
    for heading in ("seed", "noise A, rad/s", *vb.SIX, "seconds", ""):
        shown.add_column(heading, justify="right")
    for c in cases:
        noise = f"{c.noise.current_A:.2f}, {c.noise.speed_rad_s:.2f}"
        errors = (_cell(c, name) for name in vb.SIX)
        verdict = "PASS" if c.passed else "[red]FAIL[/]"
        seconds = f"{c.found.seconds['total']:.1f}"
        shown.add_row(str(c.seed), noise, *errors, seconds, verdict)
    return shown


def _cell(c: Case, name: str) -> str:
    text = f"{c.percent(name):+.3f} ({c.standard_errors(name):+.1f})"
    return f"[red]{text}[/]" if c.misses(name) else text


def verdict(cases: list[Case]) -> str:
    """The number of motors that pass, and whether errors over standard errors are normally distributed."""
    z = np.array([c.standard_errors(name) for c in cases for name in vb.SIX])
    percent = np.array([c.percent(name) for c in cases for name in vb.SIX])
    expected = 2 * stats.norm.sf(ERRORS) * z.size
    return (
        f"{sum(c.passed for c in cases)} of {len(cases)} motors pass. "
        f"Beyond {ERRORS:.0f} standard errors: {np.sum(abs(z) > ERRORS)} of {z.size} "
        f"({expected:.1f} expected by chance); beyond {PERCENT:.0f} %: "
        f"{np.sum(abs(percent) > PERCENT)}. Largest: {abs(percent).max():.3f} %, "
        f"{abs(z).max():.2f} standard errors. Standard deviation of error / standard error: "
        f"{np.sqrt(np.mean(z**2)):.2f}. Unconverged: {sum(not c.found.converged for c in cases)}."
    )


def picture(cases: list[Case]):
    """All errors in standard errors, by parameter."""
    from experiments.figures import panels, save

    figure, axes = panels(1, 3.2)
    for k, name in enumerate(vb.SIX):
        z = [c.standard_errors(name) for c in cases]
        axes.plot(k + np.linspace(-0.25, 0.25, len(z)), z, "o", ms=4)
    for limit in (-ERRORS, ERRORS):
        axes.axhline(limit, color="0.4", ls="--", lw=1)
    axes.set_xticks(range(len(vb.SIX)), vb.SIX)
    axes.set(ylabel="error / standard error", title=f"{len(cases)} drawn motors", ylim=(-4.5, 4.5))
    return save(figure, "recovery")


def main() -> None:
    """Run the study and print table and verdict."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first motor")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.motors)
    console = Console(width=140)
    cases = [case(seed) for seed in track(seeds, console=Console(stderr=True), transient=True)]
    console.print(table(cases))
    console.print(verdict(cases))
    console.print(f"Picture: {picture(cases)}")


if __name__ == "__main__":
    main()
