"""The assignment against SciPy's: the same total cost, also among ties, and no column twice."""

import jax
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jprimfit.objectives.hungarian import assign

ASSIGN = jax.jit(jax.vmap(assign))
NUM_COSTS, NUM_ROWS, NUM_COLUMNS = 50, 7, 9


def costs(name, generator):
    shape = NUM_COSTS, NUM_ROWS, NUM_COLUMNS
    if name == "overlaps":
        return -(generator.random(shape) ** 4)
    if name == "ties":
        return np.round(3 * generator.random(shape))
    if name == "equal":
        return np.ones(shape)
    # Every row wants the column of the row before it, so that paths grow long.
    return np.outer(np.arange(NUM_ROWS), np.arange(NUM_COLUMNS))[None] * generator.choice(
        [-1.0, 1.0], (NUM_COSTS, 1, 1)
    )


@pytest.mark.parametrize("name", ["overlaps", "ties", "equal", "long paths"])
def test_no_other_assignment_costs_less(name):
    generator = np.random.default_rng(0)
    cost = costs(name, generator).astype(np.float32)
    mask = generator.random((NUM_COSTS, NUM_ROWS)) < generator.random((NUM_COSTS, 1))
    for each, rows, columns in zip(cost, mask, np.asarray(ASSIGN(cost, mask)), strict=True):
        np.testing.assert_array_equal(columns[~rows], -1)
        assert (columns[rows] >= 0).all()
        assert len(set(columns[rows])) == rows.sum()
        best = each[rows][linear_sum_assignment(each[rows])].sum()
        np.testing.assert_allclose(each[rows, columns[rows]].sum(), best, atol=1e-5)


def test_too_few_columns_are_refused():
    with pytest.raises(ValueError, match="4 rows for 3 columns"):
        jax.eval_shape(assign, np.zeros((4, 3), np.float32), np.ones(4, bool))
