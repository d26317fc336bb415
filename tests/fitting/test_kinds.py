"""Fits called from the host: parameters, degenerate rows, starts, and the distances that the rest relies on."""

import numpy as np
import pytest

from jprimfit.fitting import kinds
from jprimfit.primitives.table import KINDS
from jprimfit.types import Plane

SHIFT, SCALE = np.array([300.0, -200.0, 500.0]), 0.01
each_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def patch(parts):
    """Per kind a patch of about 200 points on one surface, moved far from the origin."""

    def make(kind):
        rng = np.random.default_rng(3)
        points, normals, primitive = {
            "plane": lambda: parts.rectangle((0, 0, 1), (1, 0.5, 0), (-0.4, 0.8, 0.6), step=0.075, rng=rng),
            "sphere": lambda: parts.ball((0.3, 0, 0), 0.8, step=0.1, lowest=0.5),
            "cylinder": lambda: parts.tube((0, 0.2, 0), 0.7, 1.0, step=0.1, rng=rng, axis=1, turn=3.0),
            "cone": lambda: parts.funnel((0.2, 0, 0), 0.5, 0.5, 1.2, step=0.1),
        }[kind]()
        return SCALE * points + SHIFT, normals, kinds.move(primitive, SHIFT, SCALE)

    return make


def at_home(primitive):
    """The primitive brought back to where its patch was made, at size one about the origin."""
    return kinds.move(primitive, -SHIFT / SCALE, 1 / SCALE)


@each_kind
def test_parameters_are_found_far_from_the_origin(patch, parts, kind):
    points, normals, true = patch(kind)
    fitted = kinds.fit(kind, points, normals, np.arange(len(points)))
    assert parts.gap(at_home(fitted.primitive), at_home(true)) < 1e-4
    assert fitted.rms < 1e-6 * SCALE
    assert parts.distance(fitted.primitive, points).max() < 1e-5 * SCALE
    assert all(np.asarray(field).dtype == np.float64 for field in fitted.primitive)


@each_kind
def test_only_the_rows_count_and_rms_is_that_of_the_distances(patch, parts, kind):
    points, normals, true = patch(kind)
    rng = np.random.default_rng(0)
    scan = np.concatenate([points + 0.01 * SCALE * rng.normal(size=points.shape), rng.normal(size=(50, 3)) + SHIFT])
    all_normals = np.concatenate([normals, rng.normal(size=(50, 3))])
    rows = rng.permutation(len(points))
    fitted = kinds.fit(kind, scan, all_normals, rows)
    expected = np.sqrt(np.mean(parts.distance(fitted.primitive, scan[rows]) ** 2))
    assert fitted.rms == pytest.approx(expected, rel=1e-3)
    # Least squares: no worse than the truth, and near the noise.
    assert fitted.rms <= np.sqrt(np.mean(parts.distance(true, scan[rows]) ** 2))
    assert 0.008 * SCALE < fitted.rms < 0.011 * SCALE


@each_kind
def test_a_start_is_polished_to_the_same_primitive(patch, parts, kind):
    points, normals, true = patch(kind)
    rows = np.arange(len(points))
    free = kinds.fit(kind, points, normals, rows)
    start = kinds.move(kinds.move(at_home(true), np.full(3, 0.05), 1.05), SHIFT, SCALE)
    polished = kinds.fit(kind, points, np.zeros_like(normals), rows, start=start)
    assert parts.gap(at_home(start), at_home(free.primitive)) > 0.02
    assert parts.gap(at_home(polished.primitive), at_home(free.primitive)) < 1e-4


def test_rows_that_determine_nothing_give_none(patch):
    points, normals, _ = patch("plane")
    same = np.zeros(20, int)
    assert all(kinds.fit(kind, points, normals, same) is None for kind in KINDS)
    line = np.linspace(0, 1, 20)[:, None] * [[1.0, 2, 3]]
    assert kinds.fit("plane", line, np.tile([0.0, 0, 1], (20, 1)), np.arange(20)) is None


def test_a_sample_is_spread_over_the_rows(parts):
    points, normals, _ = parts.rectangle((0, 0, 0), (2, 0, 0), (0, 2, 0), step=0.05, rng=np.random.default_rng(0))
    # Sorted along x the first 256 rows would lie in a narrow strip; bent upwards beyond the middle they differ.
    points = points[np.argsort(points[:, 0])]
    bent = points + np.maximum(points[:, :1] - 1, 0) * [[0, 0, 1.0]]
    fitted = kinds.fit("plane", bent, normals, np.arange(len(points)), sample=256)
    assert len(points) > 4 * 256
    assert (
        np.abs(fitted.primitive.normal @ np.linalg.svd(bent - bent.mean(axis=0)[None], full_matrices=False)[2][2])
        > 0.9999
    )


@each_kind
def test_agreement_distances_and_normals_equal_numpy(patch, parts, kind):
    points, normals, true = patch(kind)
    local, primitive = (points - SHIFT) / SCALE, at_home(true)
    rng = np.random.default_rng(0)
    aside = local + 0.05 * rng.normal(size=local.shape)
    distance, cosine = kinds.Cloud(aside, normals).agreement(primitive)
    assert distance.shape == cosine.shape == (len(points),)
    np.testing.assert_allclose(distance, parts.distance(primitive, aside), atol=1e-6)
    np.testing.assert_allclose(kinds.distances(primitive, aside), parts.distance(primitive, aside), atol=1e-6)
    found = kinds.normals(primitive, local)
    np.testing.assert_allclose(np.abs(np.sum(found * normals, axis=1)), 1, atol=1e-5)
    expected = np.abs(np.sum(kinds.normals(primitive, aside) * normals, axis=1))
    np.testing.assert_allclose(cosine, expected, atol=1e-5)


@each_kind
def test_move_carries_the_surface_and_can_be_undone(patch, parts, kind):
    points, _, primitive = patch(kind)
    shift, scale = np.array([3.0, -1.0, 2.0]), 2.5
    moved = kinds.move(primitive, shift, scale)
    aside = points + SCALE * np.random.default_rng(0).normal(size=points.shape)
    np.testing.assert_allclose(
        parts.distance(moved, scale * aside + shift), scale * parts.distance(primitive, aside), atol=1e-9
    )
    assert parts.gap(kinds.move(moved, -shift / scale, 1 / scale), primitive) < 1e-9


@each_kind
def test_move_turns_the_surface_and_its_sign_is_canonical(patch, parts, kind):
    points, _, primitive = patch(kind)
    rng = np.random.default_rng(0)
    aside = points + SCALE * rng.normal(size=points.shape)
    for _ in range(4):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn = turn * np.linalg.det(turn)
        moved = kinds.move(primitive, SHIFT, 2.0, turn)
        np.testing.assert_allclose(
            parts.distance(moved, 2.0 * aside @ turn.T + SHIFT), 2.0 * parts.distance(primitive, aside), atol=1e-9
        )
        if kind in ("plane", "cylinder"):
            assert moved[0][np.argmax(np.abs(moved[0]))] > 0


def test_move_makes_directions_unit_again():
    assert np.linalg.norm(kinds.move(Plane(np.array([0.0, 0, 1.0001]), np.float64(1)), np.zeros(3), 1.0).normal) == 1
