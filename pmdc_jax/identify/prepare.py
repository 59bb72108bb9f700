"""Checks recordings and lays them out as a least-squares problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from types import MappingProxyType
from typing import Any, NamedTuple

import attrs
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks.check import check
from ..checks.invalid_samples import without_unmeasured
from ..checks.slow_sensors import readings_only
from ..effects import EFFECTS, AbstractEffect
from ..errors import InputError
from ..motor import PARAMETERS, PARAMETERS_OF_DRIVE, Drive
from ..recordings.angle import angle_of_counts
from ..recordings.clock import evenly_stamped, is_even
from ..recordings.readings import reading_interval
from ..recordings.recording import NEEDED_TO_IDENTIFY, SIMULATED_OUTPUTS, Averaging, Finding, Recording
from ..recordings.recording_file import Runs, named_apart, recordings_of, refuse_copies
from ..simulate import ZERO_ORDER_HOLD, Tape, Timing, on_even_clock
from .identification import Role
from .noise.sensor_noise import white_noise
from .parameters import Parameters, check_names
from .problem import Problem
from .search.bounds import effect_magnitudes, search_bounds

# The outputs of a tape: current and speed, or speed alone
BOTH, SPEED = slice(None), slice(1, None)


class Prepared(NamedTuple):
    """Checked recordings, training runs first, and their least-squares problem."""

    runs: list[Recording]  # evenly sampled
    roles: list[Role]
    findings: tuple[Finding, ...]
    irrelevant: Mapping[str, float]  # parameters that affect no run, with a harmless value
    known: Mapping[str, float]
    ties: tuple[tuple[str, str], ...]
    magnitudes: Mapping[str, float]  # of the parameters of effects, by unit (see `effect_magnitudes`)
    problem: Problem
    # which runs have a speed computed from their angle
    differentiated: tuple[bool, ...] = ()
    # results of the corrections (see `corrections`):
    # outliers treated as missing, by names of run and output: how many, and how far off the farthest, A or rad/s
    outliers: Mapping[tuple[str, str], tuple[int, float]] = MappingProxyType({})
    # standard deviation of the noise removed from the drive, by name of the run
    input_noise: Mapping[str, float] = MappingProxyType({})
    # largest amplitude of the mains hum removed from an output, by name of the output
    mains_hum: Mapping[str, float] = MappingProxyType({})
    # how the recorded speeds are averaged, None if they are instantaneous
    averaging: Averaging | None = None
    timing: Timing = ZERO_ORDER_HOLD
    # whether steps of the voltages were placed between samples
    stepped: bool = False

    def with_problem(self, **fields: Any) -> Prepared:
        """The same runs with some fields of the problem replaced."""
        return self._replace(problem=replace(self.problem, **fields))

    def with_tape(self, **fields: Array | Drive | None) -> Prepared:
        """The same runs with some fields of the tape replaced."""
        return self.with_problem(tape=replace(self.problem.tape, **fields))

    def with_tape_of(self, runs: Sequence[Recording], *fields: str, **layout: Any) -> Prepared:
        """The same problem with these fields of the tape as other runs have them.

        **Arguments**: `layout`, as of `Tape.from_recordings`.
        """
        tape = Tape.from_recordings(runs, **layout)
        return self.with_tape(**jax.tree.map(jnp.asarray, {name: getattr(tape, name) for name in fields}))

    def without_ends(self, outputs: slice = BOTH) -> Prepared:
        """The same runs without the first and the last sample of some outputs, of a slow sensor without as many as from
        one reading to the next: there a mean, or a voltage that acts at another time, depends on what was not recorded.
        """
        tape = self.problem.tape
        weight = np.array(tape.weight)
        for k, run in enumerate(self.runs):
            first = int(np.argmax(tape.blocks_of(k)))
            interval = 1 if run.speed is None else reading_interval(~np.isnan(run.speed))
            for sample in (*range(interval), *range(len(run) - interval, len(run))):
                block, at = divmod(sample, weight.shape[2])
                weight[first + block, outputs, at] = 0.0
        return self.with_tape(weight=jnp.asarray(weight))

    @property
    def training(self) -> list[Recording]:
        """The training runs."""
        return [self.runs[k] for k in self.training_indices]

    @property
    def training_indices(self) -> list[int]:
        """The indices of the training runs."""
        return [k for k, role in enumerate(self.roles) if role == "train"]

    def parameters(
        self, effects: Sequence[type[AbstractEffect]], bounds: Mapping[str, tuple[float, float]] | None = None
    ) -> Parameters:
        """The parameters of a motor with these effects; `bounds` overrides those of the search and of the effects."""
        bounds = {**search_bounds(self.training), **(bounds or {})}
        return Parameters.of(bounds, effects, {**self.irrelevant, **self.known}, self.ties, self.magnitudes)

    def forms_of(self, effects: Sequence[str]) -> list[type[AbstractEffect]]:
        """The classes of some effects, by name: in the form in which they are fitted to these runs, if they are."""
        fitted = {effect.name: effect for effect in self.problem.parameters.effects}
        return [fitted.get(name, EFFECTS[name]) for name in effects]

    def with_effects(self, effects: Sequence[type[AbstractEffect]]) -> Prepared:
        """The same runs for a motor with other effects."""
        parameters = self.parameters(effects)
        return self.with_problem(parameters=parameters, free=parameters.all_free, whitening=None, shift=None)


def prepare(
    recordings: Runs,
    holdout: Runs,
    *,
    tie: Sequence[tuple[str, str]] = (),
    known: Mapping[str, float] | None = None,
    unloaded: bool = False,
    effects: Sequence[type[AbstractEffect]] = (),
) -> Prepared:
    """Check the recordings and lay them out; raises `InputError` where they cannot give an answer."""
    recordings, holdout = recordings_of(recordings), recordings_of(holdout)
    named = named_apart([*recordings, *holdout])
    refuse_copies(named)
    cleaned = [readings_only(run) for run in without_unmeasured(named)]
    roles: list[Role] = [*("train" for _ in recordings), *("holdout" for _ in holdout)]
    known = dict(known or {})
    _check_columns(cleaned, roles)
    _check_options(tie, known)
    findings = check(cleaned)
    _raise_errors(findings)
    stamped = [evenly_stamped(run) for run in cleaned]
    counted = [_with_counts_as_angle(run) for run in stamped]
    findings += tuple(_counted_note(run) for run, before in zip(counted, stamped, strict=True) if run is not before)
    prepared = _laid_out(counted, roles, findings, tie, known, unloaded).with_effects(effects)
    if not prepared.problem.parameters.names:
        raise InputError(
            "--known",
            "every parameter is known: nothing is left to identify",
            "Leave one out, for example R: its estimate then confirms or contradicts its known value",
        )
    return prepared


def _laid_out(
    recordings: Sequence[Recording],
    roles: list[Role],
    findings: tuple[Finding, ...],
    tie: Sequence[tuple[str, str]],
    known: Mapping[str, float],
    unloaded: bool,
) -> Prepared:
    """The recordings as a least-squares problem for the motor without effects, all of whose parameters are fitted."""
    runs = [on_even_clock(r) for r in recordings]
    training = runs[: roles.count("train")]
    noise = np.array([white_noise(_signals(training, c)) or 1.0 for c in SIMULATED_OUTPUTS])
    # hold-out runs are on the tape too, but only their own unknowns may be fitted to them
    tape = jax.tree.map(jnp.asarray, Tape.from_recordings(runs, unloaded, follow=True))
    fitted_runs = jnp.arange(tape.runs) < len(training)
    plain = Parameters.of(search_bounds(training))
    problem = Problem(plain, tape, jnp.asarray(noise), plain.all_free, fitted_runs, begins_warm=~fitted_runs)
    return Prepared(
        runs,
        roles,
        findings,
        _irrelevant(training, tie),
        known,
        tuple(tie),
        effect_magnitudes(training),
        problem,
        differentiated=tuple(r.speed is None and r.angle is not None for r in recordings),
    )


def _with_counts_as_angle(run: Recording) -> Recording:
    """The record of an uneven clock with its angle in place of a speed that is counts over each interval."""
    if run.speed is None or run.angle is not None or is_even(run.time):
        return run
    angle = angle_of_counts(run.time, run.speed)
    return run if angle is None else attrs.evolve(run, speed=None, angle=angle)


def _counted_note(run: Recording) -> Finding:
    what = "the speed is counts of an encoder over each interval of an uneven clock: this is modelled"
    return Finding(run.name, "speed", "note", what, "", "")


def _check_columns(recordings: Sequence[Recording], roles: Sequence[Role]) -> None:
    if "train" not in roles:
        raise InputError("RUN", "there is no recording to fit", "Give at least one")
    for run in recordings:
        if not run.is_identifiable:
            what = f"too few columns to identify a motor, only {', '.join(run.columns())}"
            raise InputError(run.source or run.name, what, f"Needed besides time: {NEEDED_TO_IDENTIFY}")


def _check_options(tie: Sequence[tuple[str, str]], known: Mapping[str, float]) -> None:
    check_names("--tie", [name for pair in tie for name in pair])
    check_names("--known", list(known))
    targets = [target for target, _ in tie]
    for target, source in tie:
        if targets.count(target) > 1:
            raise InputError("--tie", f"{target} is tied twice", "Drop one")
        if target == source or target in known or target in {b for _, b in tie}:
            raise InputError("--tie", f"{target}={source} forms a circle or ties a known value", "Drop one")
        if {target, source} != {"Kt", "Kb"}:
            what = f"{target} and {source} are measured in different units"
            raise InputError("--tie", what, "Tie Kt=Kb: in SI units these two are equal")
    for name, value in known.items():
        if not isinstance(value, Real):
            raise InputError("--known", f"{name}={value!r} is not a number", "Give a value in SI")
        if not 0 < value < np.inf:
            raise InputError("--known", f"{name}={value} is not positive", "Give a value in SI")


def _raise_errors(findings: Sequence[Finding]) -> None:
    for finding in findings:
        if finding.severity == "error":
            where = ", ".join(filter(None, (finding.run, finding.column, finding.where)))
            raise InputError(where, finding.what, finding.mend)


def _signals(recordings: Sequence[Recording], name: str) -> list[np.ndarray]:
    return [signal for r in recordings if (signal := getattr(r, name)) is not None]


def _irrelevant(recordings: Sequence[Recording], tie: Sequence[tuple[str, str]]) -> dict[str, float]:
    """Parameters that affect no run, not even through a tie, with a harmless value."""
    relevant = {name for r in recordings for name in PARAMETERS_OF_DRIVE["held" if r.held else r.drive]}
    relevant |= {source for target, source in tie if target in relevant}
    return {name: 1.0 for name in PARAMETERS if name not in relevant}
