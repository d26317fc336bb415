"""What is taken from a network's answer, and what it does to growth."""

import numpy as np
import pytest

from jprimfit.fitting.advice import LEAST_PROBABILITY, MIN_POINTS, Advice, advice
from jprimfit.fitting.growing import grow_regions
from jprimfit.fitting.local import describe
from jprimfit.primitives.table import KINDS


@pytest.fixture
def line():
    """40 points along x, every second of them seen by a network that tells the two halves apart, less so at x = 20."""
    points = np.stack([np.arange(40.0), np.zeros(40), np.zeros(40)], axis=1)
    rows = np.arange(0, 40, 2)
    sure = np.where(rows == 20, 0.55, 0.9)
    left = np.where(rows < 20, sure, 1 - sure)
    membership = np.stack([left, np.zeros(20), 1 - left], axis=1)
    types = np.tile([0.7, 0.3, 0.0, 0.0], (20, 1))
    normals = np.stack([np.zeros(20), np.cos(rows / 40), np.sin(rows / 40)], axis=1)
    return points, rows, membership, types, normals


def test_hearts_are_the_clear_points_and_those_beside_them(line):
    first, second = advice(*line).patches
    assert set(first) <= set(range(20)) and set(first) >= set(range(19))
    assert set(second) <= set(range(21, 40)) and set(second) >= set(range(22, 40))


def test_a_segment_of_few_seen_points_gives_no_patch(line):
    points, rows, membership, types, normals = line
    few = membership.copy()
    few[: MIN_POINTS - 1] = [0, 1, 0]
    assert len(advice(points, rows, few, types, normals).patches) == 1
    few[MIN_POINTS - 1] = [0, 1, 0]
    assert len(advice(points, rows, few, types, normals).patches) == 2


def test_points_that_were_not_seen_take_types_and_normals_of_the_nearest(line):
    said = advice(*line)
    assert np.allclose(np.exp(said.log_types), np.maximum([0.7, 0.3, 0.0, 0.0], LEAST_PROBABILITY))
    assert np.allclose(said.normals[1::2] @ np.array([1, 0, 0]), 0)
    assert np.allclose(said.normals[::2], line[-1])


def test_the_kind_that_is_expected_wins_where_noise_hides_it():
    """A shallow cap under noise: plane or sphere? Growth alone cannot know, and follows the one who does."""
    generator = np.random.default_rng(0)
    x, y = generator.uniform(-0.5, 0.5, (2, 3000))
    points = np.stack([x, y, np.sqrt(9 - x * x - y * y) - 3], axis=1) + generator.normal(0, 0.02, (3000, 3))
    surface = describe(points)
    largest = {}
    for kind in ("plane", "sphere"):
        types = np.full((len(points), 4), LEAST_PROBABILITY)
        types[:, KINDS.index(kind)] = 1 - 3 * LEAST_PROBABILITY
        said = Advice((), np.log(types), surface.normal)
        regions = grow_regions(points, surface, advice=said)
        largest[kind] = max(regions, key=lambda region: len(region.rows)).primitive.kind
    assert largest == {"plane": "plane", "sphere": "sphere"}


def test_growth_begins_with_the_patches(parts):
    part = parts.boss()
    surface = describe(part.points)
    patches = tuple(np.flatnonzero(part.labels == number) for number in range(len(part.primitives)))
    said = Advice(patches, np.zeros((len(part.points), 4)), surface.normal)
    regions = grow_regions(part.points, surface, advice=said)
    for region, patch in zip(regions, sorted(patches, key=lambda patch: -len(patch)), strict=True):
        assert np.isin(patch, region.rows).mean() > 0.95
