"""How good the network is while it learns: three of the six metrics over fixed clouds, without fitting anything.

The hard segments and their types are those of objectives/metrics; evaluation/ measures all six.
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Num

from jprimfit.data.examples import Example
from jprimfit.networks.inference import segment
from jprimfit.objectives import metrics

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
            query = example.query.astype(jnp.int32)
            prediction, membership = segment(segmenter, variables, example, query, example.truth.mask, pooled=pooled)
            points = example.points[query]
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


def _mean(values: Num[np.ndarray, "b"]) -> float:
    """Mean of what is there to score, 0 where nothing is."""
    scored = values[~np.isnan(values)]
    return float(np.mean(scored)) if scored.size else 0.0
