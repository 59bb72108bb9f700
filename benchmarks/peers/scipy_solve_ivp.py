"""scipy `solve_ivp`, RK45, one candidate at a time, as most scripts use it.

The held voltage is looked up at every call. Without `max_step` the solver would step over whole
samples; restarting it at every sample would be exact and slower still.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.peers.held import Run


def _free_run(parameters: NDArray, run: Run, rtol: float) -> NDArray:
    R, L, Kb, Kt, J, f = (float(p) for p in parameters)
    voltage, load = (run.voltage.tolist(), run.load.tolist())  # elements of lists are faster to access
    last, rate = len(voltage) - 1, 1.0 / run.dt

    def slope(t, x):
        i, w = x
        k = min(int(t * rate), last)
        return ((voltage[k] - R * i - Kb * w) / L, (Kt * i - f * w - load[k]) / J)

    time = run.dt * np.arange(last + 1)
    start = (run.current[0], run.speed[0])
    options = {"rtol": rtol, "atol": rtol, "max_step": run.dt, "t_eval": time}
    return solve_ivp(slope, (0.0, time[-1]), start, **options).y


def squared_errors(candidates: NDArray, run: Run, rtol: float = 1e-6) -> NDArray[np.float64]:
    """Errors of current and speed of linear motors, shape (2, P)."""
    measured = np.array([run.current, run.speed])
    runs = (_free_run(parameters, run, rtol) - measured for parameters in candidates)
    return np.stack([np.einsum("cs,cs->c", e, e) for e in runs], -1)
