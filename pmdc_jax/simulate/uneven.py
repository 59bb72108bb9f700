"""The simulated motion at uneven time stamps: the solver steps along an even clock, and a recorded sample is compared
with the motion within the even sample where it lies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from ..motor import Drive, Motor
from ..recordings.angle import mean_speeds
from .between_samples import Pieces, mean_and_rise_of_pieces, pieces_of
from .exponential import scalar_phi

if TYPE_CHECKING:
    from ..recordings.recording import Recording

# Closer eigenvalues are moved apart to this relative distance, which is then the relative error, too
MIN_EIGENVALUE_GAP = 1e-7


def simulated_at_stamps(
    motor: Motor,
    drive: Drive,
    even: Recording,
    simulated: Float[np.ndarray, "samples 2"],
    first_order_hold: bool = False,
    mean_speed: bool = False,
) -> Float[np.ndarray, "recorded 2"]:
    """Current A and speed rad/s at the time stamps of a record, from those at the samples of its `even` clock; instead
    of that speed the `mean_speeds` from one known angle to the next, if asked for.

    Exact for the linear motor, including the difference between the recorded drive and the straight line in its place.
    The effects are taken to contribute a constant voltage and torque within an even sample, but for a voltage that
    changes its sign with the drive.
    """
    record, pieces = even.recorded, pieces_of(even, first_order_hold)
    reached, integral = _motion_in_pieces(motor, drive, even, simulated, pieces)
    stamps = np.searchsorted(pieces.time, record.time)
    outputs = reached[stamps]
    if mean_speed and record.angle is not None:
        angle = np.append(0.0, np.cumsum(integral[:-1, 1]))[stamps]
        outputs[:, 1] = mean_speeds(record.time, np.where(np.isnan(record.angle), np.nan, angle))
    return outputs


def _motion_in_pieces(
    motor: Motor, drive: Drive, even: Recording, simulated: Float[np.ndarray, "samples 2"], pieces: Pieces
) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, "pieces 2"]]:
    """Current A and speed rad/s at the start of each piece, and their integrals over it."""
    _, begins, length, index, value, slope, loads = pieces
    mean, rise = mean_and_rise_of_pieces(even, pieces)
    step, line_start, line_slope = even.sample_time, mean - rise / 2, rise / even.sample_time
    A, B = map(np.asarray, motor.state_space(drive))
    load = np.zeros(len(even)) if even.load is None else even.load
    transition, constant, growing, cubic = _phi_responses(A, np.concatenate([[step], begins, length]))
    # by which time: that of an even sample, from its start to that of a piece, and from there to the end of the piece
    whole, to_start, within = slice(0, 1), slice(1, len(index) + 1), slice(len(index) + 1, None)

    def moved(by: slice, of: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Linear motion from even samples `of` on, along the straight line, by some of the `_phi_responses`."""
        rate = simulated[of] @ A.T + np.outer(line_start[of], B[:, 0]) + np.outer(load[of], B[:, 1])
        rate_slope = np.outer(line_slope[of], B[:, 0])
        return simulated[of] + _times(constant[by], rate) + _times(growing[by], rate_slope)

    by_effects = simulated[1:] - moved(whole, np.arange(len(simulated) - 1))
    rate_by_effects = np.append(np.linalg.solve(constant[0], by_effects.T).T, np.zeros((1, 2)), 0)
    # the response to what differs from the straight line and the constant rate: over the pieces of an even sample, and
    # then from sample to sample
    difference = value - line_start[index] - rise[index] * begins / step
    rate = np.outer(difference, B[:, 0]) + np.outer(loads - load[index], B[:, 1])
    reversing = _at_reversals(rate_by_effects[:, 0], mean, index, value)
    rate[:, 0] += reversing
    response = _times(constant[within], rate)
    response += _times(growing[within], np.outer(slope - line_slope[index], B[:, 0]))
    in_sample, at_end = _through_pieces(index, transition[within], response, len(even))
    carried_over = np.append(np.zeros((1, 2)), _accumulated(transition[0], at_end)[:-1], 0)
    carried_over = _times(transition[to_start], carried_over[index])
    reached = moved(to_start, index) + _times(constant[to_start], rate_by_effects[index]) + in_sample + carried_over
    rate = reached @ A.T + np.outer(value, B[:, 0]) + np.outer(loads, B[:, 1]) + rate_by_effects[index]
    rate[:, 0] += reversing
    integral = reached * length[:, None] + _times(growing[within], rate)
    return reached, integral + _times(cubic[within], np.outer(slope, B[:, 0]))


