"""An adaptive solution by a general-purpose solver, against which the fast one is checked."""

from __future__ import annotations

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.base import State
from ..motor import Motor


@eqx.filter_jit
def reference_solution(
    motor: Motor,
    times: Float[Array, " samples"],
    voltage: Float[Array, " samples"],
    load: Float[Array, " samples"],
    initial: Float[Array, "2"],
    tolerance: float = 1e-10,
) -> Float[Array, "2 samples"]:
    """Current (A) and speed (rad/s) at `times` by adaptive Tsit5, restarted at every jump of the input.

    Thousands of times slower than `simulate`, and only for smooth effects: where friction sticks, an adaptive
    solver chatters.

    **Arguments**: `times`, s, increasing; `voltage` in V and `load` in N m, held from each time to the next;
    `initial`, current and speed; `tolerance`, relative, and absolute in A and rad/s.
    """

    def rate(t: float | Float[Array | np.ndarray, ""], state: State, args: None) -> State:
        k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
        return motor.derivative(State(*state), voltage[k], load[k])

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Tsit5(),
        t0=times[0],
        t1=times[-1],
        dt0=None,
        y0=motor.initial_state(initial[0], initial[1], load[0]),
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=tolerance, atol=tolerance), jump_ts=times[1:-1]
        ),
        max_steps=1_000_000,
    )
    assert solution.ys is not None
    return jnp.stack([solution.ys.current, solution.ys.speed])
