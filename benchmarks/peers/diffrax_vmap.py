"""`jax.vmap` over a diffrax Tsit5 solve: the obvious way to simulate a population in JAX.

The unit of time is the sample, so that the held voltage is indexed by its exact floor. Both step
controllers tell the solver where the voltage jumps; otherwise its last stage would use the next voltage.
"""

from functools import partial

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.held import Run


class OneStepPerSample(diffrax.AbstractStepSizeController):
    """Constant steps that end just before a jump of the voltage and begin at the jump."""

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return eqxi.prevbefore(t0 + 1.0), None

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        begin = jnp.round(t1)
        end = eqxi.prevbefore(begin + 1.0)
        jumped = jnp.asarray(True)  # a Python bool would be folded into the initial False
        return True, begin, end, jumped, state, diffrax.RESULTS.successful


def _slope(t, x, args):
    """Derivatives per sample, not per second."""
    (R, L, Kb, Kt, J, f), run = args
    k = jnp.floor(t).astype(int)
    i, w = x
    di = (run.voltage[k] - R * i - Kb * w) / L
    dw = (Kt * i - f * w - run.load[k]) / J
    return run.dt * jnp.stack([di, dw])


def _errors(states, run):
    return ((states - jnp.stack([run.current, run.speed], -1)) ** 2).sum(0)


def _solve(parameters, run, **options):
    """Errors of one candidate."""
    last = float(len(run.voltage) - 1)
    start = jnp.stack([run.current[0], run.speed[0]])
    term, solver = diffrax.ODETerm(_slope), diffrax.Tsit5()
    solution = diffrax.diffeqsolve(term, solver, 0.0, last, y0=start, args=(parameters, run), **options)
    return _errors(solution.ys, run)


def _constant(parameters, run):
    return _solve(
        parameters,
        run,
        dt0=None,
        stepsize_controller=OneStepPerSample(),
        saveat=diffrax.SaveAt(t0=True, steps=True),
        max_steps=len(run.voltage) - 1,
    )


def _adaptive(parameters, run, jumps):
    tight = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    return _solve(
        parameters,
        run,
        dt0=0.1,
        stepsize_controller=diffrax.ClipStepSizeController(tight, jump_ts=jumps),
        saveat=diffrax.SaveAt(ts=jnp.arange(float(len(run.voltage)))),
        max_steps=20 * len(run.voltage),
    )


@jax.jit
def _population_constant(candidates, run):
    return jax.vmap(partial(_constant, run=run))(candidates).T


@jax.jit
def _population_adaptive(candidates, run, jumps):
    return jax.vmap(partial(_adaptive, run=run, jumps=jumps))(candidates).T


def squared_errors(candidates: NDArray, run: Run) -> NDArray[np.float64]:
    """Errors of linear motors, shape (2, P), with one Tsit5 step per sample."""
    with jax.enable_x64(True):
        return np.asarray(_population_constant(jnp.asarray(candidates), run))


def squared_errors_adaptive(candidates: NDArray, run: Run) -> NDArray[np.float64]:
    """Errors of linear motors, shape (2, P), with adaptive steps to 1e-6."""
    held = np.diff(run.voltage) != 0
    jumps = 1.0 + np.flatnonzero(held | (np.diff(run.load) != 0))
    with jax.enable_x64(True):
        return np.asarray(_population_adaptive(jnp.asarray(candidates), run, jnp.asarray(jumps)))
