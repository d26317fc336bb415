import numpy as np
import pytest

from jprimfit.io import viewpoint

UP = np.array([0.0, 0, 1])


def sheet(rng, n, height, half=1.0):
    return np.c_[rng.uniform(-half, half, (n, 2)), np.full(n, height)]


def tube(rng, n, radius, low, high, arc=2 * np.pi, middle=0.0):
    angle = middle + arc * (rng.random(n) - 0.5)
    return np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.uniform(low, high, n)]


def flange(rng):
    """A plate with a skirt, a boss and its cap, open below: what a scanner gets of a part on a table; and segments."""
    plate = sheet(rng, 4_000, 0.0)
    plate = plate[np.hypot(plate[:, 0], plate[:, 1]) > 0.4]
    walls = rng.uniform(-1, 1, (1_500, 3)) * [1, 1, 0.15] - [0, 0, 0.15]
    rows = np.arange(1_500)
    walls[rows, rows % 2] = np.sign(walls[rows, rows % 2])
    cap = sheet(rng, 1_500, 0.8, 0.4)
    cap = cap[np.hypot(cap[:, 0], cap[:, 1]) < 0.4]
    parts = [plate, walls, tube(rng, 2_000, 0.4, 0, 0.8), cap]
    return np.concatenate(parts), np.repeat(np.arange(4), [len(part) for part in parts])


def rotation(rng):
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def test_a_part_without_a_direction_stands_on_the_z_axis():
    points = np.random.default_rng(0).normal(size=(2_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    chosen = viewpoint.choose(points, np.full(2_000, -1))
    np.testing.assert_allclose(chosen.up, UP, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(chosen.back), 1)
    assert 0.2 < chosen.back[2] < 0.8


def test_a_part_without_an_underside_is_seen_from_above_in_any_pose_and_with_any_labels():
    rng = np.random.default_rng(1)
    points, labels = flange(rng)
    points, labels = points[::2], labels[::2]
    for turn in (np.eye(3), np.diag([1.0, -1, -1]), rotation(rng)):
        for given in (labels, np.full(len(labels), -1), rng.integers(-1, 9, len(labels))):
            chosen = viewpoint.choose(points @ turn.T + 7, given)
            np.testing.assert_allclose(turn.T @ chosen.up, UP, atol=0.05)
            assert chosen.back @ turn[:, 2] > 0.2


def test_a_table_is_seen_from_the_side_its_things_stand_on_and_where_they_hide_little():
    rng = np.random.default_rng(2)
    table = sheet(rng, 5_000, 0.0)
    shadow = (np.abs(table[:, 1]) < 0.2) & (table[:, 0] > -0.2) & (table[:, 0] < 0.7)
    mug = tube(rng, 800, 0.2, 0, 0.4, arc=0.9 * np.pi, middle=np.pi)
    points = np.concatenate([table[~shadow], mug])
    for turn in (np.eye(3), np.diag([1.0, -1, -1]), rotation(rng)):
        chosen = viewpoint.choose(points @ turn.T, np.zeros(len(points), int))
        np.testing.assert_allclose(turn.T @ chosen.up, UP, atol=0.05)
        back = turn.T @ chosen.back
        assert back[2] > 0.2 and back[0] < -0.5


def test_half_a_tube_is_seen_from_outside():
    rng = np.random.default_rng(3)
    for middle in (0.5, 2.0, 4.0):
        points = tube(rng, 3_000, 1.0, -1, 1, arc=2.4, middle=middle)
        chosen = viewpoint.choose(points, np.zeros(3_000, int))
        assert chosen.back[:2] @ np.array([np.cos(middle), np.sin(middle)]) > 0


def test_a_lathe_part_stands_on_its_own_axis():
    rng = np.random.default_rng(4)
    points, turn = tube(rng, 3_000, 0.3, -1, 1), rotation(rng)
    chosen = viewpoint.choose(points @ turn.T, np.zeros(3_000, int))
    assert abs(chosen.up @ turn[:, 2]) > 0.99


@pytest.mark.parametrize("num_points", [1, 2, 5, 12])
def test_points_without_a_surface_give_a_viewpoint(num_points):
    line = np.arange(num_points)[:, None] * np.array([[1.0, 2.0, 3.0]])
    for points in (np.zeros((num_points, 3)), line, line * [[1, 0, 0]]):
        chosen = viewpoint.choose(points, np.full(num_points, -1))
        np.testing.assert_allclose([np.linalg.norm(chosen.back), np.linalg.norm(chosen.up)], 1)
        assert abs(chosen.back @ chosen.up) < 0.9