def _at_reversals(
    rate: Float[np.ndarray, " samples"],
    mean: Float[np.ndarray, " samples"],
    index: Int[np.ndarray, " pieces"],
    value: Float[np.ndarray, " pieces"],
) -> Float[np.ndarray, " pieces"]:
    """What to add to the rate of the current by effects, A/s, in each piece of an even sample in which both change
    their sign, effects and drive: a piece has the rate of the neighbouring sample whose drive has its sign.

    **Arguments**: `rate` of the current by effects, A/s, and `mean` of the drive in each even sample; `index` of the
    even sample, and `value` of the drive, of each piece.
    """
    before, after = np.maximum(index - 1, 0), np.minimum(index + 1, len(rate) - 1)
    reverses = (mean[before] * mean[after] < 0) & (rate[before] * rate[after] < 0)
    of_sign = np.where(value * mean[before] > 0, rate[before], rate[after])
    return np.where(reverses, of_sign - rate[index], 0.0)


def _through_pieces(
    index: Int[np.ndarray, " pieces"],
    transition: Float[np.ndarray, "pieces 2 2"],
    response: Float[np.ndarray, "pieces 2"],
    samples: int,
) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, "samples 2"]]:
    """States before each piece and at the end of each even sample, from rest at the start of that sample."""
    state, before = np.zeros((samples, 2)), np.empty((len(index), 2))
    # pieces that come nth in their even sample are independent of one another
    nth = np.arange(len(index)) - np.searchsorted(index, index)
    for n in range(nth.max() + 1):
        (here,) = np.nonzero(nth == n)
        before[here] = state[index[here]]
        state[index[here]] = _times(transition[here], before[here]) + response[here]
    return before, state


def _accumulated(
    transition: Float[np.ndarray, "2 2"], response: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, "samples 2"]:
    """x(k) = `transition` x(k - 1) + `response`(k) from rest, by sums over spans of samples that double in length."""
    total, count = response.copy(), 1
    while count < len(total):
        total[count:] += total[:-count] @ transition.T
        transition, count = transition @ transition, 2 * count
    return total


def _times(matrices: Float[np.ndarray, "#n 2 2"], x: Float[np.ndarray, "n 2"]) -> np.ndarray:
    return np.einsum("nij,nj->ni", np.broadcast_to(matrices, (len(x), 2, 2)), x)


def _phi_responses(A: Float[np.ndarray, "2 2"], length: np.ndarray) -> list[np.ndarray]:
    """Response over each length of time h to an initial state, to a constant rate, and to rates that grow from zero as
    t and as t^2 / 2: h^k phi_k of A h, each (lengths, 2, 2). Each is the integral of the one before it.

    By Newton's interpolation on the eigenvalues, because there are many lengths and one matrix.

    **Source**: Higham, "Functions of Matrices" (2008), definition 1.4.
    """
    one, other = np.linalg.eigvals(A)
    if abs(one - other) < MIN_EIGENVALUE_GAP * abs(one + other):  # critically damped
        other = one * (1 + MIN_EIGENVALUE_GAP)
    distance = (one - other) or 1.0
    responses = []
    for k in range(4):
        at_one, at_other = scalar_phi(one * length, k), scalar_phi(other * length, k)
        slope = (at_one - at_other) / distance
        whole = at_one[:, None, None] * np.eye(2) + slope[:, None, None] * (A - one * np.eye(2))
        responses.append(whole.real * length[:, None, None] ** k)
    return responses
