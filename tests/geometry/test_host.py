"""The host's float64 geometry: kd-tree neighbours, the normalised frame, PCA normals."""

import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host, linalg


def loop_knn(queries, points, mask, k):
    """Rows and squared distances of the k nearest valid points, by (distance, index), without padding."""
    rows, distances = [], []
    for query in queries:
        sq = [float(((point - query) ** 2).sum()) for point in points]
        order = sorted((i for i in range(len(points)) if mask[i]), key=lambda i, sq=sq: (sq[i], i))[:k]
        rows.append(order)
        distances.append([sq[i] for i in order])
    return rows, distances


def grid(side):
    return np.stack(np.meshgrid(*[np.arange(float(side))] * 3), axis=-1).reshape(-1, 3)


def check_against_loop(queries, points, mask, k):
    found = host.knn(queries, points, mask, k=k)
    rows, distances = loop_knn(queries, points, np.ones(len(points), bool) if mask is None else mask, k)
    assert found.index.shape == found.sq_distance.shape == found.mask.shape == (len(queries), k)
    assert found.index.dtype == np.int32 and found.mask.dtype == bool and found.count.dtype == np.int32
    for i, (row, distance) in enumerate(zip(rows, distances, strict=True)):
        assert found.index[i, : len(row)].tolist() == row
        np.testing.assert_allclose(found.sq_distance[i, : len(row)], distance, atol=1e-12)
        assert found.mask[i].tolist() == [True] * len(row) + [False] * (k - len(row))
        assert (found.index[i, len(row) :] == (row[0] if row else 0)).all()
        assert (found.sq_distance[i, len(row) :] == (found.sq_distance[i, 0] if row else 0.0)).all()
    assert (found.count == (len(points) if mask is None else mask.sum())).all()


class TestKnn:
    @pytest.mark.parametrize("k", [1, 5, 12])
    def test_equals_a_loop(self, k):
        rng = np.random.default_rng(0)
        points, queries = rng.normal(size=(9, 3)), rng.normal(size=(4, 3))
        check_against_loop(queries, points, None, k)
        check_against_loop(points, points, None, k)
        check_against_loop(queries, points, rng.random(9) < 0.6, k)
        check_against_loop(queries, points, np.zeros(9, bool), k)

    @pytest.mark.parametrize("k", [1, 4, 8, 20])
    def test_ties_go_to_the_lowest_index(self, k):
        points = np.random.default_rng(1).permutation(grid(4))
        check_against_loop(points, points, None, k)
        check_against_loop(points + 0.5, points, None, k)

    def test_duplicates_are_all_found(self):
        points = np.repeat(np.random.default_rng(2).normal(size=(5, 3)), 4, axis=0)
        check_against_loop(points, points, None, 6)

    def test_one_point_and_no_query(self):
        assert host.knn(np.zeros((1, 3)), np.zeros((1, 3)), k=3).mask.tolist() == [[True, False, False]]
        assert host.knn(np.zeros((0, 3)), np.zeros((2, 3)), k=3).index.shape == (0, 3)

    def test_many_copies_of_one_point_stay_in_range(self):
        found = host.knn(np.zeros((300, 3)), np.zeros((300, 3)), k=4)
        assert found.mask.all() and (found.sq_distance == 0.0).all() and (found.index < 300).all()

    def test_far_from_the_origin(self):
        points = np.random.default_rng(3).normal(size=(50, 3))
        near, far = host.knn(points, points, k=7), host.knn(points + 1e6, points + 1e6, k=7)
        np.testing.assert_array_equal(near.index, far.index)


