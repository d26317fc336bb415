"""What is hidden is not scanned, density and strays are as asked for, and the truth stays that of the points."""

import numpy as np
import pytest

from jprimfit.data import scanning, surfaces
from jprimfit.data.clouds import LoaderConfig, draw_scan
from jprimfit.data.records import BACKGROUND, Cloud, Mesh, Part
from jprimfit.data.scanning import Falloff
from jprimfit.types import Plane, Sphere

X = np.array([1.0, 0.0, 0.0])
CONFIG = LoaderConfig(num_points=1000, num_query=0, num_samples=5, max_instances=9, uniform_noise=(0.0, 0.0))


def ball(rings=24, sectors=48):
    """The unit sphere, instance 0, as a closed mesh."""
    polar = np.pi * np.arange(rings + 1) / rings
    turn = 2 * np.pi * np.arange(sectors) / sectors
    height, around = np.meshgrid(polar, turn, indexing="ij")
    vertices = np.stack([np.sin(height) * np.cos(around), np.sin(height) * np.sin(around), np.cos(height)], axis=-1)
    row, column = np.meshgrid(np.arange(rings), np.arange(sectors), indexing="ij")
    here, right = row * sectors + column, row * sectors + (column + 1) % sectors
    faces = np.concatenate(
        [np.stack([a.ravel() for a in corners], axis=1)
         for corners in ((here, here + sectors, right + sectors), (here, right + sectors, right))]
    )  # fmt: skip
    labels = np.zeros(len(faces), np.int32)
    return Part("ball", (Sphere(np.zeros(3), 1.0),), mesh=Mesh(vertices.reshape(-1, 3), faces.astype(np.int32), labels))


def box(half, *, outwards=True, first=0):
    """Vertices, faces and labels first ... first + 5 of a cube about the origin: -x, -y, -z, +x, +y, +z."""
    vertices = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = np.array([[0, 1, 3, 2], [0, 4, 5, 1], [0, 2, 6, 4], [4, 6, 7, 5], [2, 3, 7, 6], [1, 5, 7, 3]])
    quads = quads if outwards else quads[:, ::-1]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return vertices, faces, first + np.tile(np.arange(6), 2)


def planes(half):
    return [Plane(axis, sign * half) for sign in (-1.0, 1.0) for axis in np.eye(3)]


def hollow_box():
    """A cube with a closed hollow: instances 0 to 5 outside, 6 to 11 inside."""
    outer, inner = box(1.0), box(0.5, outwards=False, first=6)
    mesh = Mesh(
        np.concatenate([outer[0], inner[0]]),
        np.concatenate([outer[1], inner[1] + 8]).astype(np.int32),
        np.concatenate([outer[2], inner[2]]).astype(np.int32),
    )
    return Part("hollow", (*planes(1.0), *planes(0.5)), mesh=mesh)


def blocked(point, viewpoint, corners):
    """Whether the straight way to the point, less its very end, meets a triangle: Cramer's rule for each."""
    way = (1 - 1e-6) * (point - viewpoint)
    for a, b, c in corners:
        system = np.column_stack([b - a, c - a, -way])
        if abs(np.linalg.det(system)) > 1e-12:
            u, v, along = np.linalg.solve(system, viewpoint - a)
            if u >= 0 and v >= 0 and u + v <= 1 and 0 < along < 1:
                return True
    return False


class TestVisible:
    @pytest.mark.parametrize("distance", [1.8, 6.0])
    def test_of_a_ball_the_cap_before_the_horizon(self, distance):
        part = ball()
        cloud = surfaces.draw(part, num_points=4000, seed=0, num_samples=0)
        seen = scanning.visible(cloud.points, cloud.normals, part.mesh, distance * X[None])
        # From a distance d, a unit sphere is seen where x >= 1 / d.
        np.testing.assert_array_equal(seen, cloud.points[:, 0] > 1.0 / distance)
        assert 0.1 < seen.mean() < 0.5

    def test_the_hollow_of_a_closed_box_is_unseen(self):
        part, cube = hollow_box(), np.array([[3.0, 1.5, 2.0], [-3.0, -2.5, 2.0]])
        cloud = surfaces.draw(part, num_points=3000, seed=0, num_samples=0)
        seen = scanning.visible(cloud.points, cloud.normals, part.mesh, cube)
        assert (cloud.labels >= 6).mean() > 0.1
        np.testing.assert_array_equal(seen, np.isin(cloud.labels, [0, 1, 3, 4, 5]))

    @pytest.mark.parametrize("viewpoint,whole_hole", [([0.3, -0.2, 3.0], True), ([2.0, 1.3, 1.5], False)])
    def test_it_is_what_rays_say(self, drilled_block, viewpoint, whole_hole):
        part, viewpoint = drilled_block(0.6, 0.3, facets=48), np.array(viewpoint)
        cloud = surfaces.draw(part, num_points=400, seed=1, num_samples=0)
        seen = scanning.visible(cloud.points, cloud.normals, part.mesh, viewpoint[None])
        corners = part.mesh.vertices[part.mesh.faces]
        # Beside the hole points lie outside the chords of their triangles, where a ray meets these first.
        inwards = np.where((cloud.labels == 6)[:, None], 0.004 * cloud.normals, 0.0)
        expected = [not blocked(point, viewpoint, corners) for point in cloud.points + inwards]
        assert (seen != expected).sum() <= 2  # within 0.004 of an edge of shadow
        hole = cloud.labels == 6
        assert seen[hole].any() and seen[hole].all() == whole_hole

    def test_several_viewpoints_see_what_any_sees(self, drilled_block):
        part = drilled_block()
        cloud = surfaces.draw(part, num_points=500, seed=1, num_samples=0)
        views = scanning.around(np.random.default_rng(0), part, num=3)
        each = [scanning.visible(cloud.points, cloud.normals, part.mesh, view[None]) for view in views]
        together = scanning.visible(cloud.points, cloud.normals, part.mesh, views)
        np.testing.assert_array_equal(together, np.any(each, axis=0))
        assert not np.array_equal(each[0], each[1])


