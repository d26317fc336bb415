"""Instances from an embedding in which the points of one instance lie together: how many there are, and membership.

Mean shift (Y. Cheng, 1995): seeds climb to the modes of the density of embeddings, modes closer than a merging
distance are one, and the means of the points that are nearest to each mode become the prototypes of a
softmax with the same kernel. Letters: n points, m of them that are looked at, d seeds, e channels, s clusters.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

NUM_CLUSTERS = 64  # capacity
NUM_SEEN = 2048  # points that the density is made of, evenly spaced in the order of the cloud
NUM_SEEDS = 512  # of them, where mean shift starts
# Of the Gaussian kernel, squared units of the embedding. Chosen on validation parts for the shipped network: a wider
# one unites small instances with their neighbours, a narrower one splits large faces. It is sharper than the kernel of
# the loss, exp(-2 |e - mean|^2), whose bandwidth would be 0.25; advice.CLEAR was chosen with it.
SQ_BANDWIDTH = 0.05
SQ_MERGE = 0.25  # squared distance below which two modes are one
MIN_SHARE = 0.003  # of the points that are looked at: fewer are no cluster
MIN_POINTS = 4  # nor are so few of a small cloud: a plane goes through any three
SHIFTS = 10
POLISHES = 3


def cluster(
    embedding: Float[Array, "n e"], mask: Bool[Array, "n"], *, num_clusters: int = NUM_CLUSTERS
) -> Float[Array, "n s"]:
    """Membership of n points in the clusters of their embedding: rows sum to 1, columns of no cluster are 0.

    Args:
        embedding: of the network.
        mask: True = a point; rows of the others are 0.
        num_clusters: capacity s; where there are more clusters, the least dense ones share the others' columns.
    """
    # Padding must not count: the same cloud in a longer array has the same clusters.
    num_points = jnp.sum(mask)
    index, is_seen = _evenly(num_points, min(NUM_SEEN, len(mask)))
    seen = embedding[jnp.flatnonzero(mask, size=len(mask), fill_value=0)[index]]
    weight = is_seen.astype(embedding.dtype)
    index, is_seed = _evenly(jnp.sum(is_seen), min(NUM_SEEDS, len(mask)))
    modes, density = _climb(seen, weight, seen[index], is_seed)
    center, valid = _apart(modes, density, num_clusters)
    enough = jnp.maximum(MIN_SHARE * jnp.sum(weight), MIN_POINTS)
    for _ in range(POLISHES):
        nearest = jnp.argmin(jnp.where(valid[None, :], _sq_distances(seen, center), jnp.inf), axis=1)
        member = (nearest[:, None] == jnp.arange(num_clusters)[None, :]) * (weight[:, None] * valid[None, :])
        total = jnp.sum(member, axis=0)
        center = jnp.where((total > 0)[:, None], member.T @ seen / jnp.maximum(total, 1)[:, None], center)
        # The largest stays in any case: a cloud is never without a cluster.
        valid = valid & ((total >= enough) | (jnp.arange(num_clusters) == jnp.argmax(total)))
    logits = jnp.where(valid[None, :], -_sq_distances(embedding, center) / (2 * SQ_BANDWIDTH), -jnp.inf)
    weights = jnp.exp(logits - jnp.max(logits, axis=1, keepdims=True))
    return jnp.where(mask[:, None], weights / jnp.sum(weights, axis=1, keepdims=True), 0)


def _evenly(count: Int[Array, ""], capacity: int) -> tuple[Int[Array, "m"], Bool[Array, "m"]]:
    """Distinct numbers spaced evenly in 0 .. count - 1, m = capacity of them or all there are; which are no padding."""
    number = jnp.arange(capacity)
    most = jnp.minimum(count, capacity)
    valid = number < most
    return jnp.where(valid, number * count // jnp.maximum(most, 1), 0), valid


def _climb(
    seen: Float[Array, "m e"], weight: Float[Array, "m"], seeds: Float[Array, "d e"], is_seed: Bool[Array, "d"]
) -> tuple[Float[Array, "d e"], Float[Array, "d"]]:
    """Where mean shift leads the seeds, and the density there; -1 for seeds that are none."""

    def kernel(center: Array) -> Array:
        return jnp.exp(-_sq_distances(center, seen) / (2 * SQ_BANDWIDTH)) * weight[None, :]

    def shift(_, center: Array) -> Array:
        near = kernel(center)
        return near @ seen / jnp.maximum(jnp.sum(near, axis=1, keepdims=True), 1e-6)

    modes = lax.fori_loop(0, SHIFTS, shift, seeds)
    return modes, jnp.where(is_seed, jnp.sum(kernel(modes), axis=1), -1)


def _apart(
    modes: Float[Array, "d e"], density: Float[Array, "d"], num_clusters: int
) -> tuple[Float[Array, "s e"], Bool[Array, "s"]]:
    """The densest modes of which no two are closer than the merging distance."""

    def take(number: Array, state: tuple) -> tuple:
        center, valid, left = state
        best = jnp.argmax(left)
        found = left[best] > 0
        near = _sq_distances(modes, modes[best][None, :])[:, 0] <= SQ_MERGE
        left = jnp.where(near | (jnp.arange(len(left)) == best), -1, left)
        return center.at[number].set(modes[best]), valid.at[number].set(found), left

    empty = jnp.zeros((num_clusters, modes.shape[1]), modes.dtype), jnp.zeros(num_clusters, bool), density
    center, valid, _ = lax.fori_loop(0, num_clusters, take, empty)
    return center, valid


def _sq_distances(a: Float[Array, "n e"], b: Float[Array, "s e"]) -> Float[Array, "n s"]:
    product = jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)
    squares = jnp.sum(jnp.square(a), axis=1)[:, None] + jnp.sum(jnp.square(b), axis=1)[None, :]
    return jnp.maximum(squares - 2 * product, 0)