class TestNormalize:
    def test_centroid_scale_and_way_back(self):
        points = np.random.default_rng(0).normal(size=(100, 3)) * [3.0, 1.0, 0.2] + [1e6, -50.0, 7.0]
        scaled, frame = host.normalize(points)
        assert scaled.dtype == np.float32
        np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(np.ptp(scaled, axis=0).max(), 2.0, rtol=1e-6)
        np.testing.assert_allclose(frame.to_input(scaled), points, atol=1e-6 * frame.scale)
        np.testing.assert_allclose(frame.to_input(frame.from_input(points)), points, rtol=1e-15)

    @pytest.mark.parametrize("scale,offset", [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)])
    def test_scale_and_offset_do_not_matter(self, scale, offset):
        points = np.random.default_rng(1).normal(size=(60, 3))
        np.testing.assert_allclose(host.normalize(points * scale + offset)[0], host.normalize(points)[0], atol=1e-6)

    @pytest.mark.parametrize("is_cube", [False, True])
    def test_turned_clouds_come_out_alike(self, is_cube):
        # A cube has no principal axes: its first rows decide.
        rng = np.random.default_rng(2)
        corners = np.stack(np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1]), axis=-1).reshape(-1, 3)
        points = corners if is_cube else rng.normal(size=(60, 3)) * [3.0, 1.0, 0.2]
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        scaled, frame = host.normalize(points, turned=True)
        again, other = host.normalize(7.0 * points @ turn.T + 1e4, turned=True)
        np.testing.assert_allclose(again, scaled, atol=1e-6)
        np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame.axes) == pytest.approx(1.0)
        np.testing.assert_allclose(np.ptp(scaled, axis=0).max(), 2.0, rtol=1e-6)
        np.testing.assert_allclose(other.to_input(again), 7.0 * points @ turn.T + 1e4, atol=1e-4)
        np.testing.assert_allclose(other.vectors_to_input(frame.vectors_from_input(points)), points @ turn.T, atol=1e-9)

    def test_coincident_points(self):
        scaled, frame = host.normalize(np.full((5, 3), 4.25))
        assert frame.scale == 1.0 and (scaled == 0.0).all()


class TestPcaNormals:
    def test_plane_and_sphere(self):
        rng = np.random.default_rng(0)
        flat = np.column_stack([rng.random((400, 2)), np.zeros(400)])
        found = host.pca_normals(flat, k=12)
        np.testing.assert_allclose(np.abs(found.normal @ [0.0, 0.0, 1.0]), 1.0, atol=1e-12)
        np.testing.assert_allclose(found.curvature, 0.0, atol=1e-12)
        ball = rng.normal(size=(4000, 3))
        ball /= np.sqrt((ball**2).sum(axis=1, keepdims=True))
        found = host.pca_normals(ball + 1e4, k=12)
        assert (1.0 - np.abs(np.sum(found.normal * ball, axis=1))).mean() < 1e-3
        assert (found.curvature > 0.0).all()

    def test_closed_form_equals_lapack(self):
        rng = np.random.default_rng(1)
        points = np.concatenate([rng.normal(size=(150, 3)) * [1.0, 1.0, s] for s in (1e-6, 1e-2, 1.0)])
        found = host.pca_normals(points, k=9)
        for i, row in enumerate(host.knn(points, points, k=9).index):
            values, vectors = np.linalg.eigh(np.cov(points[row].T, bias=True))
            np.testing.assert_allclose(found.curvature[i], max(values[0], 0.0) / values.sum(), atol=1e-12)
            np.testing.assert_allclose(abs(found.normal[i] @ vectors[:, 0]), 1.0, atol=1e-8)

    @pytest.mark.parametrize("points", [np.zeros((6, 3)), np.outer(np.arange(6.0), [1.0, 2.0, 2.0]), np.eye(3)[:1]])
    def test_degenerate_neighbourhoods_give_a_unit_vector_across(self, points):
        found = host.pca_normals(points, k=4)
        np.testing.assert_allclose((found.normal**2).sum(axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(found.normal @ (points[-1] - points[0]), 0.0, atol=1e-6)
        np.testing.assert_allclose(found.curvature, 0.0, atol=1e-12)

    def test_known_neighbours_are_used(self):
        points = np.random.default_rng(2).normal(size=(40, 3))
        known = host.pca_normals(points, k=3, neighbors=host.knn(points, points, k=8))
        np.testing.assert_array_equal(known.normal, host.pca_normals(points, k=8).normal)


def test_orientation_is_that_of_the_jitted_twin():
    for vector in np.random.default_rng(3).normal(size=(20, 3)):
        assert host.orientation(vector) == float(linalg.orientation(jnp.asarray(vector, jnp.float32)))
