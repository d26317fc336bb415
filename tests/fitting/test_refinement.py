"""From proposed surfaces to faces of all points: consistency, repair, and truth that is left in peace."""

import numpy as np
import pytest

from jprimfit.fitting.geometric import propose
from jprimfit.fitting.merging import Surface
from jprimfit.fitting.refinement import refine
from jprimfit.types import Plane

NAMES = ("boss", "ball_and_funnel", "fillet", "two_faces")


def truth_of(part):
    """The true surfaces, the pieces of one plane united, and the surface of each point."""
    keys = [str([np.round(field, 9).tolist() for field in primitive]) for primitive in part.primitives]
    number = np.array([keys.index(key) for key in keys])
    labels = np.unique(number[part.labels], return_inverse=True)[1].astype(np.int32)
    surfaces = [
        Surface(np.flatnonzero(labels == i), part.primitives[part.labels[np.flatnonzero(labels == i)[0]]])
        for i in range(labels.max() + 1)
    ]
    return surfaces, labels


def check_consistent(parts, found, points):
    """What holds for every answer, whatever its quality."""
    used = found.labels >= 0
    assert found.labels.shape == found.distances.shape == (len(points),)
    assert found.labels.dtype == found.surface_of.dtype == np.int32
    assert len(found.surface_of) == len(found.primitives)
    counts = np.bincount(found.labels[used], minlength=len(found.primitives))
    assert (counts > 0).all() and (np.diff(counts) <= 0).all()
    assert sorted(set(found.surface_of.tolist())) == list(range(found.surface_of.max(initial=-1) + 1))
    for surface in set(found.surface_of.tolist()):
        of_one = [found.primitives[i] for i in np.flatnonzero(found.surface_of == surface)]
        assert all(parts.gap(primitive, of_one[0]) == 0 for primitive in of_one)
    np.testing.assert_array_equal(np.isnan(found.distances), ~used)
    for number, primitive in enumerate(found.primitives):
        rows = found.labels == number
        np.testing.assert_allclose(found.distances[rows], parts.distance(primitive, points[rows]), atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.004])
@pytest.mark.parametrize("name", NAMES)
def test_a_proposal_becomes_consistent_faces(parts, name, noise):
    part = getattr(parts, name)()
    points = part.noisy(noise)
    found = refine(points, *propose(points)[:2])
    check_consistent(parts, found, points)
    assert len(found.primitives) == len(part.primitives)
    assert found.noise == pytest.approx(noise, rel=0.2, abs=5e-4)
    partner = [int(np.bincount(found.labels[part.labels == i] + 1).argmax()) - 1 for i in range(len(part.primitives))]
    assert sorted(partner) == list(range(len(partner)))
    assert (found.labels == np.array(partner)[part.labels]).mean() > (0.99 if noise == 0 else 0.96)
    for primitive, i in zip(part.primitives, partner, strict=True):
        assert parts.gap(found.primitives[i], primitive) < (1e-3 if noise == 0 else 0.02)


def test_two_coplanar_faces_have_two_labels_and_one_surface(parts):
    part = parts.two_faces()
    surfaces, labels = truth_of(part)
    assert len(surfaces) == 2
    found = refine(part.points, surfaces, labels)
    np.testing.assert_array_equal(found.labels, part.labels)
    np.testing.assert_array_equal(found.surface_of, [0, 0, 1])


def test_primitives_that_are_off_and_labels_that_are_missing_are_mended(parts):
    part = parts.boss()
    surfaces, labels = truth_of(part)
    shifted = [
        Surface(rows, type(p)(*(p[:-1]), p[-1] + 0.001)) for rows, p in surfaces
    ]  # offset, radius and height by a third of the tolerance
    labels[np.random.default_rng(0).random(len(labels)) < 0.4] = -1
    points = part.noisy(0.001)
    found = refine(points, shifted, labels)
    check_consistent(parts, found, points)
    assert [p.kind for p in found.primitives] == ["plane", "cylinder", "plane"]
    assert (found.labels == part.labels).mean() > 0.98
    for primitive, true in zip(found.primitives, part.primitives, strict=True):
        assert abs(primitive[-1] - true[-1]) < 2e-4


def test_points_on_a_sharp_edge_go_to_the_smaller_face(parts):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-30, 1), np.arange(20), indexing="ij"))
    z, w = (a.ravel() for a in np.meshgrid(np.arange(1, 18), np.arange(20), indexing="ij"))
    points = 0.07 * np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([0 * z, w, z], 1)])
    found = refine(points, *propose(points)[:2])
    check_consistent(parts, found, points)
    on_edge = (points[:, 0] == 0) & (points[:, 2] == 0)
    np.testing.assert_array_equal(found.labels, np.where((points[:, 2] > 0) | on_edge, 1, 0))


def test_normals_are_those_of_the_surfaces_and_of_the_points_where_there_is_none(parts):
    part = parts.fillet()
    surfaces, labels = truth_of(part)
    measured = np.where(labels[:, None] == len(surfaces) - 1, [[0.6, 0.8, 0.0]], part.normals)
    labels[labels == len(surfaces) - 1] = -1
    found = refine(part.points, surfaces[:-1], labels, measured)
    used = found.labels >= 0
    assert 0 < used.sum() < len(labels)
    assert np.abs(np.sum(found.normals * part.normals, axis=1))[used].mean() > 0.999
    np.testing.assert_array_equal(found.normals[~used], measured[~used])


def test_no_surfaces_no_faces(parts):
    points = parts.fillet().points
    found = refine(points, [], np.full(len(points), -1, np.int32))
    check_consistent(parts, found, points)
    assert found.primitives == () and (found.labels == -1).all()


def test_a_surface_that_keeps_no_face_leaves_no_gap_in_the_numbers(parts):
    part = parts.fillet()
    surfaces, labels = truth_of(part)
    nowhere = Surface(np.zeros(0, int), Plane(np.array([0.0, 0, 1]), np.float64(50)))
    found = refine(part.points, [nowhere, *surfaces], (labels + 1).astype(np.int32))
    check_consistent(parts, found, part.points)
    assert len(found.primitives) == 3


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("name", NAMES)
def test_true_labels_do_not_become_worse(parts, name, share):
    """Started from the truth, next to no point leaves its surface, and primitives stay within a few noises of it."""
    for seed in range(3):
        part = getattr(parts, name)()
        noise = share * 0.075
        points = part.noisy(noise, seed=seed)
        surfaces, labels = truth_of(part)
        found = refine(points, surfaces, labels)
        check_consistent(parts, found, points)
        assert len(found.primitives) == len(part.primitives)
        partner = [
            int(np.bincount(found.labels[part.labels == i] + 1).argmax()) - 1 for i in range(len(found.primitives))
        ]
        assert (found.labels == np.array(partner)[part.labels]).mean() > 0.97
        for i, primitive in enumerate(part.primitives):
            assert parts.gap(found.primitives[partner[i]], primitive) < 4 * noise
