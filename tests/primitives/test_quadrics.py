"""The quadric of every kind against its distance, and the promise of f(X) k: mean 0 around any point of the surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.evaluation.patches import CONE, CYLINDER, PLANE, SPHERE, Patch
from jprimfit.primitives.table import KINDS, MODULES

PATCHES = {
    "plane": Patch("plane", PLANE, (-1.0, 1.0, -1.0, 1.0)),
    "sphere": Patch("sphere", SPHERE, (-1.0, 1.0, 0.0, 6.0)),
    "cylinder": Patch("cylinder", CYLINDER, (-6.0, 6.0, 0.0, 6.0)),
    "cone": Patch("cone", CONE, (1.0, 6.0, 0.0, 6.0)),
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def posed(kind):
    """A primitive off the origin, and clean points on it."""
    module, points = MODULES[kind], PATCHES[kind].draw(np.random.default_rng(0), 200)
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift, scale = jnp.array([0.3, -0.2, 0.1]), 0.2
    primitive = module.transform(jax.tree.map(jnp.asarray, PATCHES[kind].truth), jnp.asarray(turn), shift, scale)
    return module.canonical(primitive, jnp.zeros(3)), jnp.asarray(scale * points @ turn.T + np.asarray(shift))


@each_kind
def test_the_quadric_is_zero_on_the_surface_with_the_gradient_that_is_said(x64, kind):
    primitive, points = posed(kind)
    quadric = MODULES[kind].quadric(primitive)
    np.testing.assert_allclose(quadric.value(points), 0, atol=1e-12)
    slope = jax.vmap(jax.grad(lambda x: quadric.value(x[None])[0]))(points)
    found = MODULES[kind].instruments(primitive, points, jnp.array(0.0))
    np.testing.assert_allclose(jnp.linalg.norm(slope, axis=1) * found.scale, 1, rtol=1e-9)
    np.testing.assert_allclose(np.asarray(quadric.matrix), np.asarray(quadric.matrix).T, atol=1e-12)


@each_kind
def test_instruments_span_what_the_distances_say(x64, kind):
    # Equations may be combined: the derivatives of the distances are combinations of the weights over the scale.
    primitive, points = posed(kind)
    module = MODULES[kind]
    found = module.instruments(primitive, points, jnp.array(0.0))
    weights = np.stack(found.weights, axis=1) / np.asarray(found.scale)[:, None]
    jacobian = jax.jacfwd(lambda step: module.signed_distance(module.retract(primitive, step), points))
    wanted = np.asarray(jacobian(jnp.zeros(module.NUM_FREEDOM)))
    combined = weights @ np.linalg.lstsq(weights, wanted, rcond=None)[0]
    np.testing.assert_allclose(combined, wanted, atol=1e-9)


@each_kind
def test_the_product_has_mean_zero_around_every_point_of_the_surface(x64, kind):
    primitive, points = posed(kind)
    module, foot, sigma = MODULES[kind], points[7], 0.25
    rng = np.random.default_rng(2)
    draws = jnp.asarray(np.asarray(foot) + sigma * rng.normal(size=(400_000, 3)))
    quadric, variance = module.quadric(primitive), jnp.array(sigma**2)

    @jax.jit
    @jax.vmap
    def product(point):
        def weights(at):
            return jnp.stack(module.instruments(primitive, at[None], variance).weights)[:, 0]

        slope = jax.grad(lambda x: quadric.value(x[None])[0])(point)
        along, curved = jax.jacfwd(weights)(point) @ slope, jax.jacfwd(jax.jacfwd(weights))(point)
        bent = jnp.einsum("cd,pcd->p", quadric.matrix, curved)
        level = quadric.value(point[None])[0] - variance * jnp.trace(quadric.matrix)
        return level * weights(point) - variance * along + variance**2 * bent

    found = np.asarray(product(draws))
    error = found.std(axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(found.mean(axis=0)) < 4 * error)
