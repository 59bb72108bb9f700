"""Is a real axis, EMPS, identified by its mechanical half as well as by the published least squares?

`python -m experiments.emps`; data: see experiments/data.py.

EMPS is a brushed motor on a ball screw, position-controlled, with force (drive gain times control
signal) and position at 1 kHz. Mass stands for J, N for N m, m for rad. We estimate in free-run
simulation of speed from the recorded force; the published estimates minimise the error of force in
the inverse dynamic model F = M a + Fv v + Fc sign(v) + offset on filtered, differentiated position.
Both are compared by the latter, 100 |e| / |F|, which is computed here for plain least squares, too.
"""

from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.io import loadmat
from scipy.signal import butter, decimate, filtfilt

from experiments.data import data_file
from pmdc_jax import Identification, Recording, identify

ESTIMATION, VALIDATION = "DATA_EMPS", "DATA_EMPS_PULSES"
TERMS = ("M", "Fv", "Fc", "offset")
UNITS = {"M": "kg", "Fv": "N s/m", "Fc": "N", "offset": "N"}
PUBLISHED = dict(zip(TERMS, (95.109, 203.50, 20.39, -3.165), strict=True))
CUTOFF_HZ, DECIMATION, TRIM = (100.0, 10, 50)  # as in the published method, whose numbers they reproduce
COULOMB = "coulomb_friction.torque_Nm"


class Fit(NamedTuple):
    """A fit: its options, and the terms of the equivalent plain least squares."""

    name: str
    options: dict
    terms: tuple[str, ...]


FITS = (
    Fit("viscous only", {"unloaded": True}, ("M", "Fv")),
    Fit("viscous + offset", {}, ("M", "Fv", "offset")),
    Fit("Coulomb + offset", {"effects": ["coulomb_friction"]}, TERMS),
)


def record(name: str) -> Recording:
    """One record; `gtau * vir` is the total force, including the pulses in `pulses_N`."""
    columns = loadmat(data_file("emps", f"{name}.mat"))
    force = columns["gtau"].item() * columns["vir"].ravel()
    return Recording(name, columns["t"].ravel(), torque=force, angle=columns["qm"].ravel())


def motion(run: Recording) -> np.ndarray:
    """Acceleration and speed, (2, samples), from the position filtered without phase shift."""
    low_pass = butter(4, 2 * CUTOFF_HZ * run.sample_time)
    speed = np.gradient(filtfilt(*low_pass, run.angle), run.sample_time)
    return np.stack([np.gradient(speed, run.sample_time), speed])


