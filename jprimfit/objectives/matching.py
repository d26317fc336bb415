"""Which predicted segment stands for which true instance: the assignment of largest total overlap.

The overlap of two columns w, v of memberships is SPFN's relaxed IoU <w, v> / (sum w + sum v - <w, v>) (Li et al. 2019),
which is the IoU where the columns are 0 or 1. The assignment is optimal (hungarian.py). No gradient passes through
the assignment. n points, i true instances, s predicted segments.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST
from jprimfit.objectives.hungarian import assign


def relaxed_iou(truth: Float[Array, "n i"], prediction: Float[Array, "n s"]) -> Float[Array, "i s"]:
    """Relaxed IoU of every true with every predicted column, in [0, 1]; 0 where both are empty.

    Points of the background have no part in a true column but do count in the predicted ones.
    """
    shared = jnp.matmul(truth.T, prediction, precision=HIGHEST)
    union = jnp.sum(truth, axis=0)[:, None] + jnp.sum(prediction, axis=0)[None, :] - shared
    return safe.divide(shared, union)


def own_iou(truth: Float[Array, "n i"], prediction: Float[Array, "n i"]) -> Float[Array, " i"]:
    """The diagonal of relaxed_iou: of columns that are matched already; 0 where both are empty."""
    shared = jnp.sum(truth * prediction, axis=0)
    return safe.divide(shared, jnp.sum(truth, axis=0) + jnp.sum(prediction, axis=0) - shared)


def match(
    iou: Float[Array, "i s"], instance_mask: Bool[Array, " i"], segment_mask: Bool[Array, " s"]
) -> Int[Array, " i"]:
    """Column of every true instance so that the sum of the IoUs is largest, no column twice; -1 = none.

    -1 stands at masked instances, and where there are more instances than segments at those whose loss costs least.
    A pair with IoU 0 is a match as long as a segment is left (SPFN). What is not finite counts as IoU 0.
    """
    num_instances, num_segments = iou.shape
    valid = instance_mask[:, None] & segment_mask[None, :]
    gain = jnp.where(valid & jnp.isfinite(iou), iou, 0)
    # A pair that is no pair costs more than any other, so that it is taken only where nothing else is left.
    cost = jax.lax.stop_gradient(jnp.where(valid, -gain, 1))
    missing = max(num_instances - num_segments, 0)
    column = assign(jnp.pad(cost, ((0, 0), (0, missing)), constant_values=1), instance_mask)
    is_segment = jnp.pad(segment_mask, (0, missing))
    return jnp.where((column >= 0) & is_segment[column], column, -1)


def take_columns(prediction: Float[Array, "n s"], matched: Int[Array, " i"]) -> Float[Array, "n i"]:
    """The matched column of every instance, zeros where it has none (-1)."""
    # A product with one-hot columns: its transpose is a product too, where that of a gather is a scatter.
    chosen = jax.nn.one_hot(matched, prediction.shape[1], axis=0, dtype=prediction.dtype)
    return jnp.matmul(prediction, chosen, precision=HIGHEST)
