"""Every family gives valid parts, no two alike, and lies in one split."""

import dataclasses

import numpy as np
import pytest

from jprimfit.data import build, families, instances, records, solids


def config_of(family):
    split = next(s for s in build.SPLITS if family in getattr(build.SplitFamilies(), s))
    return split, build.BuildConfig(families=dataclasses.replace(build.SplitFamilies(), **{split: (family,)}))


def check_invariants(part):
    records.check(part, source=part.name)
    mesh, vertices = part.mesh, part.mesh.vertices.astype(np.float64)
    doubled = solids.doubled_areas(vertices[mesh.faces])
    sizes = np.sqrt(np.sum(doubled**2, axis=1)) / 2
    by_label = np.bincount(mesh.labels + 1, weights=sizes, minlength=len(part.primitives) + 1)
    assert by_label[1:] == pytest.approx(part.areas, rel=1e-4) and np.all(part.areas > 0)
    assert by_label[0] == pytest.approx(part.background_area, abs=1e-4)
    ends = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert np.array_equal(np.sort(ends[:, 0] * 10**6 + ends[:, 1]), np.sort(ends[:, 1] * 10**6 + ends[:, 0]))  # closed
    assert np.sum(vertices[mesh.faces][:, 0] * doubled) > 0  # outward
    assert np.max(np.ptp(vertices, axis=0)) == pytest.approx(2, abs=1e-5)
    assert sizes @ np.mean(vertices[mesh.faces], axis=1) / np.sum(sizes) == pytest.approx(np.zeros(3), abs=1e-5)
    for label, primitive in enumerate(part.primitives):
        mine = mesh.labels == label
        distance, gradient = solids.signed_distance(primitive, np.mean(vertices[mesh.faces[mine]], axis=1))
        along = np.sum(doubled[mine] * gradient, axis=1)
        # One side of the surface is outside all over an instance, and triangles lie along it.
        assert np.abs(np.sum(along)) > 0.999 * np.sum(np.abs(along))
        assert np.sum(np.abs(along)) > 0.93 * 2 * np.sum(sizes[mine])
        assert np.max(np.abs(distance)) < 0.02
    assert instances.largest_residual(part) < 5e-3


@pytest.mark.parametrize("family", families.FAMILIES)
def test_every_family_gives_valid_parts(family):
    split, config = config_of(family)
    parts = [build.make(config, split, index)[0] for index in range(3)]
    for part in parts:
        check_invariants(part)
        assert part.family == family and 1 <= len(part.primitives) <= config.max_instances
    tables = {records.pack(part.primitives).parameters.tobytes() for part in parts}
    assert len(tables) == 3


def test_the_splits_share_no_family():
    splits = [families.TRAIN, families.VALIDATION, families.TEST]
    names = [name for split in splits for name in split]
    assert len(names) == len(set(names)) and set(names) == set(families.FAMILIES)
    assert len(families.VALIDATION) >= 3 and len(families.TEST) >= 8


@pytest.mark.slow
def test_hundreds_of_parts_keep_every_promise():
    config = build.BuildConfig(seed=11)
    for split, count in (("train", 420), ("val", 60), ("test", 165)):
        redrawn = 0
        for index in range(count):
            part, attempts = build.make(config, split, index)
            check_invariants(part)
            redrawn += attempts
        assert redrawn < count / 5


def test_corners_lie_on_their_surfaces_almost_everywhere():
    config, close, total = build.BuildConfig(), 0, 0
    for index in range(len(families.TRAIN)):
        part, _ = build.make(config, "train", index)
        for label, primitive in enumerate(part.primitives):
            rows = np.unique(part.mesh.faces[part.mesh.labels == label])
            distance, _ = solids.signed_distance(primitive, part.mesh.vertices[rows].astype(np.float64))
            close, total = close + np.sum(np.abs(distance) < 1e-6), total + len(rows)
    assert close > 0.995 * total
