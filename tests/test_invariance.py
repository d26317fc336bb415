"""What must not matter about a scan: where it lies, in which unit it is, how it is turned. On the bundled scan."""

from importlib import resources

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jprimfit.io.clouds import read_cloud
from jprimfit.pipeline import fit

DIRECTIONS = {"plane": "normal", "cylinder": "axis", "cone": "axis"}


@pytest.fixture(scope="module")
def scan():
    with resources.as_file(resources.files("jprimfit") / "assets" / "demo.ply") as path:
        return np.asarray(read_cloud(path).points, np.float64)


@pytest.fixture(scope="module")
def scene(scan):
    return fit(scan)


def paired(scene, other):
    """For every primitive of a scene the one of the other that has most of its points, one to one, and the share of
    points whose labels are so paired."""
    common = np.zeros((len(scene.primitives) + 1, len(other.primitives) + 1))
    np.add.at(common, (scene.labels, other.labels), 1)  # -1 is the last row and column
    rows, columns = linear_sum_assignment(-common[:-1, :-1])
    partner = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    return partner, (common[rows, columns].sum() + common[-1, -1]) / len(scene.labels)


def turn(seed):
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


@pytest.mark.parametrize(
    ("scale", "shift"),
    [(1.0, [1e6, -3e5, 7e5]), (2.0**-20, [0.0, 0, 0]), (2.0**12, [0.0, 0, 0]), (1.0, [-9e2, 1e4, 5])],
)
def test_position_and_powers_of_two_change_next_to_nothing(scan, scene, scale, shift):
    moved = fit(scan * scale + np.array(shift))
    assert np.mean(moved.labels == scene.labels) >= 0.999
    size = np.ptp(scan, axis=0).max()
    for one, other in zip(scene.primitives, moved.primitives, strict=True):
        assert one.kind == other.kind
        if one.kind in DIRECTIONS:
            directions = (getattr(p, DIRECTIONS[one.kind]) for p in (one, other))
            assert np.linalg.norm(np.cross(*directions)) <= 1e-5
        if hasattr(one, "radius"):
            assert other.radius / scale == pytest.approx(one.radius, abs=1e-5 * size)
    inside = scene.labels >= 0
    differ = np.abs(moved.distances[inside] / scale - scene.distances[inside])
    assert np.quantile(differ, 0.999) <= 1e-5 * size


@pytest.mark.parametrize(("seed", "scale"), [(None, 3.7), (0, 1.0), (1, 0.013)])
def test_turns_and_other_scales_change_little(scan, scene, seed, scale):
    rotation = np.eye(3) if seed is None else turn(seed)
    moved = fit(scale * scan @ rotation.T)
    partner, agreement = paired(scene, moved)
    assert agreement >= 0.999
    size = np.ptp(scan, axis=0).max()
    for row, column in partner.items():
        one, other = scene.primitives[row], moved.primitives[column]
        errors = scene.features[row].standard_errors, moved.features[column].standard_errors
        assert one.kind == other.kind
        if hasattr(one, "radius"):
            sigma = np.hypot(errors[0]["radius"], errors[1]["radius"] / scale)
            assert abs(other.radius / scale - one.radius) <= 3 * sigma + 1e-6 * size
        if one.kind in DIRECTIONS:
            here, there = (getattr(p, DIRECTIONS[one.kind]) for p in (one, other))
            sigma = np.hypot(errors[0]["direction"], errors[1]["direction"])
            assert np.linalg.norm(np.cross(rotation @ here, there)) <= 3 * sigma + 1e-6
