"""The head "prototype": points of one instance lie together in an embedding space, around their mean.

The mean mu_k of the embeddings e_n of true instance k is its prototype (Snell et al. 2017, prototypical networks). A
point belongs to k with probability softmax_k(-sharpness |e_n - mu_k|^2): no slots and no matching are needed, column
k of that membership is true instance k. n points, i instances, e channels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
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
    surprise = -jnp.where(membership > 0, found.log_membership, 0)
    by_instance, count = jnp.sum(surprise, axis=0), jnp.sum(membership, axis=0)
    per_point = safe.divide(jnp.sum(by_instance), jnp.sum(count))
    num_present = jnp.sum(found.present).astype(count.dtype)
    per_instance = safe.divide(jnp.sum(safe.divide(by_instance, count)), num_present)
    return (per_point + per_instance) / 2


def spread(found: Prototypes, membership: Float[Array, "n i"]) -> Float[Array, ""]:
    """Mean squared distance of the points that have an instance to their own prototype; 0 without such points."""
    return safe.divide(jnp.sum(found.sq_distance), jnp.sum(membership))
