"""Instances from an embedding in which the points of one instance lie together: how many there are, and membership.

Training asks for exp(-sharpness |e_n - mu_k|^2) to be largest at the own instance's mean mu_k, so the same kernel
measures density here (its bandwidth is 1 / sqrt(2 sharpness) = 0.5) and nothing has to be tuned to the scale of the
embedding. The densest point that no cluster explains yet is moved to its mode by mean shift (Y. Cheng, 1995), what the
mode explains is taken away, and so on; the modes are then polished as the means of their members, and membership is
the softmax that training knows. Letters: n points, m of them that are looked at, e channels, s clusters.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

NUM_CLUSTERS = 64  # capacity
NUM_SEEDS = 2048  # points that are looked at for modes, evenly spaced in the order of the cloud
SHARPNESS = 2.0  # as objectives/losses.LossConfig
EXPLAINED = 0.5  # kernel value above which a point belongs to a mode
MIN_SHARE = 0.002  # of the points: fewer are no cluster
SHIFTS = 5
POLISHES = 3


class _Modes(NamedTuple):
    center: Float[Array, "s e"]
    valid: Bool[Array, "s"]
    left: Bool[Array, "m"]  # points that no mode explains


def cluster(
    embedding: Float[Array, "n e"], mask: Bool[Array, "n"], *, num_clusters: int = NUM_CLUSTERS
) -> Float[Array, "n s"]:
    """Membership of n points in the clusters of their embedding: rows sum to 1, columns of no cluster are 0.

    Args:
        embedding: of the network.
        mask: True = a point; rows of the others are 0.
        num_clusters: capacity s; where there are more clusters, the least dense ones share the others' columns.
    """
    stride = -(-len(embedding) // NUM_SEEDS)
    seen, seen_mask = embedding[::stride], mask[::stride]
    weight = seen_mask.astype(embedding.dtype)
    density = _kernel(seen, seen) @ weight
    enough = MIN_SHARE * jnp.sum(weight)

    def find(number: Array, modes: _Modes) -> _Modes:
        start = jnp.argmax(jnp.where(modes.left, density, -1))
        center = seen[start]
        for _ in range(SHIFTS):
            near = _kernel(seen, center[None, :])[:, 0] * weight
            center = near @ seen / jnp.maximum(jnp.sum(near), 1e-6)
        near = _kernel(seen, center[None, :])[:, 0]
        explained = modes.left & (near > EXPLAINED)
        known = jnp.any(modes.valid & (_kernel(modes.center, center[None, :])[:, 0] > EXPLAINED))
        is_new = ~known & (jnp.sum(explained) >= jnp.maximum(enough, 2)) & jnp.any(modes.left)
        return _Modes(
            modes.center.at[number].set(center),
            modes.valid.at[number].set(is_new),
            # The start goes in any case, so that the search moves on.
            modes.left & ~explained & (jnp.arange(len(seen)) != start),
        )

    empty = _Modes(
        jnp.zeros((2 * num_clusters, embedding.shape[1]), embedding.dtype),
        jnp.zeros(2 * num_clusters, bool),
        seen_mask,
    )
    modes = lax.fori_loop(0, 2 * num_clusters, find, empty)
    # Twice the capacity was tried, since some starts lead nowhere; the first found are the densest.
    first = jnp.argsort(~modes.valid, stable=True)[:num_clusters]
    center, valid = modes.center[first], modes.valid[first]
    for _ in range(POLISHES):
        member = _membership(seen, center, valid) * weight[:, None]
        total = jnp.sum(member, axis=0)
        center = jnp.where((total > 0)[:, None], member.T @ seen / jnp.maximum(total, 1e-6)[:, None], center)
        valid = valid & (total >= enough)
    return jnp.where(mask[:, None], _membership(embedding, center, valid), 0)


def _kernel(a: Float[Array, "n e"], b: Float[Array, "s e"]) -> Float[Array, "n s"]:
    """exp(-sharpness |a_i - b_j|^2)."""
    return jnp.exp(-SHARPNESS * _sq_distances(a, b))


def _sq_distances(a: Array, b: Array) -> Array:
    product = jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)
    squares = jnp.sum(jnp.square(a), axis=1)[:, None] + jnp.sum(jnp.square(b), axis=1)[None, :]
    return jnp.maximum(squares - 2 * product, 0)


def _membership(embedding: Array, center: Array, valid: Array) -> Array:
    """The softmax over the valid clusters; all zero where there is none."""
    logits = jnp.where(valid[None, :], -SHARPNESS * _sq_distances(embedding, center), -jnp.inf)
    top = jnp.max(logits, axis=1, keepdims=True)
    weights = jnp.exp(logits - jnp.where(jnp.isfinite(top), top, 0))
    return weights / jnp.maximum(jnp.sum(weights, axis=1, keepdims=True), 1e-6)