def test_viewpoints_stand_outside_the_part(drilled_block):
    part = drilled_block()
    half = np.linalg.norm(np.ptp(part.mesh.vertices, axis=0)) / 2
    distance = np.linalg.norm(scanning.around(np.random.default_rng(0), part, num=500), axis=1) / half
    assert 1.5 <= distance.min() < 1.6 and 3.9 < distance.max() <= 4.0


class TestDensity:
    def test_it_is_log_linear_between_the_ends(self):
        points = np.array([[-3.0, 5.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 9.0]])
        found = scanning.density(points, Falloff(X, 16.0), extent=points)
        np.testing.assert_allclose(found, [1.0, 16.0**-0.75, 1.0 / 16.0])

    def test_points_are_thinned_by_it(self):
        part = hollow_box()
        cloud = scanning.scan(part, num_points=20_000, seed=[0], falloff=Falloff(X, 8.0))
        assert len(cloud.points) == 20_000
        # Of the faces that run along x, the density at place t in [0, 1] is 8^-t; outer and inner ones at their own x.
        side = cloud.points[np.isin(cloud.labels, [1, 2, 4, 5]), 0]
        for low, high in ((-1.0, -0.5), (-0.25, 0.25), (0.5, 1.0)):
            share = 8.0 ** -((np.array([low, high]) + 1) / 2)
            expected = (share[0] - share[1]) / (1 - 1 / 8)
            assert np.mean((side >= low) & (side < high)) == pytest.approx(expected, abs=0.015)


class TestScan:
    def test_what_is_seen_lies_on_its_instance_with_its_normal(self, drilled_block):
        part = drilled_block(0.6, 0.3)
        cloud = scanning.scan(part, num_points=700, seed=[3], num_samples=4, viewpoints=np.array([[0.5, 0.2, 3.0]]))
        assert cloud.points.shape == (700, 3) and cloud.samples.shape == (7, 4, 3)
        table = surfaces.records.pack(part.primitives)
        foot = surfaces.project(table, cloud.labels, cloud.points)
        np.testing.assert_allclose(foot.points, cloud.points, atol=1e-12)
        np.testing.assert_allclose(np.abs(np.sum(foot.normals * cloud.normals, axis=1)), 1.0, atol=1e-12)
        assert scanning.visible(cloud.points, cloud.normals, part.mesh, np.array([[0.5, 0.2, 3.0]])).all()

    def test_a_stored_cloud_is_thinned_but_hides_nothing(self, make_part):
        part = make_part(0, forms=("cloud",), points=400)
        cloud = scanning.scan(part, num_points=400, seed=[0], falloff=Falloff(X, 20.0))
        stored = {tuple(point) for point in part.cloud.points.astype(np.float64)}
        assert 40 < len(cloud.points) < 350 and stored.issuperset(map(tuple, cloud.points))
        assert len(cloud.noisy_points) == len(cloud.points)
        with pytest.raises(ValueError, match="no mesh"):
            scanning.scan(part, num_points=10, seed=[0], viewpoints=3 * X[None])

    def test_a_part_that_faces_inwards_is_named(self):
        vertices, faces, labels = box(1.0, outwards=False)
        mesh = Mesh(vertices[:, :] * 1.0, faces[labels == 3].astype(np.int32), labels[labels == 3].astype(np.int32))
        part = Part("sheet", tuple(planes(1.0)), mesh=mesh)
        with pytest.raises(ValueError, match="'sheet' is seen"):
            scanning.scan(part, num_points=10, seed=[0], viewpoints=4 * X[None])


