"""What the electrical equation, from one sample to the next, tells of when the voltages act and how the currents were
read, whatever torque acts.

A current depends on the one before it, on the speed and on one voltage. It depends on two if the voltages act between
two samples, or are linear from sample to sample, or if it is a mean over a sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...recording import Recording
from ..generalised_least_squares import training_indices
from ..polish import Fit
from ..prepare import Prepared

# How many standard errors from zero the coefficient of the second voltage must be, and the share of the squared
# residuals of the electrical equation that it must explain
MIN_Z, MIN_EXPLAINED = 10.0, 0.05
# ... and the largest effect of the one on the other side, relative to it: a noisy voltage seems to have both
MAX_OTHER_SIDE = 0.3
# ... and the largest share of what is left that the further columns of a filtered current may explain
MAX_BY_FILTER = 0.2
# A current settles from one sample to the next if that is this many time constants; least difference of the share that
# is left of it after a sample, and of the later speed's, that counts
MIN_TIME_CONSTANTS, MIN_REMAINING, SHARE_TOLERANCE = 1.0, 2e-3, 0.1
# Range of the share of a current that is left after a sample
REMAINING = (1e-9, 0.999)
# Standard errors by which the share of the later voltage, and that of a current that remains, may be off, and how much
# the instant of reading may differ between these, in samples
SHARE_ERRORS, MAX_SPREAD = 4.0, 0.05
SIDES = np.array([-1.0, 0.0, 1.0])
# Standard deviations of its noise from which a current flows for certain; samples in which it does not flow in one
# direction are left out if this share of the squared steps of the voltage remains
FLOWS, MIN_STEPS = 4.0, 0.2

# Columns of the electrical equation: the current, both speeds, the voltage of the sample before, of this and of the
# next one, a constant, the direction of the current; and those of a filtered one: the current and the voltage of one
# sample further back
BEFORE, NOW, AFTER, COLUMNS, WITH_FILTER = 3, 4, 5, 8, 10


class ElectricalEquation(NamedTuple):
    """The electrical equation from sample to sample: the next current by the columns."""

    current: Float[np.ndarray, " samples"]
    columns: Float[np.ndarray, "samples columns"]
    # the same columns of the simulation, whose currents and speeds have no noise
    instruments: Float[np.ndarray, "samples columns"]

    def solve(self, used: Int[np.ndarray, " used"]) -> tuple[np.ndarray, np.ndarray, float]:
        """Coefficients of the columns used, their standard errors, and the mean square that is left.

        By instrumental variables, because noise of the currents would bias least squares; errors as of White (1980).
        """
        size = np.sqrt(np.mean(np.square(self.instruments[:, used]), axis=0)) + 1e-300
        Z, X = self.instruments[:, used] / size, self.columns[:, used] / size
        inverse = np.linalg.pinv(Z.T @ X, rcond=1e-10)
        coefficients = inverse @ (Z.T @ self.current)
        left = self.current - X @ coefficients
        scores = inverse @ (Z * left[:, None]).T
        errors = np.sqrt(np.square(scores).sum(1)) / size
        return coefficients / size, errors, float(np.mean(np.square(left)))


class TwoVoltages(NamedTuple):
    """A current that depends on the voltages of two samples."""

    ahead: int  # as many samples at least the voltages act before the one beside which they were recorded: 0 or -1
    # share of a sample after which the outputs are read, if the voltages are held; None if the current settles too soon
    # to tell
    reading: float | None


def two_voltages(equation: ElectricalEquation) -> TwoVoltages | None:
    """How the currents depend on two voltages: these begin to act between two samples, or are straight between them, or
    the currents are means. None if they act at a sample, as far as the currents tell."""
    coefficients, errors, left = equation.solve(np.arange(COLUMNS))
    without = equation.solve(np.delete(np.arange(COLUMNS), [BEFORE, AFTER]))[2]
    gains = coefficients / coefficients[[BEFORE, NOW, AFTER]].sum()
    own, other = (AFTER, BEFORE) if gains[AFTER] > gains[BEFORE] else (BEFORE, AFTER)
    clear = gains[own] > 0 and abs(coefficients[own]) > MIN_Z * errors[own]
    one_sided = abs(gains[other]) < MAX_OTHER_SIDE * gains[own]
    if not (clear and one_sided and left < (1 - MIN_EXPLAINED) * without):
        return None
    if equation.solve(np.arange(WITH_FILTER))[2] < (1 - MAX_BY_FILTER) * left:
        return None
    later = AFTER if own == AFTER else NOW
    both = [later - 1, later]
    share = float(coefficients[later] / coefficients[both].sum())
    shares = share + SHARE_ERRORS * np.hypot(*errors[both]) / coefficients[both].sum() * SIDES
    remains = coefficients[0] + SHARE_ERRORS * errors[0] * SIDES
    readings = [_reading(s, r) for s in shares for r in remains]
    return TwoVoltages(
        ahead=0 if own == AFTER else -1,
        reading=_reading(share, remains[1]) if np.ptp(readings) < MAX_SPREAD else None,
    )


class Settling(NamedTuple):
    """How a current that settles from one sample to the next contradicts a fit with voltages held from their samples
    on."""

    sooner: bool  # it settles sooner than in the fit, whose larger inductance may stand for a voltage that acts late
    as_mean: bool  # it depends on the speeds at both ends of a sample, as only a mean over the sample does


def settling(equation: ElectricalEquation, given: Prepared, fit: Fit) -> Settling:
    """Whether the settling of the currents contradicts the fit; it does not where they settle later."""
    motor = given.problem.parameters(fit.coordinates)
    shortest = min(given.problem.tape.sample_time_of(k) for k in training_indices(given))
    time_constants = float(motor.R / motor.L) * shortest
    if time_constants < MIN_TIME_CONSTANTS:
        return Settling(False, False)
    (remains, before, after, *_), errors, _ = equation.solve(
        np.delete(np.arange(COLUMNS), [BEFORE, AFTER])
    )
    above = np.exp(-time_constants) - remains > max(SHARE_ERRORS * errors[0], MIN_REMAINING)
    share, error = after / (before + after), np.hypot(*errors[1:3]) / abs(before + after)
    held = _later_share(remains)
    as_mean = held - share > SHARE_TOLERANCE + SHARE_ERRORS * error
    return Settling(bool(above), bool(as_mean and given.averaging is None))


def _later_share(remains: float) -> float:
    """Share of the later speed in what two speeds, with a straight line between them, do to a current; `remains`, the
    share of a current that is left after a sample."""
    remains = float(np.clip(remains, *REMAINING))
    a = -np.log(remains)
    return (a - 1 + remains) / (a * (1 - remains))  # phi_2(-a) / phi_1(-a)


def _reading(share: float, remains: float) -> float:
    """The share of a sample after which the outputs are read, from that of the later of two held voltages."""
    remains = float(np.clip(remains, *REMAINING))
    # of the current at the start of the sample
    left = np.clip(1 - share * (1 - remains), remains, 1.0)
    return float(np.log(left) / np.log(remains))


def electrical_equation(given: Prepared, fit: Fit) -> ElectricalEquation | None:
    """The equation of all training runs together; None if they differ in sample time or none has what it takes.

    **Arguments**: `fit`, to these runs, with voltages that are held from their samples on.
    """
    tape, seen = given.problem.tape, np.asarray(fit.evaluation.seen)
    currents, columns, instruments = [], [], []
    runs = [(k, run) for k, run in enumerate(given.training) if _is_usable(run)]
    if len({tape.grid_of(k) for k, _ in runs}) != 1:
        return None
    for k, run in runs:

        def of_run(signal: np.ndarray, k: int = k, run: Recording = run) -> np.ndarray:
            return np.stack([tape.samples_of(k, signal[:, c], len(run)) for c in range(2)], 1)

        measured, simulated = of_run(np.asarray(tape.measured)), of_run(seen)
        known = np.all(of_run(np.asarray(tape.weight)) > 0, axis=1)
        voltage = np.asarray(tape.samples_of(k, tape.value, len(run)))
        used = known[1:-2] & known[2:-1] & known[3:]
        # where the current is next to nothing or reverses, brushes may drop any voltage
        flow = np.sign(measured[:, 0]) * (np.abs(measured[:, 0]) > FLOWS * given.problem.noise[0])
        flows = used & (flow[2:-1] != 0) & (flow[3:] != 0)
        one_way = flows & (flow[1:-2] == flow[2:-1]) & (flow[2:-1] == flow[3:])
        steps = np.square(np.diff(voltage[1:-1]))
        enough = MIN_STEPS * steps[used].sum()
        used = next(rows for rows in (one_way, flows, used) if steps[rows].sum() >= enough)
        direction = (flow[2:-1] + flow[3:]) / 2
        shared = [voltage[1:-2], voltage[2:-1], voltage[3:], np.ones(len(used)), direction]
        currents.append(measured[3:, 0][used])
        for rows, x in ((columns, measured), (instruments, simulated)):
            further = [x[1:-2, 0], voltage[:-3]]
            row = [x[2:-1, 0], x[2:-1, 1], x[3:, 1], *shared, *further]
            rows.append(np.stack(row, 1)[used])
    return ElectricalEquation(*map(np.concatenate, (currents, columns, instruments)))


def _is_usable(run: Recording) -> bool:
    measured = run.drive == "voltage" and run.current is not None and run.speed is not None
    return measured and not run.held and run.resampled_from is None
