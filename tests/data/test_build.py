"""Builds are reproducible, complete or absent, and refuse settings that cannot be."""

import dataclasses

import numpy as np
import pytest

from jprimfit import settings
from jprimfit.data import build, families, instances, native
from jprimfit.data.digest import content_hash
from jprimfit.data.surfaces import draw

FEW = build.BuildConfig(train=21, val=1, test=1, seed=5)


def test_any_number_of_workers_builds_the_same_file(tmp_path):
    told = []
    redrawn = build.build(tmp_path / "one.h5", FEW, workers=1, progress=told.append)
    assert sum(told) == build.total(FEW) == 23 and redrawn.total() < 23
    build.build(tmp_path / "two.h5", FEW, workers=2)
    assert content_hash(tmp_path / "one.h5") == content_hash(tmp_path / "two.h5")
    build.build(tmp_path / "other.h5", dataclasses.replace(FEW, seed=6), workers=1)
    assert content_hash(tmp_path / "one.h5") != content_hash(tmp_path / "other.h5")
    with native.Dataset(tmp_path / "one.h5") as dataset:
        assert {split: len(rows) for split, rows in dataset.splits.items()} == {"train": 21, "val": 1, "test": 1}
        assert set(dataset.families[:21]) == set(families.TRAIN)  # in turns
        assert len(set(dataset.names)) == 23 and dataset.info["seed"] == 5
        part = dataset[3]
        assert instances.largest_residual(part) < 5e-3
        cloud = draw(part, num_points=2000, seed=0, num_samples=8)
        assert np.max(np.abs(cloud.points)) < 2 and set(np.unique(cloud.labels)) <= set(range(-1, len(part.primitives)))
    assert (tmp_path / "one.h5").stat().st_size < 23 * 30_000


def test_a_part_does_not_depend_on_what_else_is_built():
    for config in (FEW, build.seeded_test_set(40, seed=5)):
        part, _ = build.make(config, "test", 2)
        assert part.name == "test_000002" and part.family == families.TEST[2] and part.seed == 5
        areas = part.areas
    assert np.array_equal(build.make(FEW, "test", 2)[0].areas, areas)
    assert not np.array_equal(build.make(FEW, "test", 2 + len(families.TEST))[0].areas, areas)


def test_the_seeded_test_set_is_of_test_families_only():
    config = build.seeded_test_set()
    assert (config.train, config.val, config.test) == (0, 0, 330) and config.families.test == families.TEST


def test_limits_are_kept_and_a_family_that_cannot_keep_them_is_named(tmp_path):
    some = dataclasses.replace(FEW.families, train=("stepped_shaft", "bushing"))
    limited = dataclasses.replace(FEW, families=some, max_instances=9)
    parts = [build.make(limited, "train", index) for index in range(8)]
    assert all(len(part.primitives) <= 9 for part, _ in parts) and sum(attempts for _, attempts in parts) > 0
    impossible = build.BuildConfig(train=2, val=0, test=0, max_instances=1, max_attempts=3)
    with pytest.raises(ValueError, match="the family 'random_solid' gave no valid part in 3 draws; loosen"):
        build.build(tmp_path / "none.h5", impossible, workers=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"train": -1}, "train is -1; expected 0 or more"),
        ({"train": 0, "val": 0, "test": 0}, "no split has any part"),
        ({"families": {"test": []}}, "test is 330; expected 0 or more, and families.test"),
        ({"families": {"train": ["lver"]}}, "'lver' is no family of parts; known are"),
        ({"families": {"train": ["crank"]}}, "the family 'crank' stands in train and in test"),
        ({"max_instances": 0}, "max_instances and max_attempts 1 or more"),
        ({"min_share": 1.5}, "min_share and max_background must be parts of 1"),
        ({"trian": 5}, "did you mean 'train'"),
    ],
)
def test_settings_that_cannot_be_are_refused(mapping, message):
    with pytest.raises(ValueError, match=message):
        settings.from_mapping(build.BuildConfig, mapping, source="test.yaml")
