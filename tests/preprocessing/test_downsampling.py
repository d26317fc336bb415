"""Down-sampling: when it happens, that it is the farthest-point sequence, padding unseen."""

import jax
import numpy as np

from jprimfit.geometry.sampling import farthest_points
from jprimfit.preprocessing.downsampling import downsample

POINTS = np.random.default_rng(0).normal(size=(700, 3)).astype(np.float32)


def test_small_clouds_are_left_alone():
    rows = downsample(POINTS, max_points=700, num_points=64)
    assert rows.dtype == np.int32
    np.testing.assert_array_equal(rows, np.arange(700))


def test_equals_farthest_points_of_the_bare_cloud():
    rows = downsample(POINTS, max_points=699, num_points=64)
    assert rows.dtype == np.int32
    bare = jax.jit(farthest_points, static_argnames="num_samples")(POINTS, num_samples=64)
    np.testing.assert_array_equal(rows, bare)


def test_copies_are_sampled_once():
    rows = downsample(np.tile(POINTS[:10], (70, 1)), max_points=64, num_points=64)
    assert sorted(rows.tolist()) == list(range(10)) and rows[0] == 0


def test_the_spread_is_even():
    line = np.column_stack([np.linspace(0, 1, 700) ** 3, np.zeros((700, 2))]).astype(np.float32)
    gaps = np.diff(np.sort(line[downsample(line, max_points=64, num_points=64), 0]))
    assert gaps.max() < 4 * gaps.min()
