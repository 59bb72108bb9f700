"""A drive that goes on straight between its samples, where it was recorded and not played: taken for what it is.

An amplifier that follows a signal, and most simulations that others make (`lsim`, `interp`), go through the recorded
voltages on straight lines. Held until the next sample such a voltage comes half a sample late, for which the
inductance makes up, and then the resistance and the friction.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from ..simulate import Tape
from .likelihood import unlikely
from .polish import Polished, polish
from .prepare import Prepared

# A straight drive must be so much likelier than a held one, by the logarithm
LIKELIER = 30.0


def drives_straight(given: Prepared, fit: Polished) -> bool:
    """Whether voltages and torques that go on straight between their samples are clearly likelier than held ones.

    They are held at their means for this, which is in time, too, and needs no other code than what is compiled.

    **Arguments**: `fit`, that to the runs as they are.
    """
    tape = given.problem.tape
    if np.all(np.asarray(tape.drive.current) > 0):
        return False  # currents flow on between their samples anyway
    means = _driven(given, replace(with_straight_drive(given).problem.tape, rise=None))
    nearer = polish(means.problem, fit.refined)
    return unlikely(means, nearer) < unlikely(given, fit) - LIKELIER


def with_straight_drive(given: Prepared) -> Prepared:
    """The runs with voltages and torques that go on straight from sample to sample."""
    driven = Tape.from_recordings(given.runs, straight=True)
    value, rise = jax.tree.map(jnp.asarray, (driven.value, driven.rise))
    return _driven(given, replace(given.problem.tape, value=value, rise=rise))


def _driven(given: Prepared, tape: Tape) -> Prepared:
    return given._replace(problem=replace(given.problem, tape=tape))
