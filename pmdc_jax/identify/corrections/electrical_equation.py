"""What the electrical equation, from one sample to the next, tells of when the voltages act and how the currents were
read, whatever torque acts.

A current depends on the one before it, on the speed and on one voltage. It depends on two if the voltages act between
two samples, or are linear from sample to sample, or if it is a mean over a sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...recordings.recording import Recording
from ...simulate.exponential import scalar_phi
from ..fit.polish import Fit
from ..prepare import Prepared

# Least standard errors of the coefficient of a second voltage from zero
MIN_Z = 10.0
# Least share of the squared residuals of the electrical equation that a second voltage explains
MIN_EXPLAINED = 0.05
# The same, of what it explains together with a third voltage on the other side: a noisy voltage seems to have both
MIN_OF_THREE = 0.95
# Largest coefficient of a third voltage, relative to the voltage's own
MAX_OTHER_SIDE = 0.3
# Share of a current that remains after a sample, at most, if it settles from one sample to the next
MAX_REMAINING = 0.4
# Share of a current that remains after a sample, at most, if it settles too soon to show when the voltage acts
MAX_HIDDEN = 0.02
# Least excess over what is expected of the share of the later speed that counts, and least shortfall
MIN_LATER, MIN_EARLIER = 0.02, 0.1
# Range of the share of a current that remains after a sample
REMAINING = (1e-9, 0.999)
# Standard errors by which the share of the later voltage, and that of a current that remains, may be off
SHARE_ERRORS = 4.0
# How much the instant of reading may differ within these errors, in samples
MAX_SPREAD = 0.05
# A value less its error, the value, and the value plus its error
SIDES = np.array([-1.0, 0.0, 1.0])
# Standard deviations of its noise from which a current flows for certain
MIN_FLOW = 4.0
# Samples in which the current does not flow in one direction are left out if this share of the squared steps of the
# voltage remains
MIN_STEPS = 0.2

# Columns of the electrical equation: the current, the speed at the start and at the end of the step, the voltage of the
# sample before, of this and of the next one, a constant, the direction of the current
CURRENT, SPEED, NEXT_SPEED, BEFORE, NOW, AFTER, COLUMNS = 0, 1, 2, 3, 4, 5, 8


class ElectricalEquation(NamedTuple):
    """The electrical equation from sample to sample: the next current by the columns."""

    current: Float[np.ndarray, " samples"]
    columns: Float[np.ndarray, "samples columns"]
    # the same columns of the simulation, whose currents and speeds have no noise
    instruments: Float[np.ndarray, "samples columns"]
    sample_time: float  # s

    def solve(self, without: Sequence[int] = ()) -> Solution:
        """The solution with all columns, or without some.

        By instrumental variables, because noise of the currents would bias least squares; errors as of White (1980).
        """
        used = np.delete(np.arange(COLUMNS), list(without))
        size = np.sqrt(np.mean(np.square(self.instruments[:, used]), axis=0)) + 1e-300
        Z, X = self.instruments[:, used] / size, self.columns[:, used] / size
        inverse = np.linalg.pinv(Z.T @ X, rcond=1e-10)
        coefficients = inverse @ (Z.T @ self.current)
        residual = self.current - X @ coefficients
        scores = inverse @ (Z * residual[:, None]).T
        of_all = np.zeros((2, COLUMNS))
        of_all[:, used] = coefficients / size, np.sqrt(np.square(scores).sum(1)) / size
        return Solution(of_all[0], of_all[1], float(np.mean(np.square(residual))))


class Solution(NamedTuple):
    """What solves the electrical equation, zero for columns that are not used."""

    coefficients: Float[np.ndarray, " columns"]
    errors: Float[np.ndarray, " columns"]  # standard
    mean_square: float  # of the residual


class TwoVoltages(NamedTuple):
    """A current that depends on the voltages of two samples."""

    ahead: int  # whole samples by which the voltages act before their record: 0 or -1
    # share of a sample after which the outputs are read, if the voltages are held; None if the current settles too soon
    # to tell
    reading: float | None
    # share of a current that remains after that time; at most, where it cannot be told from zero
    remains: float
    sample_time: float  # s

    def time_constant(self, reading: float) -> float:
        """L / R, in s, if the outputs are read after this share of a sample."""
        return -reading * self.sample_time / float(np.log(self.remains))


def two_voltages(equation: ElectricalEquation) -> TwoVoltages | None:
    """How the currents depend on two voltages: these begin to act between two samples, or are straight between them, or
    the currents are means. None if they act at a sample, as far as the currents tell."""
    by_three = equation.solve()
    gains = by_three.coefficients
    own, other = (AFTER, BEFORE) if gains[AFTER] > gains[BEFORE] else (BEFORE, AFTER)
    by_one = equation.solve(without=(BEFORE, AFTER))
    by_two = equation.solve(without=(other,))
    if by_one.mean_square - by_two.mean_square < MIN_OF_THREE * (by_one.mean_square - by_three.mean_square):
        # it explains much, or the two are collinear, as where a current settles within a sample
        if abs(gains[other]) > MAX_OTHER_SIDE * gains[own]:
            return None
        by_two = by_three
    coefficients, errors, mean_square = by_two
    if coefficients[own] < MIN_Z * errors[own] or mean_square > (1 - MIN_EXPLAINED) * by_one.mean_square:
        return None
    later = AFTER if own == AFTER else NOW
    both = [later - 1, later]
    share = float(coefficients[later] / coefficients[both].sum())
    shares = share + SHARE_ERRORS * np.hypot(*errors[both]) / coefficients[both].sum() * SIDES
    remains = coefficients[CURRENT] + SHARE_ERRORS * errors[CURRENT] * SIDES
    lowest, remainder, highest = 1 - shares[::-1] * (1 - remains[1])
    readings = [_reading(s, r) for s in shares for r in remains]
    return TwoVoltages(
        ahead=0 if own == AFTER else -1,
        reading=_reading(share, remains[1]) if np.ptp(readings) < MAX_SPREAD else None,
        remains=float(np.clip(remainder if lowest > 0 else highest, *REMAINING)),
        sample_time=equation.sample_time,
    )


class Settling(NamedTuple):
    """What a current that settles from one sample to the next tells of a fit with voltages held from their samples on:
    by how much it depends on the speed at the end of a sample, and how much on that at its start."""

    sooner: bool  # it settles sooner than in the fit, or may, whose inductance may stand for a voltage that acts late
    as_mean: bool  # it depends on both speeds, as only a mean over the sample does


def settling(equation: ElectricalEquation, prepared: Prepared, fit: Fit) -> Settling:
    """What the settling of the currents tells of the fit."""
    motor = prepared.problem.parameters(fit.coordinates)
    by_fit = np.exp(-float(motor.R / motor.L) * equation.sample_time)
    solution = equation.solve(without=(BEFORE, AFTER))
    remains, before, after = solution.coefficients[[CURRENT, SPEED, NEXT_SPEED]]
    # the errors of both are opposite, because the speeds are nearly the same
    share = after / (before + after)
    error = SHARE_ERRORS * solution.errors[NEXT_SPEED] / abs(before + after)
    if by_fit > MAX_REMAINING or share - error > 1:
        return Settling(False, False)  # slow currents, or speeds that are not those at the samples
    # very soon settled, it tells its inductance too inaccurately to exclude that
    least = -error if by_fit < MAX_HIDDEN else MIN_LATER + error
    return Settling(
        sooner=bool(share - _later_share(by_fit) > least),
        as_mean=bool(_later_share(remains) - share > MIN_EARLIER + error) and prepared.averaging is None,
    )


def _later_share(remains: float) -> float:
    """Share of the later speed in what two speeds, with a straight line between them, do to a current; `remains`, the
    share of a current that is left after a sample."""
    z = np.log(np.clip(remains, *REMAINING))
    return float(scalar_phi(z, 2) / scalar_phi(z, 1))


def _reading(share: float, remains: float) -> float:
    """The share of a sample after which the outputs are read, from that of the later of two held voltages."""
    remains = float(np.clip(remains, *REMAINING))
    # of the current at the start of the sample
    until_reading = np.clip(1 - share * (1 - remains), remains, 1.0)
    return float(np.log(until_reading) / np.log(remains))


def electrical_equation(prepared: Prepared, fit: Fit) -> ElectricalEquation | None:
    """The equation of all training runs together; None if they differ in sample time, none has what it takes, or
    no three samples in a row are known.

    **Arguments**: `fit`, to these runs, with voltages that are held from their samples on.
    """
    tape, outputs = prepared.problem.tape, np.asarray(fit.evaluation.simulated)
    currents, columns, instruments = [], [], []
    runs = [(k, run) for k, run in enumerate(prepared.training) if _is_usable(run)]
    if len({tape.grid_of(k) for k, _ in runs}) != 1:
        return None
    for k, run in runs:
        measured, simulated, weight, voltage = (
            tape.samples_of(k, signal, len(run)) for signal in (tape.measured, outputs, tape.weight, tape.value)
        )
        known = np.all(weight > 0, axis=1)
        used = known[1:-2] & known[2:-1] & known[3:]
        # where the current is next to nothing or reverses, brushes may drop any voltage
        flow = np.sign(measured[:, 0]) * (np.abs(measured[:, 0]) > MIN_FLOW * prepared.problem.noise[0])
        flows = used & (flow[2:-1] != 0) & (flow[3:] != 0)
        one_way = flows & (flow[1:-2] == flow[2:-1]) & (flow[2:-1] == flow[3:])
        steps = np.square(np.diff(voltage[1:-1]))
        enough = MIN_STEPS * steps[used].sum()
        used = next(rows for rows in (one_way, flows, used) if steps[rows].sum() >= enough)
        direction = (flow[2:-1] + flow[3:]) / 2
        shared = [voltage[1:-2], voltage[2:-1], voltage[3:], np.ones(len(used)), direction]
        currents.append(measured[3:, 0][used])
        for rows, x in ((columns, measured), (instruments, simulated)):
            row = [x[2:-1, 0], x[2:-1, 1], x[3:, 1], *shared]
            rows.append(np.stack(row, 1)[used])
    if not any(map(len, currents)):  # a sensor slower than the log has no three readings one after the other
        return None
    rows = map(np.concatenate, (currents, columns, instruments))
    return ElectricalEquation(*rows, sample_time=tape.sample_time_of(runs[0][0]))


def _is_usable(run: Recording) -> bool:
    measured = run.drive == "voltage" and run.current is not None and run.speed is not None
    return measured and not run.held and run.has_even_clock
