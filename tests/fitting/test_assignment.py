"""Every point to its surface: edges, spread of labels, outliers; and surfaces cut into faces."""

import numpy as np
import pytest

from jprimfit.fitting.assignment import MIN_FACE, assign, faces, linked, without_needless
from jprimfit.fitting.local import describe
from jprimfit.fitting.merging import Surface
from jprimfit.types import Cylinder, Plane

TOLERANCE = 0.01


def corner(num=20, step=0.1):
    """A plate twice as long as the wall at its end; the last column holds the points of the edge between them."""
    x, y = np.meshgrid(np.arange(-2 * num, 1), np.arange(num), indexing="ij")
    plate = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    wall = np.stack([0 * x, y, -x], axis=2).reshape(-1, 3)
    wall = wall[(wall[:, 2] > 0) & (wall[:, 2] < num)]
    points = step * np.concatenate([plate, wall])
    surfaces = [
        Surface(np.arange(len(plate)), Plane(np.array([0.0, 0, 1]), np.float64(0))),
        Surface(len(plate) + np.arange(len(wall)), Plane(np.array([1.0, 0, 0]), np.float64(0))),
    ]
    return points, surfaces, np.repeat([0, 1], [len(plate), len(wall)]).astype(np.int32)


def test_points_on_a_sharp_edge_go_to_the_smaller_surface():
    points, surfaces, truth = corner()
    on_edge = (points[:, 0] == 0) & (points[:, 2] == 0)
    assert on_edge.any() and len(surfaces[1].rows) < len(surfaces[0].rows)
    start = np.where(on_edge, -1, truth).astype(np.int32)
    found = assign(points, describe(points), surfaces, start, tolerance=TOLERANCE)
    assert found.dtype == np.int32
    assert (found[on_edge] == 1).all()
    np.testing.assert_array_equal(found[~on_edge], truth[~on_edge])


def test_labels_spread_to_neighbours_and_not_to_what_no_surface_explains():
    points, surfaces, truth = corner()
    rng = np.random.default_rng(0)
    hidden = rng.random(len(points)) < 0.3
    outliers = rng.uniform([-3, 0, -2], [-0.3, 1.9, -0.2], (15, 3))
    scan = np.concatenate([points, outliers])
    start = np.concatenate([np.where(hidden, -1, truth), np.full(15, -1)]).astype(np.int32)
    found = assign(scan, describe(scan, noise=0.0, spacing=0.1), surfaces, start, tolerance=TOLERANCE)
    assert (found[len(points) :] == -1).all()
    away = (points[:, 0] < -0.15) | (points[:, 2] > 0.15)
    np.testing.assert_array_equal(found[: len(points)][away], truth[away])
    assert (found[: len(points)] >= 0).all()


def test_wrong_labels_are_put_right():
    points, surfaces, truth = corner()
    start = truth.copy()
    start[np.random.default_rng(0).choice(len(points), 100, replace=False)] ^= 1
    found = assign(points, describe(points), surfaces, start, tolerance=TOLERANCE)
    away = (points[:, 0] < -0.05) | (points[:, 2] > 0.05)
    np.testing.assert_array_equal(found[away], truth[away])


def test_without_surfaces_all_stay_unassigned():
    points, _, truth = corner(num=4)
    found = assign(points, describe(points), [], truth, tolerance=TOLERANCE)
    assert found.dtype == np.int32 and (found == -1).all()


@pytest.fixture
def islands(parts):
    """Three separated plates in one plane, in random order of rows, and which island each row is on."""
    rng = np.random.default_rng(0)
    pieces = [
        parts.rectangle((x, 0, 0), (w, 0, 0), (0, 1, 0), step=0.1, rng=rng) for x, w in ((0, 0.7), (2, 1.5), (5, 1.0))
    ]
    part = parts.join(*pieces)
    order = rng.permutation(len(part.points))
    return part.points[order], part.labels[order]


def test_a_surface_is_cut_into_its_islands_largest_first(islands):
    points, island = islands
    surface_number = np.where(island == 2, 1, 0)
    face, surface_of = faces(linked(points, describe(points)), surface_number.astype(np.int32))
    assert face.dtype == surface_of.dtype == np.int32
    np.testing.assert_array_equal(face, np.array([2, 0, 1])[island])
    np.testing.assert_array_equal(surface_of, [0, 1, 0])
    assert (np.diff(np.bincount(face)) <= 0).all()


def test_touching_faces_of_two_surfaces_stay_two():
    points, _, truth = corner()
    face, surface_of = faces(linked(points, describe(points)), truth)
    np.testing.assert_array_equal(face, truth)
    np.testing.assert_array_equal(surface_of, [0, 1])


def test_specks_and_unassigned_points_are_on_no_face(islands):
    points, island = islands
    labels = np.zeros(len(points), np.int32)
    labels[island == 2] = -1
    far = np.flatnonzero(island == 0)
    speck = far[np.argsort(np.linalg.norm(points[far] - points[far[:1]], axis=1))[: MIN_FACE - 1]]
    labels[far] = -1
    labels[speck] = 1
    face, surface_of = faces(linked(points, describe(points)), labels)
    np.testing.assert_array_equal(face, np.where(island == 1, 0, -1))
    np.testing.assert_array_equal(surface_of, [0])
    nothing, of_none = faces(linked(points, describe(points)), np.full(len(points), -1, np.int32))
    assert (nothing == -1).all() and of_none.shape == (0,)


def test_a_surface_made_of_two_others_points_is_given_up_and_a_chamfer_is_not():
    points, surfaces, truth = corner()
    described = describe(points, noise=TOLERANCE / 3, spacing=0.1)
    across, along = np.hypot(points[:, 0], points[:, 2]), np.array([0.0, 1, 0])
    # A thin cylinder lies along the edge: it holds the points beside it, as both planes do.
    beside = (across > 0) & (across < 0.15) & (points[:, 1] < 0.8)
    speck = Surface(np.flatnonzero(beside), Cylinder(along, np.zeros(3), np.float64(0.1)))
    labels = np.where(beside, 2, truth).astype(np.int32)
    links = linked(points, described)
    found = without_needless(points, described, [*surfaces, speck], links, labels, tolerance=TOLERANCE)
    np.testing.assert_array_equal(found, np.where(beside, -1, truth))
    # The same points on a chamfer are explained by nothing else.
    slope, height = np.array([-1.0, 0, 1]) / np.sqrt(2), np.float64(0.15 / np.sqrt(2))
    points = points + np.outer(np.where(beside, height - points @ slope, 0), slope)
    chamfer = Surface(np.flatnonzero(beside), Plane(slope, height))
    found = without_needless(points, described, [*surfaces, chamfer], links, labels, tolerance=TOLERANCE)
    np.testing.assert_array_equal(found, labels)
