"""Distances, normals, steps and closed forms of the host equal those of primitives/; the descent finds the minimum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.fitting import closed, descent, shapes
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cone, Cylinder, Plane, Sphere

each_kind = pytest.mark.parametrize("kind", KINDS)


def drawn(kind, rng):
    """A primitive anywhere near the origin."""
    axis, place = rng.normal(size=3), rng.normal(size=3)
    axis = axis / np.linalg.norm(axis)
    return {
        "plane": lambda: Plane(axis, np.float64(0.3)),
        "sphere": lambda: Sphere(place, np.float64(0.7)),
        "cylinder": lambda: Cylinder(axis, place, np.float64(0.8)),
        "cone": lambda: Cone(axis, place, np.float64(rng.uniform(0.1, 1.4))),
    }[kind]()


def on_device(primitive):
    return type(primitive)(*(jnp.asarray(field) for field in primitive))


def near(primitive, rng, *, noise):
    """Points about the surface and its normals there, as (3, n)."""
    feet = MODULES[primitive.kind].project(on_device(primitive), jnp.asarray(rng.normal(size=(200, 3)) + 1.0))
    distance, normals = shapes.distances_and_normals(primitive, np.asarray(feet).T + 1e-9)
    return np.asarray(feet).T + noise * rng.normal(size=(3, 200)), np.asarray(normals)


@each_kind
@pytest.mark.parametrize("seed", range(3))
def test_shapes_equal_the_modules(x64, kind, seed):
    rng = np.random.default_rng(seed)
    primitive, points = drawn(kind, rng), 2.0 * rng.normal(size=(60, 3))  # a third of them behind the apex of a cone
    module, twin, coordinates = MODULES[kind], on_device(primitive), np.ascontiguousarray(points.T)
    points = jnp.asarray(points)
    distance, normal = shapes.distances_and_normals(primitive, coordinates)
    np.testing.assert_allclose(distance, module.signed_distance(twin, points), atol=1e-13)
    np.testing.assert_allclose(shapes.signed_distances(primitive, coordinates), distance, atol=1e-13)
    np.testing.assert_allclose(normal.T, module.normal(twin, points), atol=1e-13)
    linear = shapes.linearised(primitive, coordinates)
    step = jnp.zeros(module.NUM_FREEDOM)
    expected = jax.jacfwd(lambda by: module.signed_distance(module.retract(twin, by), points))(step)
    np.testing.assert_allclose(linear.distance, distance, atol=1e-13)
    np.testing.assert_allclose(linear.jacobian.T, expected, atol=1e-12)
    step = 0.1 * rng.normal(size=module.NUM_FREEDOM)
    for found, other in zip(shapes.retract(primitive, step), module.retract(twin, jnp.asarray(step)), strict=True):
        np.testing.assert_allclose(found, other, atol=1e-13)
    moved = shapes.canonical(shapes.retract(primitive, step))
    for found, other in zip(
        moved, module.canonical(module.retract(twin, jnp.asarray(step)), jnp.zeros(3)), strict=True
    ):
        np.testing.assert_allclose(found, other, atol=1e-13)


def test_places_without_a_direction():
    zero, axis = np.zeros((3, 1)), np.array([0.0, 0.0, 1.0])
    one = np.float64(1.0)
    for primitive in (Sphere(np.zeros(3), one), Cylinder(axis, np.zeros(3), one), Cone(axis, np.zeros(3), one)):
        distance, normal = shapes.distances_and_normals(primitive, zero)
        assert np.linalg.norm(normal) == pytest.approx(1.0) and np.isfinite(distance).all()
        assert np.isfinite(shapes.linearised(primitive, zero).jacobian).all()


@each_kind
@pytest.mark.parametrize("seed", range(3))
def test_closed_forms_equal_the_papers_solvers(x64, kind, seed):
    rng = np.random.default_rng(seed)
    coordinates, normals = near(drawn(kind, rng), rng, noise=0.01)
    coordinates = coordinates - coordinates.mean(axis=1)[:, None]
    coordinates = coordinates / np.sqrt(np.square(coordinates).sum(axis=0).mean())
    normals = normals * rng.choice([-1.0, 1.0], 200)
    found = closed.fit(kind, coordinates, normals)
    expected = MODULES[kind].fit(jnp.asarray(coordinates.T), jnp.ones(200), jnp.asarray(normals.T))
    assert found.ok == bool(expected.ok)
    for ours, other in zip(found.primitive, expected.primitive, strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-6)


def test_what_determines_nothing_is_told():
    rng = np.random.default_rng(0)
    flat = np.stack([*rng.normal(size=(2, 100)), np.zeros(100)])
    up = np.tile([[0.0], [0.0], [1.0]], 100)
    assert [closed.fit(kind, flat, up).ok for kind in KINDS] == [True, False, False, False]
    assert all(np.isfinite(field).all() for kind in KINDS for field in closed.fit(kind, flat, up).primitive)
    blob = rng.normal(size=(3, 100))
    assert not closed.fit("plane", blob, up).ok


@each_kind
def test_the_descent_ends_where_every_direction_goes_up(kind):
    rng = np.random.default_rng(1)
    truth = drawn(kind, rng)
    coordinates, _ = near(truth, rng, noise=0.02)
    start = shapes.retract(truth, 0.05 * rng.normal(size=MODULES[kind].NUM_FREEDOM))
    found = descent.minimise(start, coordinates, num_steps=30)
    rms = np.sqrt(np.square(shapes.signed_distances(found.primitive, coordinates)).mean())
    assert found.ok and found.rms == pytest.approx(rms)
    linear = shapes.linearised(found.primitive, coordinates)
    gradient, hessian = linear.jacobian @ linear.distance, linear.jacobian @ linear.jacobian.T
    assert gradient @ np.linalg.solve(hessian, gradient) < 1e-4 * (linear.distance @ linear.distance)


def test_a_start_that_leads_nowhere_is_not_ok():
    points = np.random.default_rng(0).normal(size=(3, 50))
    start = Cylinder(np.array([0.0, 0, 1]), np.array([np.nan, 0, 0]), np.float64(1.0))
    assert not descent.minimise(start, points, num_steps=5).ok
