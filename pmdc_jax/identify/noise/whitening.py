"""Filters that whiten residuals before they are squared: generalised least squares.

Where a torque fluctuates, the residuals of a free run are correlated, and plain least squares gives too much weight to
their slow part, which is mostly noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...recordings.readings import reading_interval

# Samples that are filtered by one matrix product, and the longest order of a filter
CHUNK = 32


class Slow(eqx.Module):
    """Slow noise that a short filter leaves: signals with random coefficients of unit variance.

    With these as the columns of Z, it has the covariance 1 + Z Z' in a run. What makes it white is
    1 - Z M Z', with M by `root_of_slow`.
    """

    waves: Float[Array, "blocks 2 samples waves"]
    root: Float[Array, "runs waves waves"]

    def removed(
        self, white: Float[Array, "blocks 2 samples columns"], run: Int[Array | np.ndarray, " blocks"]
    ) -> Float[Array, "blocks 2 samples columns"]:
        """Filtered columns without what of them is likely to be slow noise."""
        products = jnp.einsum("bosw,bosc->bwc", self.waves, white)
        of_run = jax.ops.segment_sum(products, jnp.asarray(run), len(self.root))
        return white - jnp.einsum("bosw,bwc->bosc", self.waves, (self.root @ of_run)[run])


class Whitening(eqx.Module):
    """A filter for each run, r'(t) = S (r(t) - sum_k A_k r(t - k)), that leaves unit variance and no correlation.

    Residuals before the start of a run, or before its first measurement, are taken as zero: the initial state is
    fitted, so none has built up by then. Without the first samples that state would not be determined.

    **Source**: Aitken, Proceedings of the Royal Society of Edinburgh 55 (1936); Ljung, "System Identification",
    2nd edition, section 7.4.
    """

    bands: Float[Array, "runs white seen"]  # from a chunk and the one before to the whitened chunk
    # 1 where all samples that the filter takes from the run were measured, else 0
    usable: Float[Array, "blocks 2 samples"]
    slow: Slow | None = None

    @classmethod
    def of(
        cls,
        filters: Sequence[Float[np.ndarray, "_ 2 2"]],
        scales: Sequence[Float[np.ndarray, "2 2"]],
        weight: Float[Array | np.ndarray, "blocks 2 samples"],
        run: Int[Array | np.ndarray, " blocks"],
        slow: Float[np.ndarray, "blocks 2 samples waves"] | None = None,
    ) -> Whitening:
        """From the coefficients A and the scale S of each run; `weight` is zero where nothing was measured, `run` is
        the run of each block. Of a sensor slower than the log only the readings count. `slow`, the signals that slow
        noise has with random coefficients."""
        longest = [np.append(A, np.zeros((CHUNK - len(A), 2, 2)), axis=0) for A in filters]
        bands = np.stack([band_matrix(A, S) for A, S in zip(longest, scales, strict=True)])
        known = np.moveaxis(np.asarray(weight) > 0, 1, 2)
        usable = np.zeros(known.shape)
        for index, A in enumerate(filters):
            mine, counts = np.asarray(run) == index, np.any(scales[index], axis=0)
            measured = known[mine].reshape(-1, 2)[:, counts]
            whole = np.asarray(measured.all(1))
            if reading_interval(whole) == 1:
                begun = np.logical_or.accumulate(whole)
                before = np.append(np.ones(len(A), bool), whole | ~begun)
                whole = with_history(before, len(A))[len(A) :] & measured.any(1)
            usable[mine] = (whole[:, None] * counts).reshape(-1, *known.shape[1:])
        filters_alone = cls(jnp.asarray(bands), jnp.asarray(np.moveaxis(usable, 2, 1)))
        if slow is None:
            return filters_alone
        waves = filters_alone(jnp.asarray(slow), run)
        products = jax.ops.segment_sum(jnp.einsum("bosv,bosw->bvw", waves, waves), jnp.asarray(run), len(filters))
        return replace(filters_alone, slow=Slow(waves, jnp.asarray(root_of_slow(np.asarray(products)))))

    def __call__(
        self, signal: Float[Array, "blocks 2 samples columns"], run: Int[Array | np.ndarray, " blocks"]
    ) -> Float[Array, "blocks 2 samples columns"]:
        """Whiten columns such as residuals, in A and rad/s."""
        blocks, outputs, samples, columns = signal.shape
        run = jnp.asarray(run)
        chunks = jnp.moveaxis(signal, 1, 2).reshape(blocks, -1, CHUNK * outputs, columns)
        goes_on = (jnp.roll(run, 1) == run).at[0].set(False)
        last = jnp.where(goes_on[:, None, None, None], jnp.roll(chunks[:, -1:], 1, axis=0), 0.0)
        before = jnp.concatenate([last, chunks[:, :-1]], axis=1)
        window = jnp.concatenate([before, chunks], axis=2)

        def of_block(
            block: tuple[Int[Array, ""], Float[Array, "chunks seen columns"]],
        ) -> Float[Array, "chunks white columns"]:
            return jnp.einsum("ij,kjc->kic", self.bands[block[0]], block[1])

        # block after block: all at once, every block would have its own copy of the bands, in four times the time
        white = jax.lax.map(of_block, (run, window))
        white = jnp.moveaxis(white.reshape(blocks, samples, outputs, columns), 2, 1)
        white = white * self.usable[..., None]
        return white if self.slow is None else self.slow.removed(white, run)


def band_matrix(
    A: Float[np.ndarray, "order outputs outputs"], S: Float[np.ndarray, "outputs outputs"]
) -> Float[np.ndarray, "white seen"]:
    """The matrix that filters a chunk: from its samples and the `order` before them to the whitened ones."""
    order, outputs = A.shape[:2]
    matrix = np.zeros((CHUNK, outputs, order + CHUNK, outputs))
    here = np.arange(CHUNK)
    for back, coefficients in enumerate([np.eye(outputs), *(-A)]):
        matrix[here, :, order + here - back] = S @ coefficients
    return matrix.reshape(CHUNK * outputs, -1)


def root_of_slow(products: Float[np.ndarray, "*runs waves waves"]) -> Float[np.ndarray, "*runs waves waves"]:
    """The matrix M with (1 - Z M Z')^2 = (1 + Z Z')^-1, from the products Z'Z."""
    values, vectors = np.linalg.eigh(products)
    stretch = np.sqrt(1 + np.maximum(values, 0.0))
    return (vectors / (stretch * (1 + stretch))[..., None, :]) @ vectors.swapaxes(-2, -1)


def with_history(known: Bool[np.ndarray, " samples"], order: int) -> Bool[np.ndarray, " samples"]:
    """Which samples were measured, together with the `order` samples before them."""
    lost = np.cumsum(np.append(0, ~known))
    return np.append(np.zeros(order, bool), lost[order + 1 :] == lost[: len(known) - order])
