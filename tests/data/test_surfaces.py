"""Points lie exactly on their primitives, uniform by area, with the normal of the side that the solid shows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.data import records, surfaces
from jprimfit.data.records import Mesh, Part
from jprimfit.primitives import table
from jprimfit.types import Cone, Cylinder, Plane, Sphere


def unit(values):
    return values / np.sqrt(np.sum(values * values, axis=-1, keepdims=True))


def on_device(function, primitive, points):
    return np.asarray(jax.jit(function)(jax.tree.map(jnp.asarray, primitive), jnp.asarray(points)))


def turned_body(primitive, heights, radii, facets=90):
    """The side of a body of revolution about z between circles: exact corners, flat triangles between them."""
    turn = 2 * np.pi * np.arange(facets) / facets
    rings = [
        np.stack([r * np.cos(turn), r * np.sin(turn), np.full(facets, z)], 1)
        for z, r in zip(heights, radii, strict=True)
    ]
    faces = []
    for low in range(len(heights) - 1):
        a, b = low * facets + np.arange(facets), (low + 1) * facets + np.arange(facets)
        faces += [np.stack([a, np.roll(a, -1), np.roll(b, -1)], 1), np.stack([a, np.roll(b, -1), b], 1)]
    faces = np.concatenate(faces).astype(np.int32)
    return Part("body", (primitive,), mesh=Mesh(np.concatenate(rings), faces, np.zeros(len(faces), np.int32)))


Z = np.array([0.0, 0.0, 1.0])
LATITUDES = np.linspace(-1.2, 1.2, 30)
BODIES = {
    "sphere": turned_body(Sphere(np.zeros(3), 0.7), 0.7 * np.sin(LATITUDES), 0.7 * np.cos(LATITUDES)),
    "cylinder": turned_body(Cylinder(Z, np.zeros(3), 0.4), [-1.0, 1.0], [0.4, 0.4]),
    "cone": turned_body(Cone(Z, np.array([0.0, 0.0, -1.0]), np.arctan(0.5)), [-0.9, 1.0], [0.05, 1.0]),
}


class TestDraw:
    @pytest.mark.usefixtures("x64")
    @pytest.mark.parametrize("kind", BODIES)
    def test_points_and_samples_lie_on_the_surface_with_its_normal(self, kind):
        part = BODIES[kind]
        cloud = surfaces.draw(part, num_points=700, seed=0, num_samples=50)
        assert cloud.samples.shape == cloud.sample_normals.shape == (1, 50, 3)
        for points, normals in ((cloud.points, cloud.normals), (cloud.samples[0], cloud.sample_normals[0])):
            assert np.abs(on_device(table.distance, part.primitives[0], points)).max() < 1e-12
            # The sides of these bodies face outwards, as the gradient of the signed distance does.
            np.testing.assert_allclose(normals, on_device(table.normal, part.primitives[0], points), atol=1e-12)

    def test_the_normal_follows_the_triangle(self):
        body = BODIES["cylinder"]
        hole = body._replace(mesh=body.mesh._replace(faces=body.mesh.faces[:, ::-1]))
        outer, inner = (surfaces.draw(part, num_points=300, seed=1, num_samples=0) for part in (body, hole))
        assert (np.sum(outer.normals * outer.points, axis=1) > 0.3).all()
        assert (np.sum(inner.normals * inner.points, axis=1) < -0.3).all()

    def test_as_many_points_as_area(self, drilled_block):
        radius, height = 0.4, 0.5
        cloud = surfaces.draw(drilled_block(radius, height), num_points=20_000, seed=2, num_samples=0)
        side, hole = 2 * 2 * height, 2 * np.pi * radius * 2 * height
        areas = np.array([4 - np.pi * radius**2] * 2 + [side] * 4 + [hole])
        expected = 20_000 * areas / areas.sum()
        counts = np.bincount(cloud.labels, minlength=7)
        assert np.sum((counts - expected) ** 2 / expected) < 30.0  # six degrees of freedom: less by chance in 0.99996

    def test_even_over_one_surface(self):
        points = surfaces.draw(BODIES["cone"], num_points=40_000, seed=3, num_samples=0).points
        height, turn = points[:, 2] + 1.0, np.arctan2(points[:, 1], points[:, 0])
        # The area below height h of a cone grows with its square.
        share = (height**2 - 0.01) / (4.0 - 0.01)
        for values in (share, turn / (2 * np.pi) + 0.5):
            counts = np.histogram(values, bins=20, range=(0.0, 1.0))[0]
            assert np.sum((counts - 2000.0) ** 2 / 2000.0) < 50.0  # 19 degrees of freedom: less in 0.9999

    def test_background_stays_on_its_triangles(self, drilled_block):
        cloud = surfaces.draw(drilled_block(background=True), num_points=2000, seed=4, num_samples=0)
        free = cloud.labels == -1
        assert 60 < free.sum() < 180
        np.testing.assert_allclose(cloud.points[free, 0], 1.0, atol=1e-12)
        np.testing.assert_allclose(cloud.normals[free], np.tile([1.0, 0, 0], (free.sum(), 1)), atol=1e-12)

    def test_samples_belong_to_their_instance(self, drilled_block):
        part = drilled_block(0.3, 0.2)
        cloud = surfaces.draw(part, num_points=10, seed=5, num_samples=400)
        foot = surfaces.project(
            records.pack(part.primitives), np.repeat(np.arange(7), 400), cloud.samples.reshape(-1, 3)
        )
        np.testing.assert_allclose(foot.points, cloud.samples.reshape(-1, 3), atol=1e-12)
        assert np.abs(cloud.samples).max(axis=(1, 2)) == pytest.approx([1, 1, 1, 1, 1, 1, 0.3], abs=0.02)
        assert (np.abs(cloud.samples[:6].mean(axis=1)[[2, 3, 4, 5], [0, 1, 0, 1]]) > 0.99).all()

    def test_the_seed_decides(self, drilled_block, assert_equal):
        part = drilled_block()
        first, again, other = (surfaces.draw(part, num_points=50, seed=seed) for seed in ([1, 2], [1, 2], [1, 3]))
        assert_equal(first, again)
        assert not np.any(np.all(first.points == other.points, axis=1))

    def test_a_stored_cloud_is_thinned(self, make_part):
        part = make_part(0, forms=("cloud",))
        cloud = surfaces.draw(part, num_points=25, seed=0, num_samples=4)
        rows = [
            np.flatnonzero((part.cloud.points == point).all(axis=1))[0] for point in cloud.points.astype(np.float32)
        ]
        assert len(set(rows)) == 25
        for field in ("normals", "labels", "noisy_points"):
            np.testing.assert_array_equal(getattr(cloud, field), getattr(part.cloud, field)[rows])
        assert cloud.samples.shape == cloud.sample_normals.shape == (4, 4, 3)
        stored = {tuple(row) for row in part.cloud.samples.reshape(-1, 3).tolist()}
        assert {tuple(row) for row in cloud.samples.reshape(-1, 3).tolist()} <= stored
        assert len(surfaces.draw(part, num_points=1000, seed=0).points) == len(part.cloud.points)

    def test_points_serve_where_no_samples_are_stored(self, make_part):
        part = make_part(0, forms=("cloud",), points=60)
        bare = part._replace(cloud=part.cloud._replace(samples=None, sample_normals=None))
        cloud = surfaces.draw(bare, num_points=5, seed=0, num_samples=30)
        for instance, samples in enumerate(cloud.samples.astype(np.float32)):
            own = part.cloud.points[part.cloud.labels == instance]
            assert {tuple(row) for row in samples.tolist()} == {tuple(row) for row in own.tolist()}

    def test_what_cannot_be_drawn_is_named(self, drilled_block, make_part):
        block = drilled_block()
        with pytest.raises(ValueError, match="trimmed faces only"):
            surfaces.draw(make_part(0, forms=("trims",)), num_points=5, seed=0)
        with pytest.raises(ValueError, match="no triangle on instance 7"):
            surfaces.draw(block._replace(primitives=(*block.primitives, Plane(Z, 3.0))), num_points=5, seed=0)
        with pytest.raises(ValueError, match="without area"):
            flat = block.mesh._replace(vertices=np.zeros_like(block.mesh.vertices))
            surfaces.draw(block._replace(mesh=flat), num_points=5, seed=0)
        with pytest.raises(ValueError, match="at least 1"):
            surfaces.draw(block, num_points=0, seed=0)
        part = make_part(0, forms=("cloud",))
        bare = part.cloud._replace(samples=None, sample_normals=None, labels=np.zeros_like(part.cloud.labels))
        with pytest.raises(ValueError, match="no point on instance 1"):
            surfaces.draw(part._replace(cloud=bare), num_points=5, seed=0)


@pytest.mark.usefixtures("x64")
class TestProject:
    def test_the_same_as_the_primitives(self):
        draw = np.random.default_rng(0)
        axes, centers = unit(draw.normal(size=(3, 3))), draw.normal(size=(3, 3))
        primitives = (
            Plane(axes[0], 0.3),
            Sphere(centers[0], 0.8),
            Cylinder(axes[1], centers[1], 0.5),
            Cone(axes[2], centers[2], 0.6),
        )
        points, labels = draw.normal(size=(400, 3)), draw.integers(0, 4, 400)
        foot = surfaces.project(records.pack(primitives), labels, points)
        for label, primitive in enumerate(primitives):
            rows = labels == label
            np.testing.assert_allclose(foot.points[rows], on_device(table.project, primitive, points[rows]), atol=1e-12)
            before = rows if label != 3 else rows & (np.abs(foot.points - centers[2]).max(axis=1) > 1e-9)
            np.testing.assert_allclose(
                foot.normals[before], on_device(table.normal, primitive, points[before]), atol=1e-12
            )

    def test_where_no_direction_is_distinguished(self):
        axis = unit(np.array([1.0, 2.0, 3.0]))
        primitives = (Sphere(np.ones(3), 0.8), Cylinder(axis, np.ones(3), 0.5), Cone(axis, np.ones(3), 0.6))
        points = np.stack([np.ones(3), 1 + 0.7 * axis, 1 + 0.7 * axis])
        foot = surfaces.project(records.pack(primitives), np.arange(3), points)
        assert np.isfinite(foot.points).all()
        np.testing.assert_allclose(np.sum(foot.normals**2, axis=1), 1.0, atol=1e-12)
        for primitive, point in zip(primitives, foot.points, strict=True):
            assert abs(float(on_device(table.signed_distance, primitive, point[None])[0])) < 1e-12
