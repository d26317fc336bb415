import numpy as np

from jprimfit.io import viewpoint


def sheet(rng, n, height, half=1.0):
    return np.c_[rng.uniform(-half, half, (n, 2)), np.full(n, height)]


def test_a_part_that_lies_on_nothing_stands_on_the_z_axis():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    chosen = viewpoint.choose(points, np.full(500, -1), [], np.zeros((500, 3)))
    np.testing.assert_allclose(chosen.up, [0, 0, 1])
    np.testing.assert_allclose(np.linalg.norm(chosen.back), 1)
    assert 0.2 < chosen.back[2] < 0.8


def test_a_table_is_seen_from_the_side_its_things_stand_on():
    rng = np.random.default_rng(1)
    table, thing = sheet(rng, 2_000, 0.0), sheet(rng, 300, 0.3, 0.3)
    points = np.concatenate([table, thing])
    labels = np.repeat([0, 1], [2_000, 300])
    normals = np.tile([0.0, 0, 1], (2_300, 1))
    for turn in (np.eye(3), np.diag([1.0, -1, -1]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):
        for sign in (1, -1):
            chosen = viewpoint.choose(points @ turn.T, labels, ["plane", "plane"], sign * normals @ turn.T)
            np.testing.assert_allclose(chosen.up, turn[:, 2], atol=1e-9)
            assert chosen.back @ turn[:, 2] > 0.2


def test_half_a_cylinder_is_seen_from_outside():
    rng = np.random.default_rng(2)
    for middle in (0.5, 2.0, 4.0):
        angle = middle + rng.uniform(-1.2, 1.2, 3_000)
        normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        points = normals + np.c_[np.zeros((3_000, 2)), rng.uniform(-1, 1, 3_000)]
        chosen = viewpoint.choose(points, np.zeros(3_000, int), ["cylinder"], normals)
        assert chosen.back[:2] @ np.array([np.cos(middle), np.sin(middle)]) > 0
