"""The scores that a training sees, from answers that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.training.validation import SCORES, validator
from jprimfit.types import Prediction


class Oracle:
    """A network that knows the truth of the toy clouds: their labels stand in the first PCA direction."""

    def __init__(self, head):
        self.head = head

    def apply(self, variables, points, hierarchy, local_normals, curvature, query, *, train, segments=None):
        assert not train
        label = curvature[:, 0].astype(jnp.int32)
        one_hot = 20.0 * jax.nn.one_hot(label, 4)
        sphere_logits = jax.nn.one_hot((label == 2).astype(jnp.int32), 4)
        return Prediction(
            normals=variables["turn"] * local_normals[:, 0],
            type_logits=variables["spoil"][None, :] + sphere_logits,
            features=points,
            membership_logits=one_hot if self.head == "slots" else None,
            embedding=one_hot if self.head == "prototype" else None,
            segment_type_logits=None if segments is None else jax.nn.one_hot(jnp.array([0, 0, 1, 0]), 4),
        )


@pytest.fixture
def told(toy_batch):
    """The toy clouds with the truth where the oracle looks for it."""
    labels = np.maximum(toy_batch.truth.labels, 0).astype(np.float32)
    return toy_batch._replace(curvature=labels[:, :, None], local_normals=toy_batch.truth.normals[:, :, None, :])


def halves(batch):
    return [jax.tree.map(lambda x, r=rows: x[r], batch) for rows in (slice(0, 4), slice(4, 8))]


@pytest.mark.parametrize(("head", "pooled"), [("slots", False), ("prototype", False), ("slots", True)])
def test_the_truth_scores_best(told, head, pooled):
    # Only whole segments are judged right where the points are not.
    spoil = jnp.array([0.0, 0.0, 0.0, 9.0 if pooled else 0.0])
    variables = {"turn": jnp.array(-1.0), "spoil": spoil}
    scores = validator(Oracle(head), pooled=pooled)(variables, halves(told))
    assert tuple(scores) == SCORES
    np.testing.assert_allclose([scores["miou"], scores["type_accuracy"]], 1.0, atol=1e-6)
    assert scores["normal_deg"] < 0.1 and scores["num_segments"] == 3


def test_wrong_types_are_counted_by_instances(told):
    variables = {"turn": jnp.array(1.0), "spoil": jnp.array([9.0, 0.0, 0.0, 0.0])}
    scores = validator(Oracle("slots"), pooled=False)(variables, halves(told))
    np.testing.assert_allclose(scores["type_accuracy"], 2 / 3, rtol=1e-5)
