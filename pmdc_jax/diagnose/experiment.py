"""The run that would best distinguish rivals: of a few waveforms, the one in which their simulations differ most."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from ..motor import Motor
from ..recordings.recording import Recording
from ..simulate import Tape, free_run
from .diagnosis import NextExperiment
from .selection.naming import Naming

# Length of the run in s, and its sample time
DURATION, SAMPLE_TIME = 6.0, 1e-3
# Share of the difference between two simulations that remains once all parameters are fitted to the new run, too
REMAINING_SHARE = 0.3
# Significance level (one-sided) at which the power is stated
SIGNIFICANCE = 0.05

Waveform = Callable[[np.ndarray], np.ndarray]  # time in s to voltage over its limit


def _random_steps(seed: int, shortest: float, longest: float) -> Waveform:
    """Random levels, each held for a random time of `shortest` to `longest` seconds."""

    def levels(time: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(seed)
        edges = np.cumsum(rng.uniform(shortest, longest, int(time[-1] / shortest) + 1))
        return rng.uniform(-1, 1, len(edges) + 1)[np.searchsorted(edges, time)]

    return levels


WAVEFORMS: dict[str, Waveform] = {
    "creep slowly through zero in both directions": lambda t: 0.15 * np.abs((2 * t / 1.5) % 4 - 2) - 0.15,
    "climb in steps to full speed forward, then backward": lambda t: (
        np.round(4 * np.abs((t * 4 / DURATION) % 4 - 2)) / 4 - 1
    ),
    "jump between levels every few hundredths of a second": _random_steps(1, 0.01, 0.06),
    "jump between levels every half second": _random_steps(2, 0.3, 0.7),
    "reverse at full voltage, then coast": lambda t: np.sign(np.sin(4 * np.pi * t)) * ((t % 1.5) < 1),
    "rest, then small steps": lambda t: 0.08 * _random_steps(3, 0.2, 0.4)(t) * (t > 2),
}


def next_experiment(naming: Naming, recordings: Sequence[Recording]) -> NextExperiment | None:
    """The waveform, within the recorded voltage, in which the chosen motor and its nearest rival differ most.

    None without a recorded voltage or a rival, and where no waveform shows a difference.
    """
    limit = max((float(np.max(np.abs(r.voltage))) for r in recordings if r.voltage is not None), default=0)
    if not limit or not naming.rivals:
        return None
    rival = naming.rivals[0]
    motors = [jax.tree.map(np.asarray, m.motor) for m in (naming.chosen, rival)]
    noise = np.asarray(naming.chosen.fit.noise)
    time = SAMPLE_TIME * np.arange(int(DURATION / SAMPLE_TIME))
    ranked = sorted(
        (
            (difference_between(motors, time, limit * waveform(time), noise), name)
            for name, waveform in WAVEFORMS.items()
        ),
        reverse=True,
    )
    difference, name = ranked[0]
    if not difference:
        return None
    power = float(stats.norm.cdf(REMAINING_SHARE * difference - stats.norm.isf(SIGNIFICANCE)))
    sets = (" + ".join(sorted(m.effects)) for m in (naming.chosen, rival))
    return NextExperiment(
        why=f"{' and '.join(sets)} explain these runs equally well",
        description=f"{name}, {DURATION:g} s within {limit:.3g} V, no load",
        power=power,
        time=time,
        voltage=limit * WAVEFORMS[name](time),
    )


def difference_between(
    motors: list[Motor],
    time: Float[np.ndarray, " samples"],
    voltage: Float[np.ndarray, " samples"],
    noise: Float[np.ndarray, "2"],
) -> float:
    """Root of the summed squares of the difference between two motors' responses, over the noise of current and speed.

    Zero if one cannot be simulated: a motor fitted to other runs may be unstable in this one.
    """
    zero = np.zeros_like(time)
    tape = Tape.from_recordings([Recording("next", time, voltage, zero, zero, load=zero)])
    one, other = (np.asarray(free_run(motor, tape)) for motor in motors)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.linalg.norm((one - other) * np.asarray(tape.weight) / noise[:, None])
    return float(size) if np.isfinite(size) else 0.0
