"""Disturbed benchmark clouds: seeded by their name, sizes as asked for, instances that follow their points."""

import numpy as np
import pytest

from jprimfit.data.fit4cad import BenchmarkCloud
from jprimfit.evaluation.disturbance import disturbed

POINTS = np.random.default_rng(3).uniform(0, [4, 2, 1], (2000, 3))
LOW, HIGH = (np.flatnonzero(side) for side in (POINTS[:, 2] < 0.6, POINTS[:, 2] > 0.4))
CLOUD = BenchmarkCloud("PC007", POINTS, (LOW, HIGH), ("plane", "plane"), np.array([0, 1]), np.full(2, np.nan))


def test_nothing_asked_for_changes_nothing():
    assert disturbed(CLOUD) is not CLOUD and disturbed(CLOUD).points is POINTS


def test_it_hangs_on_the_name_alone():
    every = {"rotate": True, "noise": 1.0, "thin": 30.0, "outliers": 5.0}
    assert np.array_equal(disturbed(CLOUD, **every).points, disturbed(CLOUD, **every).points)
    other = disturbed(CLOUD._replace(name="PC008"), **every)
    assert not np.array_equal(other.points, disturbed(CLOUD, **every).points)


def test_a_turn_keeps_distances_and_the_hand():
    turned = disturbed(CLOUD, rotate=True).points
    frame, before = turned[1:4] - turned[0], POINTS[1:4] - POINTS[0]
    assert frame @ frame.T == pytest.approx(before @ before.T)
    assert np.linalg.det(frame) == pytest.approx(np.linalg.det(before))
    assert not np.allclose(turned, POINTS)


def test_noise_is_in_per_cent_of_the_diagonal():
    moved = disturbed(CLOUD, noise=2.0).points - POINTS
    assert moved.std() == pytest.approx(0.02 * np.linalg.norm(np.ptp(POINTS, axis=0)), rel=0.03)


def test_instances_follow_thinned_points():
    few = disturbed(CLOUD, thin=30.0)
    assert len(few.points) == 600
    assert np.all(few.points[few.members[0], 2] < 0.6) and np.all(few.points[few.members[1], 2] > 0.4)
    assert len(few.members[0]) == np.sum(few.points[:, 2] < 0.6)
    assert len(disturbed(CLOUD, thin=0.001).points) == 1


def test_outliers_lie_in_the_box_and_in_no_instance():
    more = disturbed(CLOUD, outliers=5.0)
    assert len(more.points) == 2100 and np.array_equal(more.points[:2000], POINTS)
    added = more.points[2000:]
    assert np.all((added >= POINTS.min(axis=0)) & (added <= POINTS.max(axis=0)))
    assert max(rows.max() for rows in more.members) < 2000
