"""scipy `lfilter` on the exact discretisation, one candidate at a time.

Current and speed share one denominator, so the numerators become one small matrix product with the
delayed inputs, and both channels pass the all-pole filter in one call.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.peers.held import Run, exact_step


def _delayed(signal: NDArray, samples: int) -> NDArray:
    return np.concatenate([np.zeros(samples), signal[:-samples]])


def squared_errors(candidates: NDArray, run: Run) -> NDArray[np.float64]:
    """Errors of current and speed of linear motors, shape (2, P)."""
    measured = np.array([run.current, run.speed])
    inputs = np.array([_delayed(s, n) for s in (run.voltage, run.load) for n in (1, 2)])
    start = measured[:, 0]
    errors = np.empty((2, len(candidates)))
    for n, step in enumerate(exact_step(candidates, run.dt)):
        phi, gains = step[:, :2], step[:, 2:]
        trace, det = phi[0, 0] + phi[1, 1], phi[0, 0] * phi[1, 1] - phi[0, 1] * phi[1, 0]
        second = phi @ gains - trace * gains  # numerator at the second delay
        numerator = np.stack([gains, second], -1).reshape(2, 4)
        delays = np.stack([start, phi @ start - trace * start], -1)  # the initial state
        driven = numerator @ inputs
        simulated, _ = lfilter([1.0], [1.0, -trace, det], driven, zi=delays)
        residual = simulated - measured
        errors[:, n] = np.einsum("cs,cs->c", residual, residual)
    return errors
