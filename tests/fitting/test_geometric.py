"""Surfaces proposed by geometry alone: kinds, parameters, one per true surface, the same however the cloud is given."""

import numpy as np
import pytest

from jprimfit.fitting.geometric import propose

STEPS = {"boss": 0.075, "ball_and_funnel": 0.09, "fillet": 0.07, "two_faces": 0.08}
SURFACES = {"boss": [0, 1, 2], "ball_and_funnel": [0, 1], "fillet": [0, 1, 2], "two_faces": [0, 0, 1]}


@pytest.fixture(scope="module")
def proposed(parts):
    """The proposal for a part with noise of a share of its step, made once."""
    kept = {}

    def make(name, noise):
        if (name, noise) not in kept:
            part = getattr(parts, name)()
            proposal = propose(part.noisy(noise * STEPS[name]))
            kept[name, noise] = part, proposal.surfaces, proposal.labels
        return kept[name, noise]

    return make


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("name", SURFACES)
def test_each_true_surface_is_found_once_with_its_kind_and_parameters(proposed, parts, name, noise):
    part, surfaces, labels = proposed(name, noise)
    truth = np.array(SURFACES[name])[part.labels]
    assert len(surfaces) == truth.max() + 1
    assert (labels < 0).mean() < 0.01
    matched = [int(np.bincount(labels[(truth == number) & (labels >= 0)]).argmax()) for number in range(len(surfaces))]
    assert sorted(matched) == list(range(len(surfaces)))
    for primitive, number in zip(part.primitives, SURFACES[name], strict=True):
        assert parts.gap(surfaces[matched[number]].primitive, primitive) < (0.003 if noise == 0 else 0.02)
    assert (labels == np.array(matched)[truth]).mean() > (0.99 if noise == 0 else 0.9)


def test_labels_point_to_the_smallest_surface_that_has_the_row(proposed):
    part, surfaces, labels = proposed("boss", 0.0)
    sizes = [len(surface.rows) for surface in surfaces]
    assert sizes == sorted(sizes, reverse=True)
    expected = np.full(len(part.points), -1)
    for number, surface in enumerate(surfaces):
        expected[surface.rows] = number
    np.testing.assert_array_equal(labels, expected)
    assert labels.dtype == np.int32


@pytest.mark.parametrize("name", ["boss", "fillet"])
def test_order_and_pose_of_the_points_do_not_matter(proposed, parts, name):
    part, surfaces, labels = proposed(name, 0.0)
    rng = np.random.default_rng(5)
    order = rng.permutation(len(part.points))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for points in (part.points[order], (part.points @ turn)[order] + 0.3):
        again = propose(points)
        assert sorted(s.primitive.kind for s in again.surfaces) == sorted(s.primitive.kind for s in surfaces)
        assert parts.same_partition(again.labels, labels[order])


def test_what_is_no_surface_gives_no_proposal():
    surfaces, labels = propose(np.random.default_rng(0).normal(size=(8, 3)))[:2]
    assert surfaces == [] and (labels == -1).all()


def test_thin_walls_under_much_noise_are_no_echoes():
    # A sheet of two faces, the lower one half covered: they lie 1.5 tolerances apart, as terraces of a table do.
    rng = np.random.default_rng(0)
    noise, count = 0.02, 6_000
    upper = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, 0.09)])
    lower = np.column_stack([rng.uniform(-1, 0, count // 4), rng.uniform(-1, 1, count // 4), np.zeros(count // 4)])
    points = np.concatenate([upper, lower])
    points = points + noise * rng.normal(size=points.shape)
    found = propose(points)
    assert found.described.noise == pytest.approx(noise, rel=0.15)
