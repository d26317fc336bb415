"""The head "prototype": points of one instance lie together in an embedding space, around their mean.

The mean mu_k of the embeddings e_n of true instance k is its prototype (Snell et al. 2017, prototypical networks). A
point belongs to k with probability softmax_k(-sharpness |e_n - mu_k|^2): no slots and no matching are needed, column
k of that membership is true instance k. n points, i instances, e channels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST


class Prototypes(NamedTuple):
    """The mean embedding of every true instance, and the points' membership in them."""

    centers: Float[Array, "i e"]  # relative to the mean embedding of the points that have an instance
    present: Bool[Array, " i"]  # False = no point of the instance is here; its center is 0, its column is 0
    log_membership: Float[Array, "n i"]  # log-softmax over the instances present, very negative elsewhere
    sq_distance: Float[Array, " n"]  # of each point to its own center, 0 for background and padding


def prototypes(
    embedding: Float[Array, "n e"], membership: Float[Array, "n i"], *, sharpness: float = 2.0
) -> Prototypes:
    """Means, membership and spread of embeddings under a true membership (one-hot rows, zero rows of background)."""
    count = jnp.sum(membership, axis=0)
    present = count > 0
    # A softmax over distances does not see a common shift, but the products below lose digits to it.
    labelled = jnp.sum(membership, axis=1)
    shift = safe.divide(jnp.matmul(labelled, embedding, precision=HIGHEST), jnp.sum(labelled))
    embedding = embedding - jax.lax.stop_gradient(shift)[None, :]
    centers = safe.divide(jnp.matmul(membership.T, embedding, precision=HIGHEST), count[:, None])
    # -|e - mu|^2 but for |e|^2, which is the same for all instances.
    closeness = 2 * jnp.matmul(embedding, centers.T, precision=HIGHEST) - jnp.sum(centers * centers, axis=1)[None, :]
    logits = jnp.where(present[None, :], sharpness * closeness, jnp.finfo(embedding.dtype).min / 2)
    difference = embedding - jnp.matmul(membership, centers, precision=HIGHEST)
    sq_distance = jnp.sum(difference * difference, axis=1) * labelled
    return Prototypes(centers, present, jax.nn.log_softmax(logits, axis=1), sq_distance)


def membership_of(found: Prototypes, membership: Float[Array, "n i"]) -> Float[Array, "n i"]:
    """Probability of every point that has an instance to belong to each of them; zero rows for all other points.

    Background stays out, because a softmax over the true instances leaves it no place to go: it would be shared out
    among them and spoil their fits.
    """
    has_instance = jnp.sum(membership, axis=1) > 0
    return jnp.where(has_instance[:, None] & found.present[None, :], jnp.exp(found.log_membership), 0)


def cross_entropy(found: Prototypes, membership: Float[Array, "n i"]) -> Float[Array, ""]:
    """-log membership in the own instance: half its mean over points, half the mean over instances of their means.

    Background and padding do not count; 0 where no point has an instance. The second half keeps small instances from
    drowning among large ones.
    """
    return _balanced(-jnp.where(membership > 0, found.log_membership, 0), membership)


def spread(found: Prototypes, membership: Float[Array, "n i"]) -> Float[Array, ""]:
    """Squared distance of the points to their own prototype, in the mean of cross_entropy."""
    return _balanced(membership * found.sq_distance[:, None], membership)


def similarity(
    embedding: Float[Array, "n e"], membership: Float[Array, "n i"], *, num_seeds: int = 128, sharpness: float = 2.0
) -> Float[Array, ""]:
    """How badly exp(-sharpness |e_n - e_m|^2) tells whether points n and m are of one instance: -log of the truth.

    m runs over num_seeds rows at even steps, n over all. Of a seed the mean over its own instance counts, and the sum
    over the others of their means, since only those beside it are hard to tell; seeds in the mean of cross_entropy
    (after Fathi et al. 2017, "Semantic instance segmentation via deep metric learning").
    """
    seeds = np.arange(num_seeds) * len(embedding) // num_seeds
    shift = jax.lax.stop_gradient(jnp.mean(embedding, axis=0))[None, :]
    embedding = embedding - shift
    square = jnp.sum(embedding * embedding, axis=1)
    product = jnp.matmul(embedding[seeds], embedding.T, precision=HIGHEST)
    distance = sharpness * jnp.maximum(square[seeds, None] + square[None, :] - 2 * product, 0)
    share = membership / jnp.maximum(jnp.sum(membership, axis=0), 1)[None, :]  # of a point in its instance
    same = jnp.matmul(membership[seeds], membership.T)
    apart = jnp.where(same > 0, 0, -jnp.log(-jnp.expm1(-jnp.maximum(distance, 1e-3))))
    surprise = jnp.sum((distance * same + apart) * jnp.sum(share, axis=1)[None, :], axis=1)
    return _balanced(surprise[:, None] * membership[seeds], membership[seeds])


def _balanced(values: Float[Array, "n i"], membership: Float[Array, "n i"]) -> Float[Array, ""]:
    """Half the mean over points, half the mean over instances of their means; 0 where no point has an instance."""
    by_instance, count = jnp.sum(values, axis=0), jnp.sum(membership, axis=0)
    per_point = safe.divide(jnp.sum(by_instance), jnp.sum(count))
    num_present = jnp.sum(count > 0).astype(count.dtype)
    per_instance = safe.divide(jnp.sum(safe.divide(by_instance, count)), num_present)
    return (per_point + per_instance) / 2
