"""Farthest points against a loop, and the bucketed form against the plain one on clouds of every kind."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jprimfit.geometry import sampling

FORMS = {"plain": sampling.farthest_points, "bucketed": partial(sampling.optimised_farthest_points, bucket_size=32)}


def loop(points, valid, num_samples):
    """The definition, in NumPy: exact on whole numbers."""
    points = np.asarray(points)
    chosen = [int(np.argmax(valid))]
    for _ in range(num_samples - 1):
        sq = np.min([np.sum((points - points[c]) ** 2, axis=1) for c in chosen], axis=0)
        chosen.append(int(np.argmax(np.where(valid, sq, -1))))
    return np.array(chosen, np.int32)


def clouds(num_points):
    """Twenty-four clouds: volumes, surfaces, clusters, whole-number grids full of ties, duplicates, outliers."""
    random = np.random.default_rng(num_points)
    normal, uniform = random.normal(size=(num_points, 3)), random.random((num_points, 3))
    sphere = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    circle = sphere[:, :2] / np.linalg.norm(sphere[:, :2], axis=1, keepdims=True)
    rows = np.arange(num_points)
    box = uniform.copy()
    box[rows, random.integers(0, 3, num_points)] = random.integers(0, 2, num_points)
    lattice = np.stack([rows % 8, rows // 8 % 8, rows // 64], axis=1)
    few = random.integers(0, num_points // 5, num_points)
    outlier = uniform.copy()
    outlier[7] = 1e6
    return {
        "cube": uniform,
        "gauss": normal,
        "far from the origin": uniform + 1000,
        "tiny": uniform * 1e-12,
        "large": uniform * 1e8,
        "sphere": sphere,
        "noisy sphere": sphere + 0.01 * uniform,
        "cylinder": np.concatenate([circle, uniform[:, 2:]], axis=1),
        "cone": np.concatenate([circle * uniform[:, 2:], uniform[:, 2:]], axis=1),
        "box": box * [2, 1, 0.3],
        "plane": uniform * [1, 1, 0],
        "tilted plane": uniform[:, :2] @ normal[:2],
        "line": uniform * [1, 0, 0],
        "clusters": 0.01 * normal + uniform[random.integers(0, 9, num_points)],
        "dense and sparse": uniform ** [1, 3, 9],
        "one outlier": outlier,
        "lattice": lattice,
        "shuffled lattice": random.permutation(lattice),
        "whole numbers": random.integers(0, 4, (num_points, 3)),
        "signed whole numbers": random.integers(-20, 20, (num_points, 3)),
        "flat lattice": np.stack([rows % 32, rows // 32, 0 * rows], axis=1),
        "duplicates": uniform[few],
        "duplicates in order": np.sort(uniform[few], axis=0),
        "one position": np.ones((num_points, 3)),
    }


@pytest.mark.parametrize("num_points", [1000, 1024])
def test_the_bucketed_sequence_is_the_plain_one(num_points):
    plain = jax.jit(partial(sampling.farthest_points, num_samples=300))
    bucketed = jax.jit(partial(FORMS["bucketed"], num_samples=300))
    one_level = jax.jit(partial(sampling.optimised_farthest_points, num_samples=300, bucket_size=400))
    different = []
    for name, cloud in clouds(num_points).items():
        points = jnp.asarray(cloud, jnp.float32)
        expected = np.asarray(plain(points))
        if not all(np.array_equal(form(points), expected) for form in (bucketed, one_level)):
            different.append(name)
    assert not different


def test_a_large_cloud_keeps_the_sequence():
    points = jnp.asarray(np.random.default_rng(5).random((20_000, 3)), jnp.float32)
    plain = jax.jit(partial(sampling.farthest_points, num_samples=1500))(points)
    bucketed = jax.jit(partial(sampling.optimised_farthest_points, num_samples=1500))(points)
    np.testing.assert_array_equal(bucketed, plain)


@pytest.mark.parametrize("form", FORMS)
def test_agrees_with_a_loop(form):
    sample = jax.jit(partial(FORMS[form], num_samples=120))
    for seed in range(4):
        random = np.random.default_rng(seed)
        cloud, valid = random.integers(0, 6, (200, 3)), random.random(200) < 0.7
        result = sample(jnp.asarray(cloud, jnp.float32), jnp.asarray(valid))
        np.testing.assert_array_equal(result, loop(cloud, valid, 120))
        assert result.dtype == jnp.int32


@pytest.mark.parametrize("form", FORMS)
def test_corners_of_a_square_by_hand(form):
    square = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    np.testing.assert_array_equal(FORMS[form](square, num_samples=5), [0, 2, 1, 3, 4])


@pytest.mark.parametrize("form", FORMS)
def test_more_samples_than_points_repeat_the_first_valid_one(form):
    points = jnp.array([[9.0, 9, 9], [0, 0, 0], [3, 0, 0], [1, 0, 0], [3, 0, 0]])
    mask = jnp.array([False, True, True, True, True])
    np.testing.assert_array_equal(FORMS[form](points, mask, num_samples=6), [1, 2, 3, 1, 1, 1])
    np.testing.assert_array_equal(FORMS[form](points, jnp.zeros(5, bool), num_samples=3), [0, 0, 0])
    np.testing.assert_array_equal(FORMS[form](points[:1], num_samples=2), [0, 0])


@pytest.mark.parametrize("form", FORMS)
def test_padding_scale_and_shift_by_whole_numbers_change_nothing(form):
    points = jnp.asarray(np.random.default_rng(6).integers(0, 9, (200, 3)), jnp.float32)
    sample = jax.jit(partial(FORMS[form], num_samples=50))
    plain = sample(points)
    np.testing.assert_array_equal(sample(points * 0.25), plain)
    np.testing.assert_array_equal(sample(points[:, ::-1] - 77), plain)
    padded = jnp.concatenate([points, jnp.full((56, 3), 1e3)])
    np.testing.assert_array_equal(sample(padded, jnp.arange(256) < 200), plain)


def test_the_plain_form_under_vmap_and_the_bucketed_under_map():
    first, second = (jnp.asarray(cloud, jnp.float32) for cloud in list(clouds(1000).values())[:2])
    alone = sampling.farthest_points(first, num_samples=40)
    both = jnp.stack([first, second])
    mapped = jax.jit(lambda p: lax.map(partial(FORMS["bucketed"], num_samples=40), p))(both)
    vmapped = jax.jit(jax.vmap(partial(sampling.farthest_points, num_samples=40)))(both)
    bucketed = jax.jit(jax.vmap(partial(FORMS["bucketed"], num_samples=40)))(both)
    for result in (mapped, vmapped, bucketed):
        np.testing.assert_array_equal(result[0], alone)
        np.testing.assert_array_equal(result[1], mapped[1])


@pytest.mark.parametrize("form", FORMS)
def test_one_trace_serves_two_clouds_and_gradients_pass_by(form):
    first, second = (jnp.asarray(cloud, jnp.float32) for cloud in list(clouds(1000).values())[:2])
    chex.clear_trace_counter()
    sample = jax.jit(chex.assert_max_traces(lambda p: FORMS[form](p, num_samples=40), n=1))
    sample(first), sample(second)
    gradient = jax.jit(jax.grad(lambda p: p[FORMS[form](p, num_samples=40)].sum()))(first)
    assert float(gradient.sum()) == 120  # each of the 40 chosen rows once


def test_double_precision_sees_what_single_does_not(x64):
    offsets = jnp.array([0.0, 1, 3, 2]) * 1e-9
    points = jnp.stack([1 + offsets, jnp.zeros(4), jnp.zeros(4)], axis=1)
    for form in FORMS.values():
        np.testing.assert_array_equal(form(points, num_samples=2), [0, 2])


@pytest.mark.parametrize("form", FORMS)
def test_impossible_requests_are_refused(form):
    with pytest.raises(ValueError, match="at least one point and one sample"):
        FORMS[form](jnp.zeros((0, 3)), num_samples=4)
    with pytest.raises(ValueError, match="at least one point and one sample"):
        FORMS[form](jnp.zeros((4, 3)), num_samples=0)


def test_an_empty_bucket_is_refused():
    with pytest.raises(ValueError, match="bucket_size is 0"):
        sampling.optimised_farthest_points(jnp.zeros((4, 3)), num_samples=2, bucket_size=0)
