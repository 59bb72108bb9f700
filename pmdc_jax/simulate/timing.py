"""When the voltages of a recording act, and how its currents were read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Timing(NamedTuple):
    """When the voltages of a recording act, if they are not held from their sample to the next, and how its currents
    were read."""

    lead: float  # by how many samples they act before the sample beside which they were recorded, at least -1
    first_order_hold: bool = False  # linear from sample to sample
    # with a first-order hold, R / L in 1/s, or zero if it is unknown, if they are on smooth curves between jumps
    smooth: float | None = None
    # by how many whole samples the recorded loads act earlier, if they change when the voltages do and not at their
    # own samples
    load_ahead: int | None = None
    current_mean: bool = False  # whether the recorded currents are means over the last sample

    @property
    def ahead(self) -> int:
        """By how many whole samples they act earlier."""
        return int(np.floor(self.lead))

    @property
    def reading(self) -> float | None:
        """The share of a sample between the instant at which a voltage begins to act and the reading of the outputs, if
        not zero."""
        return self.lead - self.ahead or None


ZERO_ORDER_HOLD = Timing(0)
RECORDED_LATE = Timing(1)
RECORDED_EARLY = Timing(-1)
FIRST_ORDER_HOLD = Timing(0, first_order_hold=True)
SMOOTH = Timing(0, first_order_hold=True, smooth=0.0)