def inverse_dynamics(run: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Regressors (samples, 4) by `TERMS`, and force (samples,), both decimated."""
    acceleration, speed = motion(run)
    regressors = np.stack([acceleration, speed, np.sign(speed), np.ones_like(speed)], 1)
    kept = slice(TRIM, -TRIM)
    return tuple(decimate(x[kept], DECIMATION, axis=0) for x in (regressors, run.torque))


def force_error(run: Recording, estimate: dict[str, float]) -> float:
    """100 |e| / |F| of the inverse dynamic model."""
    regressors, force = inverse_dynamics(run)
    error = force - regressors @ [estimate.get(term, 0.0) for term in TERMS]
    return float(100 * np.linalg.norm(error) / np.linalg.norm(force))


def least_squares(run: Recording, terms: tuple[str, ...]) -> dict[str, float]:
    """Plain least squares on the inverse dynamic model."""
    regressors, force = inverse_dynamics(run)
    columns = [TERMS.index(term) for term in terms]
    solution = np.linalg.lstsq(regressors[:, columns], force, rcond=None)[0]
    return dict(zip(terms, solution.tolist(), strict=True))


def thinned(run: Recording, every: int) -> Recording:
    """One sample in `every`: force averaged while held, speed filtered without phase shift."""
    whole = len(run) // every * every
    force = run.torque[:whole].reshape(-1, every).mean(1)
    kept = slice(0, whole, every)
    return Recording(run.name, run.time[kept], torque=force, speed=motion(run)[1][kept])


def ours(fit: Fit, every: int = 1) -> Identification:
    """The estimate of the package with the validation record held out; optionally from thinned records."""
    runs = [record(name) for name in (ESTIMATION, VALIDATION)]
    if every > 1:
        runs = [thinned(run, every) for run in runs]
    return identify(runs[:1], runs[1:], **fit.options)


def estimate_of(result: Identification) -> dict[str, float]:
    """Our parameters by the names of the inverse dynamic model."""
    names = {"M": "J", "Fv": "f", "Fc": COULOMB}
    found = result.parameters
    values = {term: found[name].value for term, name in names.items() if name in found}
    return values | {"offset": result.fit[ESTIMATION].load_offset or 0.0}


def _cell(result: Identification, term: str) -> str:
    value = estimate_of(result).get(term)
    if value is None or (term == "offset" and not value):
        return "-"
    if term == "offset":
        return f"{value:.3f}"
    interval = result.parameters[{"M": "J", "Fv": "f", "Fc": COULOMB}[term]].ci95
    return f"{value:.2f} [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else f"{value:.2f}"


def parameter_table(results: dict[str, Identification]) -> Table:
    """Ours with 95 % intervals beside the published least squares."""
    table = Table(title="EMPS: parameters, ours with 95 % intervals")
    table.add_column("")
    for heading in (*results, "published", "same, re-measured"):
        table.add_column(heading, justify="right")
    again = least_squares(record(ESTIMATION), TERMS)
    for term in TERMS:
        mine = [_cell(result, term) for result in results.values()]
        row = (f"{term} [{UNITS[term]}]".replace("[", r"\["), *mine)
        table.add_row(*row, f"{PUBLISHED[term]:.3f}", f"{again[term]:.3f}")
    return table


def error_table(results: dict[str, Identification]) -> Table:
    """Relative force errors of ours and of plain least squares, on both records."""
    runs = [record(ESTIMATION), record(VALIDATION)]
    table = Table(title="EMPS: relative force error, %, estimation / validation")
    for heading in ("model", "ours", "least squares", "our fit of free-run speed, %"):
        table.add_column(heading, justify="right" if heading != "model" else "left")
    for fit in FITS:
        result = results[fit.name]
        plain = least_squares(runs[0], fit.terms)
        errors = (
            " / ".join(f"{force_error(run, estimate):.2f}" for run in runs) for estimate in (estimate_of(result), plain)
        )
        speed = " / ".join(f"{result.fit[run.name].speed_fit_percent:.1f}" for run in runs)
        table.add_row(fit.name, *errors, speed)
    return table


def picture(results: dict[str, Identification]):
    """Free-run speed on the validation record, and the residual force of each model."""
    from experiments.figures import panels, save

    run = record(VALIDATION)
    figure, (above, below) = panels(2, 3.0)
    linear, coulomb = (results[name].fit[VALIDATION] for name in ("viscous + offset", FITS[2].name))
    shown = linear.time < 6.0
    above.plot(linear.time[shown], linear.speed[shown], "0.6", lw=3, label="measured")
    for fit, name in ((linear, FITS[1].name), (coulomb, FITS[2].name)):
        above.plot(fit.time[shown], fit.speed_simulated[shown], lw=1, label=name)
    above.set(xlabel="time [s]", ylabel="speed [m/s]", title="Validation record, free run")
    above.legend(ncols=3, loc="upper center")
    above.set_ylim(-0.2, 0.22)
    regressors, force = inverse_dynamics(run)
    for name in (FITS[1].name, FITS[2].name):
        estimate = estimate_of(results[name])
        error = force - regressors @ [estimate.get(term, 0.0) for term in TERMS]
        below.plot(regressors[:, 1], error, ".", ms=3, label=name)
    below.set(xlabel="speed [m/s]", ylabel="force left [N]", title="What the models leave of force")
    below.set_ylim(-40, 55)
    below.legend(ncols=2, loc="upper center", markerscale=2)
    return save(figure, "emps")


def main() -> None:
    """Fit all, print both tables, draw."""
    results = {fit.name: ours(fit) for fit in FITS}
    console = Console(width=140)
    console.print(parameter_table(results))
    console.print(error_table(results))
    console.print(f"Picture: {picture(results)}")


if __name__ == "__main__":
    main()
