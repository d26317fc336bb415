"""What a network is told of a point: channels, values, and nothing of any sign."""

import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks.inputs import point_features

GENERATOR = np.random.default_rng(0)
POINTS = GENERATOR.normal(size=(6, 3)).astype(np.float32)
NORMALS = GENERATOR.normal(size=(6, 2, 3)).astype(np.float32)
NORMALS /= np.sqrt(np.sum(NORMALS**2, axis=-1, keepdims=True))
CURVATURE = GENERATOR.uniform(0, 1 / 3, (6, 2)).astype(np.float32)


def features_of(normals, *, features=("xyz", "pca")):
    return np.asarray(point_features(jnp.array(POINTS), jnp.array(normals), jnp.array(CURVATURE), features=features))


@pytest.mark.parametrize("features,channels", [(("xyz",), 3), (("pca",), 14), (("xyz", "pca"), 17)])
def test_channels(features, channels):
    assert features_of(NORMALS, features=features).shape == (6, channels)


def test_every_channel_by_hand(tolerance):
    found = features_of(NORMALS)
    np.testing.assert_array_equal(found[:, :3], POINTS)
    for row in range(6):
        for size in range(2):
            shape = found[row, 3 + 7 * size : 10 + 7 * size]
            product = np.outer(NORMALS[row, size], NORMALS[row, size])
            np.testing.assert_allclose(shape[:6], product[np.triu_indices(3)], atol=tolerance["float32"])
            np.testing.assert_allclose(shape[6], 2 * np.sqrt(CURVATURE[row, size]), atol=tolerance["float32"])


def test_signs_of_normals_do_not_enter():
    signs = np.where(GENERATOR.uniform(size=(6, 2, 1)) < 0.5, -1, 1).astype(np.float32)
    np.testing.assert_array_equal(features_of(NORMALS), features_of(NORMALS * signs))
