"""What a shipped network says of one cloud: prepare, apply, cluster.

The network sees at most as many points as it was made for, chosen to lie evenly, in the normalised frame. Host code
around one jitted function. Letters: n points of the cloud, m of them that the network sees, s segments.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from jprimfit.geometry import host
from jprimfit.geometry.hierarchy import from_index_sets
from jprimfit.geometry.preparation import Prepared, layout, prepare
from jprimfit.geometry.sampling import optimised_farthest_points
from jprimfit.networks.clustering import cluster
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig
from jprimfit.networks.weights import Model
from jprimfit.programs import stored
from jprimfit.types import Prediction


class Answer(NamedTuple):
    """The network's view of m of the points, NumPy on the host."""

    rows: Int[np.ndarray, "m"]  # int32, of the cloud
    membership: Float32[np.ndarray, "m s"]  # rows sum to 1; columns of no segment are 0
    type_probability: Float32[np.ndarray, "m 4"]  # in the order of primitives/table.KINDS
    normals: Float32[np.ndarray, "m 3"]  # unit, of either sign


class Sample(NamedTuple):
    """The points that a network sees, at most as many as it was made for, chosen to lie evenly."""

    rows: Int[np.ndarray, "m"]  # int32, of the cloud, ascending
    cloud: Prepared  # m points in the normalised frame, then padding to the size of the network


def ask(model: Model, points: Float[np.ndarray, "n 3"]) -> Answer:
    """The answer of a network for a cloud of n >= 1 points in any frame."""
    config = model.config
    expected = layout(spec=config.hierarchy, neighborhoods=config.neighborhoods, num_points=config.num_points)
    with ThreadPoolExecutor(1) as beside:
        # Compiling the network takes as long as all that comes before it; should it fail, the call below says why.
        beside.submit(_apply.prepare, model.variables, expected, config=config)
        rows, cloud = sample(config, points)
    membership, types, normals = jax.device_get(_apply(model.variables, cloud, config=config))
    valid = slice(0, len(rows))
    return Answer(rows, membership[valid], types[valid], normals[valid])


def sample(config: SegmenterConfig, points: Float[np.ndarray, "n 3"]) -> Sample:
    """What a network of these settings is given of a cloud of n >= 1 points in any frame."""
    rows = np.arange(len(points), dtype=np.int32)
    if len(points) > config.num_points:
        rows = _even_rows(points, config.num_points)
    scaled, _ = host.normalize(points[rows])
    return Sample(
        rows,
        prepare(scaled, spec=config.hierarchy, neighborhoods=config.neighborhoods, num_points=config.num_points),
    )


def _even_rows(points: Float[np.ndarray, "n 3"], num_samples: int) -> Int[np.ndarray, " m"]:
    """Ascending rows of points that lie evenly; compiled once for all clouds up to a power of two."""
    scaled, _ = host.normalize(points)
    copies = (1 << (len(points) - 1).bit_length()) - len(points)
    # A copy of the first point is as far from the chosen ones as that point itself.
    padded = np.concatenate([scaled, np.repeat(scaled[:1], copies, axis=0)])
    chosen = np.asarray(_sample(padded, num_samples=num_samples))
    return np.unique(np.where(chosen < len(points), chosen, 0)).astype(np.int32)


def segment(
    segmenter: Any,
    variables: Any,
    cloud: Any,
    query: Int[Array, "q"] | None = None,
    mask: Bool[Array, "q"] | None = None,
    *,
    pooled: bool,
) -> tuple[Prediction, Float[Array, "q s"]]:
    """What a network says of one cloud, and the membership that follows from it; a function of JAX arrays.

    Args:
        segmenter: a Segmenter.
        variables: its parameters and statistics.
        cloud: with the fields of geometry/preparation.Prepared.
        query: rows of the points that are asked for; None = all.
        mask: which of those are no padding; None = as the cloud says.
        pooled: the network judges the types of whole segments (config.types), those that it found.
    """
    hierarchy = from_index_sets(cloud.points, cloud.sets, cloud.mask)
    inputs = (cloud.points, hierarchy, cloud.local_normals, cloud.curvature, query)
    valid: Any = cloud.mask if mask is None else mask
    prediction: Prediction = segmenter.apply(variables, *inputs, train=False)
    if prediction.embedding is not None:
        membership = cluster(prediction.embedding, valid)
    else:
        logits: Any = prediction.membership_logits
        membership = jnp.where(valid[:, None], jax.nn.softmax(logits, axis=1), 0)
    if pooled:
        # The same network on the same cloud: the compiler merges what both calls have in common.
        judged = segmenter.apply(variables, *inputs, train=False, segments=membership)
        prediction = prediction._replace(segment_type_logits=judged.segment_type_logits)
    return prediction, membership


_sample = stored(optimised_farthest_points, static_argnames="num_samples")


@partial(stored, static_argnames="config")
def _apply(variables: Any, prepared: Prepared, *, config: SegmenterConfig) -> tuple[Array, Array, Array]:
    """Membership, type probabilities and normals of all points of a prepared cloud."""
    prediction, membership = segment(Segmenter(config), variables, prepared, pooled=config.types == "pooled")
    if prediction.segment_type_logits is None:
        types = jax.nn.softmax(prediction.type_logits, axis=1)
    else:
        types = membership @ jax.nn.softmax(prediction.segment_type_logits, axis=1)
    return membership, types, prediction.normals
