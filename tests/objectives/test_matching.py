"""Overlaps against loops over the definition, assignments against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jprimfit.objectives import matching

MATCH = jax.jit(matching.match)


def best(iou, rows, columns):
    """Column of every row by SciPy, among rows and columns of the masks."""
    row_index, column_index = np.flatnonzero(rows), np.flatnonzero(columns)
    matched = np.full(len(rows), -1)
    first, second = linear_sum_assignment(-iou[np.ix_(row_index, column_index)])
    matched[row_index[first]] = column_index[second]
    return matched


def test_relaxed_iou_is_the_definition_and_the_iou_of_hard_columns(tolerance):
    generator = np.random.default_rng(0)
    truth = np.eye(3)[generator.integers(0, 3, 20)] * (generator.random((20, 1)) < 0.8)
    truth[:, 2] = 0
    prediction = generator.random((20, 4)) * (generator.random((20, 1)) < 0.9)
    prediction[:, 1] = 0
    prediction[:, 3] = truth[:, 0]
    expected = np.zeros((3, 4))
    for k in range(3):
        for j in range(4):
            shared = sum(truth[n, k] * prediction[n, j] for n in range(20))
            union = truth[:, k].sum() + prediction[:, j].sum() - shared
            expected[k, j] = shared / union if union > 0 else 0
    found = matching.relaxed_iou(jnp.float32(truth), jnp.float32(prediction))
    np.testing.assert_allclose(found, expected, atol=tolerance["float32"])
    assert found[0, 3] == 1
    assert found[2, 1] == 0
    own = matching.own_iou(jnp.float32(truth), jnp.float32(prediction[:, :3]))
    np.testing.assert_allclose(own, np.diag(expected), atol=tolerance["float32"])


@pytest.mark.parametrize("shape", [(5, 8), (8, 5)])
def test_the_assignment_is_the_one_of_largest_sum(shape):
    generator = np.random.default_rng(1)
    for _ in range(40):
        iou = generator.random(shape).astype(np.float32)
        rows, columns = generator.random(shape[0]) < 0.7, generator.random(shape[1]) < 0.8
        np.testing.assert_array_equal(MATCH(iou, rows, columns), best(iou, rows, columns))


def test_masked_instances_never_displace_true_ones():
    iou = np.zeros((8, 5), np.float32)
    iou[0] = 1.0
    for rows in ([6, 7], [0, 3, 4, 5, 7], []):
        mask = np.isin(np.arange(8), rows)
        matched = np.asarray(MATCH(iou, mask, np.ones(5, bool)))
        assert (matched[~mask] == -1).all()
        assert (matched[mask] >= 0).all()
        assert len(set(matched[mask])) == len(rows)


def test_with_more_instances_than_segments_the_worst_go_without():
    iou = np.zeros((8, 5), np.float32)
    iou[np.arange(8), np.arange(8) % 5] = np.linspace(0.1, 0.8, 8)
    matched = np.asarray(MATCH(iou, np.ones(8, bool), np.ones(5, bool)))
    np.testing.assert_array_equal(matched, [-1, -1, -1, 3, 4, 0, 1, 2])


def test_a_pair_without_overlap_is_still_a_pair():
    matched = np.asarray(MATCH(np.zeros((5, 8), np.float32), np.arange(5) < 3, np.arange(8) < 4))
    assert ((matched[:3] >= 0) & (matched[:3] < 4)).all()
    np.testing.assert_array_equal(matched[3:], -1)


def test_what_is_not_finite_counts_as_no_overlap():
    generator = np.random.default_rng(2)
    iou = generator.random((5, 8)).astype(np.float32)
    broken, repaired = iou.copy(), iou.copy()
    broken[1, 2], broken[3, 3:6], repaired[1, 2], repaired[3, 3:6] = np.nan, np.inf, 0, 0
    everything = np.ones(5, bool), np.ones(8, bool)
    np.testing.assert_array_equal(MATCH(broken, *everything), best(repaired, *everything))
    everywhere = np.asarray(MATCH(np.full((5, 8), np.nan, np.float32), *everything))
    assert len(set(everywhere)) == 5


def test_a_batch_is_its_members_and_columns_come_in_order():
    generator = np.random.default_rng(3)
    iou = generator.random((6, 5, 8)).astype(np.float32)
    rows, columns = generator.random((6, 5)) < 0.8, generator.random((6, 8)) < 0.8
    batch = np.asarray(jax.jit(jax.vmap(matching.match))(iou, rows, columns))
    for k in range(6):
        np.testing.assert_array_equal(batch[k], MATCH(iou[k], rows[k], columns[k]))
    prediction = generator.random((10, 8)).astype(np.float32)
    taken = np.asarray(matching.take_columns(jnp.asarray(prediction), jnp.asarray(batch[0])))
    for k, column in enumerate(batch[0]):
        np.testing.assert_array_equal(taken[:, k], prediction[:, column] if column >= 0 else 0)
