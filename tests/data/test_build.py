"""Builds are reproducible, complete or absent, and refuse settings that cannot be."""

import dataclasses
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jprimfit import settings
from jprimfit.data import build, families, instances, native
from jprimfit.data.digest import content_hash
from jprimfit.data.surfaces import draw

ROOT = Path(__file__).resolve().parents[2]
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


def test_a_killed_build_goes_on_where_it_was_and_gives_the_same_file(tmp_path):
    build.build(tmp_path / "whole.h5", FEW, workers=1)

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build.build(tmp_path / "few.h5", FEW, workers=1, progress=stop)
    left = sorted(file.name for file in (tmp_path / "few.h5.parts").iterdir())
    assert left == ["made-by", "train_000000.h5"] and not (tmp_path / "few.h5").exists()
    with pytest.raises(
        ValueError, match="few.h5.parts holds parts of other settings or of another jprimfit; delete it"
    ):
        build.build(tmp_path / "few.h5", dataclasses.replace(FEW, seed=6), workers=1)
    told, plans = [], []
    build.build(
        tmp_path / "few.h5", FEW, workers=1, progress=told.append, planned=lambda *numbers: plans.append(numbers)
    )
    assert plans == [(23, 16)] and sum(told) == 7
    assert content_hash(tmp_path / "few.h5") == content_hash(tmp_path / "whole.h5")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["few.h5", "whole.h5"]


def test_a_damaged_chunk_is_made_again(tmp_path):
    config = dataclasses.replace(FEW, train=2)
    build.build(tmp_path / "whole.h5", config, workers=1)

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build.build(tmp_path / "few.h5", config, workers=1, progress=stop)
    (chunk,) = (tmp_path / "few.h5.parts").glob("train*")
    chunk.write_bytes(chunk.read_bytes()[:-2000])
    build.build(tmp_path / "few.h5", config, workers=1)
    assert content_hash(tmp_path / "few.h5") == content_hash(tmp_path / "whole.h5")


@pytest.mark.slow
def test_a_build_whose_processes_are_killed_loses_nothing(tmp_path):
    config = dataclasses.replace(FEW, train=96, val=0, test=0)
    build.build(tmp_path / "whole.h5", config, workers=1)
    words = f"""
from jprimfit.data.build import BuildConfig, build
if __name__ == "__main__":
    build({str(tmp_path / "few.h5")!r}, BuildConfig(train=96, val=0, test=0, seed=5), workers=2)
"""
    (tmp_path / "run.py").write_text(words, encoding="utf-8")
    process = subprocess.Popen([sys.executable, str(tmp_path / "run.py")], env={**os.environ, "PYTHONPATH": str(ROOT)})
    folder, patience = tmp_path / "few.h5.parts", time.monotonic() + 120
    while not list(folder.glob("train*")) and time.monotonic() < patience:
        time.sleep(0.05)
    process.kill()
    process.wait()
    plans = []
    build.build(tmp_path / "few.h5", config, workers=1, planned=lambda *numbers: plans.append(numbers))
    assert plans[0][0] == 96 and plans[0][1] >= 16
    assert content_hash(tmp_path / "few.h5") == content_hash(tmp_path / "whole.h5")


def test_a_limit_of_size_is_kept_by_fewer_parts_of_every_split(tmp_path):
    small = build.SplitFamilies(train=("random_solid", "lever"), val=("clevis",), test=("crank",))
    config = build.BuildConfig(train=48, val=12, test=12, seed=5, families=small)
    build.build(tmp_path / "whole.h5", config, workers=1)
    size = (tmp_path / "whole.h5").stat().st_size
    build.build(tmp_path / "half.h5", dataclasses.replace(config, max_mb=size / 2e6), workers=1)
    assert 0.35 * size < (tmp_path / "half.h5").stat().st_size <= size / 2
    with native.Dataset(tmp_path / "half.h5") as half, native.Dataset(tmp_path / "whole.h5") as whole:
        counts = {split: len(rows) for split, rows in half.splits.items()}
        assert counts["val"] == counts["test"] and abs(counts["train"] - 4 * counts["val"]) <= 4
        train = [half.families[row] for row in half.splits["train"]]
        assert abs(train.count("lever") - train.count("random_solid")) <= 1
        first, same = half[0], whole[0]
        assert first.name == same.name and np.array_equal(first.mesh.vertices, same.mesh.vertices)
    with pytest.raises(ValueError, match="max_mb is 0.001, too little for a part of each split; raise it"):
        build.build(tmp_path / "none.h5", dataclasses.replace(config, max_mb=0.001), workers=1)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["half.h5", "whole.h5"]


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
        ({"max_mb": 0}, "max_mb is 0.0; expected a size above 0"),
        ({"trian": 5}, "did you mean 'train'"),
    ],
)
def test_settings_that_cannot_be_are_refused(mapping, message):
    with pytest.raises(ValueError, match=message):
        settings.from_mapping(build.BuildConfig, mapping, source="test.yaml")
