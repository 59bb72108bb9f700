"""What candidates and curves change along a trajectory, some of them at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from ...simulate import Tape

# Most columns that are simulated together, and most numbers in all of them: they limit the memory
MAX_COLUMNS = 32
MAX_NUMBERS = 2**23


class Change(NamedTuple):
    """What a few candidates or curves change along a trajectory, in current and speed: the state at the end of each
    sample, or, by a sensor, what is recorded."""

    values: Float32[np.ndarray, "samples 2 blocks columns"]
    by_sensor: bool = False


def columns_at_once(tape: Tape) -> int:
    """How many columns are simulated together."""
    return max(1, min(MAX_COLUMNS, MAX_NUMBERS // (2 * tape.value.size)))