def test_unseen_instances_disappear():
    part = hollow_box()
    labels = np.array([7, 2, -1, 2, 4], np.int32)
    samples = np.arange(12 * 2 * 3.0).reshape(12, 2, 3)
    cloud = Cloud(np.zeros((5, 3)), np.zeros((5, 3)), labels, samples=samples)
    rest, found = scanning.drop_unseen(part, cloud)
    assert found.labels.tolist() == [2, 0, BACKGROUND, 0, 1] and found.labels.dtype == np.int32
    assert all(a is part.primitives[k] for a, k in zip(rest.primitives, (2, 4, 7), strict=True))
    np.testing.assert_array_equal(found.samples, samples[[2, 4, 7]])


def test_strays_fill_the_enlarged_box():
    points = np.random.default_rng(0).uniform([-1, 0, 2], [1, 1, 2.5], (40_000, 3))
    clean = Cloud(points, np.tile(X, (40_000, 1)), np.zeros(40_000, np.int32))
    found, cloud = scanning.scatter(np.random.default_rng(1), points, clean, share=0.25)
    astray = cloud.labels == BACKGROUND
    assert astray.sum() == 10_000 and np.array_equal(astray, np.any(found != points, axis=1))
    np.testing.assert_array_equal(cloud.normals[~astray], clean.normals[~astray])
    np.testing.assert_allclose(np.sum(cloud.normals[astray] ** 2, axis=1), 1.0)
    place = (found[astray] - [0.0, 0.5, 2.25]) / [2.0, 1.0, 0.5]
    assert np.abs(place).max() <= 0.6 and np.abs(place).max() > 0.59
    np.testing.assert_allclose(place.std(axis=0), 1.2 / np.sqrt(12), rtol=0.03)
    assert not clean.labels.any() and not np.array_equal(found, points)


class TestInAPool:
    def test_the_truth_follows_what_is_seen(self, drilled_block):
        part = drilled_block(0.4, 0.5)
        counts, kinds = set(), {0: "plane", 2: "cylinder"}
        for number in range(6):
            scan = draw_scan(part, config=with_settings(partial_share=1.0, viewpoints=(1, 2)), seed=(0, number))
            truth, valid = scan.truth, scan.truth.labels[scan.mask]
            count = truth.instance_mask.sum()
            assert sorted(set(valid.tolist())) == list(range(count))
            assert not truth.axis[count:].any() and not truth.samples[count:].any()
            for instance in range(count):
                normals = truth.normals[truth.labels == instance]
                expected = {"plane": 1.0, "cylinder": 0.0}[kinds[int(truth.kind[instance])]]
                np.testing.assert_allclose(np.abs(normals @ truth.axis[instance]), expected, atol=1e-6)
            assert np.ptp(scan.points[scan.mask], axis=0).max() == pytest.approx(2.0, abs=1e-6)
            counts.add(int(count))
        assert max(counts) < 7 and len(counts) > 1

    @pytest.mark.parametrize("name", ["density_share", "partial_share"])
    def test_the_share_of_clouds_is_as_asked_and_the_others_stay_as_they_were(self, drilled_block, name):
        part, plain, changed = drilled_block(), with_settings(), with_settings(**{name: 0.5})
        same = []
        for number in range(40):
            before, after = (draw_scan(part, config=config, seed=(0, number)) for config in (plain, changed))
            same.append(np.array_equal(before.points, after.points))
        assert 10 <= sum(same) <= 30

    def test_strays_are_background_in_the_frame_of_all_points(self, drilled_block):
        scan = draw_scan(drilled_block(), config=with_settings(outliers=(0.1, 0.2)), seed=(0, 1))
        assert 100 <= (scan.truth.labels == BACKGROUND).sum() <= 200
        assert np.ptp(scan.points, axis=0).max() == pytest.approx(2.0, abs=1e-6)
        with_plane = scan.points[scan.truth.labels == 0].astype(np.float64) @ scan.truth.axis[0]
        assert np.ptp(with_plane) < 1e-5

    def test_the_same_seed_gives_the_same_cloud(self, drilled_block):
        config = with_settings(density_share=1.0, partial_share=1.0, outliers=(0.0, 0.1))
        first, again, other = (draw_scan(drilled_block(), config=config, seed=(0, number)) for number in (4, 4, 5))
        np.testing.assert_array_equal(first.points, again.points)
        np.testing.assert_array_equal(first.truth.labels, again.truth.labels)
        assert not np.array_equal(first.points, other.points)


def with_settings(**settings):
    return LoaderConfig(**{**vars(CONFIG), **settings})


@pytest.mark.parametrize(
    "settings",
    [{"density_share": 1.1}, {"density_ratio": (0.5, 2.0)}, {"viewpoints": (0, 2)}, {"outliers": (0.1, 1.0)}],
)
def test_settings_that_make_no_sense_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        LoaderConfig(**settings)
