"""Rows of memberships: one-hot where something is known, a softmax where it is predicted, zero elsewhere."""

import jax.numpy as jnp
import numpy as np

from jprimfit.objectives import memberships


def test_true_membership_is_one_hot_and_empty_for_background_padding_and_masked_instances(part):
    truth = part.truth._replace(instance_mask=np.array([True, True, False, True, False, False]))
    found = np.asarray(memberships.of_truth(truth))
    expected = np.zeros((len(truth.labels), 6))
    for row, label in enumerate(truth.labels):
        if label >= 0 and truth.mask[row] and truth.instance_mask[label]:
            expected[row, label] = 1
    np.testing.assert_array_equal(found, expected)
    hidden = truth._replace(mask=np.zeros_like(truth.mask))
    assert not np.asarray(memberships.of_truth(hidden)).any()


def test_a_predicted_row_sums_to_one_and_padding_to_zero():
    logits = jnp.array([[0.0, 0.0], [1000.0, -1000.0], [3.0, 5.0]])
    found = np.asarray(memberships.of_logits(logits, jnp.array([True, True, False])))
    np.testing.assert_allclose(found, [[0.5, 0.5], [1, 0], [0, 0]])
