"""Who belongs to what, as matrices: n points by i true instances, or by s predicted segments.

A row of a predicted membership sums to 1, a row of a true one to 1 or, for background and padding, to 0. A column
holds the weights with which an instance is fitted. Source: SPFN (Li et al. 2019).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.types import Truth


def of_labels(labels: Int[Array, " n"], *, num_columns: int, dtype=jnp.float32) -> Float[Array, "n i"]:
    """One-hot rows of the labels; a label outside [0, num_columns), such as -1, gives a row of zeros."""
    return jax.nn.one_hot(labels, num_columns, dtype=dtype)


def of_truth(truth: Truth, *, dtype=jnp.float32) -> Float[Array, "n i"]:
    """Membership of every point in the true instances; background, padding and masked instances are zero."""
    labels = jnp.where(truth.mask, truth.labels, -1)
    membership = of_labels(labels, num_columns=truth.instance_mask.shape[0], dtype=dtype)
    return jnp.where(truth.instance_mask[None, :], membership, 0)


def of_logits(logits: Float[Array, "n s"], mask: Bool[Array, " n"]) -> Float[Array, "n s"]:
    """Softmax over the slots, rows of padding zero."""
    return jnp.where(mask[:, None], jax.nn.softmax(logits, axis=1), 0)
