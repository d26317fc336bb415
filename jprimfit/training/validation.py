"""How good the network is while it learns: three of the six metrics over fixed clouds, without fitting anything.

The hard segments and their types are those of objectives/metrics; evaluation/ measures all six.
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jprimfit.data.examples import Example
from jprimfit.geometry.hierarchy import from_index_sets
from jprimfit.networks.clustering import cluster
from jprimfit.objectives import memberships, metrics
from jprimfit.types import Prediction

NAMES = ("miou", "type_accuracy", "normal_deg")  # shares in [0, 1], degrees
SCORES = (*NAMES, "num_segments")


def validator(segmenter: Any, *, pooled: bool) -> Callable[[Any, Iterable[Example]], dict[str, float]]:
    """The function (variables, batches of examples) -> mean of each metric over all clouds that have it.

    segmenter: a networks/segmenter.Segmenter.
    pooled: the network judges the types of whole segments, those that it found.
    """

    @jax.jit
    def scores(variables: Any, example: Example) -> dict[str, Array]:
        def one(example):
            prediction, membership = segmentation(segmenter, variables, example, pooled=pooled)
            points = example.points[example.query.astype(jnp.int32)]
            segments = metrics.segments_of(
                points,
                membership,
                prediction.type_logits,
                prediction.normals,
                example.truth.mask,
                prediction.segment_type_logits,
            )
            # Of the scores that are not asked for, the compiler drops the fits.
            found = metrics.score(segments, points, example.truth)._asdict()
            return {**{name: found[name] for name in NAMES}, "num_segments": jnp.sum(segments.mask)}

        return jax.vmap(one)(example)

    def validate(variables: Any, batches: Iterable[Example]) -> dict[str, float]:
        parts = [jax.device_get(scores(variables, batch)) for batch in batches]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in SCORES}
        return {name: _mean(values) for name, values in columns.items()}

    return validate


def segmentation(
    segmenter: Any, variables: Any, example: Example, *, pooled: bool
) -> tuple[Prediction, Float[Array, "q s"]]:
    """The prediction for one cloud and the soft membership in it, a row for each query."""
    hierarchy = from_index_sets(example.points, example.sets, example.mask)
    inputs = (example.points, hierarchy, example.local_normals, example.curvature, example.query)
    prediction: Prediction = segmenter.apply(variables, *inputs, train=False)
    mask = example.truth.mask
    if prediction.embedding is not None:
        membership = cluster(prediction.embedding, mask)
    else:
        membership = memberships.of_logits(prediction.membership_logits, mask)  # pyright: ignore[reportArgumentType]
    if pooled:
        # The same network on the same cloud again: the compiler merges what both have in common.
        judged = segmenter.apply(variables, *inputs, train=False, segments=membership)
        prediction = prediction._replace(segment_type_logits=judged.segment_type_logits)
    return prediction, membership


def _mean(values: Num[np.ndarray, "b"]) -> float:
    """Mean of what is there to score, 0 where nothing is."""
    scored = values[~np.isnan(values)]
    return float(np.mean(scored)) if scored.size else 0.0
