import numpy as np
import pytest

from jprimfit.io import raster

SHAPE = (60, 80)
BACK, UP = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])


def square(z, half=1.0):
    return np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])


def camera(points):
    return raster.camera(points, back=BACK, up=UP, shape=SHAPE)


def loop_rasterize(view, screen, faces):
    """Every pixel against every triangle."""
    item, depth = np.full(view.shape, -1), np.full(view.shape, np.inf)
    for i in range(view.shape[0]):
        for j in range(view.shape[1]):
            for f, face in enumerate(faces):
                (ax, ay), (bx, by), (cx, cy) = screen.position[face]
                area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
                x, y = j + 0.5, i + 0.5
                second = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                third = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                weights = np.array([1 - second - third, second, third])
                if weights.min() >= 0:
                    z = 1 / np.sum(weights / screen.depth[face])
                    if z < depth[i, j]:
                        item[i, j], depth[i, j] = f, z
    return item, depth


def test_the_camera_frames_all_points_upright():
    points = np.random.default_rng(0).normal(size=(100, 3)) * np.array([3, 1, 1]) + 50
    view = raster.camera(points, back=np.array([1.0, -2, 1]), up=np.array([0.0, 0, 1]), shape=SHAPE)
    x, y = raster.project(view, points).position.T
    room = raster.MARGIN * np.array([SHAPE[1], SHAPE[0]])
    assert x.min() >= room[0] - 1e-9 and x.max() <= SHAPE[1] - room[0] + 1e-9
    assert y.min() >= room[1] - 1e-9 and y.max() <= SHAPE[0] - room[1] + 1e-9
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    high = raster.project(view, view.center[None] + np.array([[0, 0, 0.5]])).position
    assert high[0, 1] < raster.project(view, view.center[None]).position[0, 1]


def test_rasterised_triangles_agree_with_a_loop():
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(24, 3))
    view = camera(vertices)
    faces = np.concatenate([np.arange(24).reshape(8, 3), [[0, 0, 1]]])
    screen = raster.project(view, vertices)
    seen = raster.rasterize(view, screen, faces)
    item, depth = loop_rasterize(view, screen, faces[:-1])
    assert np.mean(seen.item == item) > 0.999
    same = (seen.item == item) & (item >= 0)
    np.testing.assert_allclose(seen.depth[same], depth[same], rtol=1e-5)


def test_neighbouring_triangles_leave_no_crack():
    n = 23
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    vertices = np.stack([u.ravel(), v.ravel(), 0.3 * u.ravel()], axis=1)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    view = camera(vertices)
    seen = raster.rasterize(view, raster.project(view, vertices), faces).item >= 0
    rows = np.flatnonzero(seen.any(axis=1))
    inner = seen[rows[2] : rows[-2]]
    for row in inner:
        columns = np.flatnonzero(row)
        assert len(columns) == columns[-1] - columns[0] + 1


def test_values_are_interpolated_between_vertices():
    vertices = square(0.0)
    view = camera(vertices)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    screen = raster.project(view, vertices)
    seen = raster.rasterize(view, screen, faces)
    values = raster.interpolate(screen, faces, vertices, seen)
    y, x = np.nonzero(seen.item >= 0)
    back = raster.project(view, values.astype(np.float64)).position
    np.testing.assert_allclose(back, np.stack([x + 0.5, y + 0.5], axis=1), atol=1e-3)


def test_a_dense_front_hides_the_points_behind_it():
    rng = np.random.default_rng(2)
    front, back = (np.c_[rng.uniform(-1, 1, (3_000, 2)), np.full(3_000, z)] for z in (0.5, -0.5))
    points = np.concatenate([front, back])
    view = camera(points)
    seen = raster.splat(view, raster.project(view, points), radius=1.0, cover=0.12)
    inside = raster.rasterize(view, raster.project(view, square(0.5, 0.9)), np.array([[0, 1, 2], [0, 2, 3]])).item >= 0
    shown = seen.item[inside]
    assert np.mean(shown >= 3_000) < 0.002
    assert np.mean(shown >= 0) > 0.95


def test_a_slanted_surface_does_not_hide_itself():
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-1, 1, (2, 4_000))
    points = np.stack([u, 0.3 * v, v], axis=1)  # seen at 73 degrees from its normal
    view = camera(points)
    screen = raster.project(view, points)
    with_cover = raster.splat(view, screen, radius=1.0, cover=0.1).item
    without = raster.splat(view, screen, radius=1.0).item
    assert np.count_nonzero(with_cover >= 0) > 0.97 * np.count_nonzero(without >= 0)


def test_a_disc_filter_is_the_minimum_over_the_disc():
    values = np.random.default_rng(4).integers(0, 1000, (12, 15))
    for radius in (0.5, 1.0, 2.3, 3.7):
        found = raster._filtered(values, radius, np.minimum)
        for i in range(12):
            for j in range(15):
                y, x = np.mgrid[:12, :15]
                assert found[i, j] == values[(y - i) ** 2 + (x - j) ** 2 <= radius**2].min()


def test_light_is_two_sided_and_strongest_towards_the_lamp():
    view = camera(square(0.0))
    seen = raster.rasterize(view, raster.project(view, square(0.0)), np.array([[0, 1, 2], [0, 2, 3]]))
    count = np.count_nonzero(seen.item >= 0)
    facing = np.broadcast_to(np.array([0.1, 0.2, 0.97]), (count, 3))
    one, other = raster.light(view, seen, facing), raster.light(view, seen, -facing)
    np.testing.assert_allclose(one.diffuse, other.diffuse, atol=1e-6)
    away = raster.light(view, seen, np.broadcast_to(np.array([0.3, -0.9, 0.3]), (count, 3)))
    assert one.diffuse.mean() > 1.2 * away.diffuse.mean()
    assert np.all(away.diffuse > 0.2)


def test_shadow_falls_behind_an_edge_only():
    vertices = np.concatenate([square(0.0), square(0.4, 0.4)])
    view = camera(vertices)
    seen = raster.rasterize(
        view, raster.project(view, vertices), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    )
    kept = raster.eye_dome(view, seen)
    assert np.all(kept[seen.item < 0] == 1) and np.all(kept[seen.item >= 2] == 1)
    assert kept[(seen.item >= 0) & (seen.item < 2)].min() < 0.9


def test_paint_averages_blocks_on_the_background():
    seen = raster.Buffer(np.array([[0, -1], [0, -1]], np.int32), np.zeros((2, 2)))
    lit = raster.Light(np.ones(2), np.zeros(2))
    image = raster.paint(seen, lit, np.zeros((2, 3)), np.ones(3), factor=2)
    assert image.shape == (1, 1, 3) and image[0, 0, 0] == pytest.approx(127.5, abs=1)
