"""A network is asked about clouds of any size and frame: rows, shapes, and the same answer as by hand."""

import jax
import numpy as np
import pytest

from jprimfit.geometry import host
from jprimfit.geometry.preparation import prepare
from jprimfit.networks.clustering import NUM_CLUSTERS
from jprimfit.networks.inference import ask
from jprimfit.networks.pointconv import PointConvConfig
from jprimfit.networks.segmenter import SegmenterConfig
from jprimfit.networks.weights import Model

NUM_POINTS = 40
WIDTHS = PointConvConfig(encoder=((8,), (8, 8)), decoder=((8,), (8, 8)), weight_channels=4, grouped=False)


def config_of(toy, head, types):
    return SegmenterConfig(
        hierarchy=toy.spec,
        pointconv=WIDTHS,
        num_points=NUM_POINTS,
        features=("xyz", "pca"),
        neighborhoods=(6, 9),
        head=head,
        num_slots=5,
        embedding_size=4,
        shared=8,
        types=types,
        normals="pca",
    )


@pytest.fixture(scope="module", params=[("slots", "pooled"), ("prototype", "point")], ids=lambda pair: pair[0])
def model(request, toy):
    config = config_of(toy, *request.param)
    return Model(config, toy.segmenter_variables(config), "toy", {})


def cloud(num_points, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (num_points, 3))


@pytest.mark.parametrize("num_points", [1, 25, NUM_POINTS, 90])
def test_every_row_that_is_seen_has_its_answer(model, num_points):
    found = ask(model, cloud(num_points))
    assert found.rows.dtype == np.int32 and np.all(np.diff(found.rows) > 0)
    assert len(found.rows) == min(num_points, NUM_POINTS) and found.rows[-1] < num_points
    columns = NUM_CLUSTERS if model.config.head == "prototype" else 5
    assert found.membership.shape == (len(found.rows), columns)
    assert found.type_probability.shape == (len(found.rows), 4) and found.normals.shape == (len(found.rows), 3)
    assert all(np.isfinite(leaf).all() for leaf in found)
    if num_points > 1:
        np.testing.assert_allclose(np.sum(found.normals**2, axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(found.membership.sum(axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(found.type_probability.sum(axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("num_points", [25, 90])
def test_unit_and_place_of_the_cloud_are_nothing(model, num_points):
    points = cloud(num_points)
    one, other = ask(model, points), ask(model, 1024 * points + np.array([1e4, -2e4, 3e3]))
    np.testing.assert_array_equal(one.rows, other.rows)
    np.testing.assert_allclose(one.membership, other.membership, atol=1e-3)
    np.testing.assert_allclose(one.type_probability, other.type_probability, atol=1e-3)
    np.testing.assert_allclose(np.abs(np.sum(one.normals * other.normals, axis=1)), 1, atol=1e-3)


def test_the_sample_lies_evenly(model):
    points = cloud(90)
    points[60:] = points[0] + 1e-4 * points[60:]  # a clump
    assert np.sum(ask(model, points).rows >= 60) <= 1


def test_slots_are_those_of_the_network(toy):
    config = config_of(toy, "slots", "point")
    model = Model(config, toy.segmenter_variables(config), "toy", {})
    points, _ = host.normalize(cloud(25))
    found = ask(model, points)
    prepared = prepare(points, spec=toy.spec, neighborhoods=(6, 9), num_points=NUM_POINTS, workers=1)
    expected = toy.answer(model.variables, prepared, config=config)
    np.testing.assert_allclose(found.membership, jax.nn.softmax(expected.membership_logits)[:25], atol=1e-4)
    np.testing.assert_allclose(found.type_probability, jax.nn.softmax(expected.type_logits)[:25], atol=1e-4)
