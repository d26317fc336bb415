"""A fresh cloud is given to the network as the same cloud of a pool would be."""

import dataclasses

import jax
import numpy as np
import pytest

from jprimfit.data.examples import Scan
from jprimfit.geometry.preparation import prepare
from jprimfit.networks.segmenter import SegmenterConfig
from jprimfit.training.config import from_mapping
from jprimfit.training.inputs import _least_spread, network_inputs


def test_searches_on_the_device_are_those_of_the_host(toy_mapping, toy_batch):
    model: SegmenterConfig = from_mapping(toy_mapping, source="c.yaml").model
    model = dataclasses.replace(model, neighborhoods=(0, *model.neighborhoods, 20))
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (80, 3)).astype(np.float32)
    points[:, 2] = 0.3 * points[:, 0] ** 2 + 0.01 * generator.normal(size=80)
    prepared = prepare(points, spec=model.hierarchy, neighborhoods=model.neighborhoods, num_points=96)
    truth = jax.tree.map(lambda x: x[0], toy_batch.truth)
    query = np.arange(96, dtype=np.int32)
    fresh = jax.jit(lambda scan: network_inputs(scan, model=model))(Scan(prepared.points, prepared.mask, query, truth))
    stored = toy_batch._replace(**prepared._asdict(), query=query, truth=truth)
    expected = jax.jit(lambda example: network_inputs(example, model=model))(stored)
    turned = np.sum(fresh[2] * expected[2], axis=-1)
    np.testing.assert_allclose(np.abs(turned), 1.0, atol=1e-4)
    np.testing.assert_allclose(fresh[3], expected[3], atol=1e-5)
    for a, b in zip(fresh[1].encoder_groups + fresh[1].decoder_groups,
                    expected[1].encoder_groups + expected[1].decoder_groups, strict=True):  # fmt: skip
        np.testing.assert_array_equal(a.mask, b.mask)
        np.testing.assert_allclose(a.sq_distance, b.sq_distance, atol=1e-4)


@pytest.mark.parametrize("values", [(1e-6, 0.3, 0.7), (0.0, 0.0, 1.0), (0.3, 0.3, 0.4), (0.0, 0.0, 0.0)])
def test_the_direction_of_least_spread(values):
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    matrix = (turn * np.array(values)[None]) @ turn.T
    direction, curvature = jax.jit(_least_spread)(matrix.astype(np.float32))
    direction = np.asarray(direction, np.float64)
    assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(matrix @ direction, min(values) * direction, atol=1e-6)
    assert curvature == pytest.approx(min(values), abs=1e-6)
