"""A pool is the same bytes however it was built, goes on where it was stopped, and is built once."""

import dataclasses
import shutil

import numpy as np
import pytest

from jprimfit.data import pool as pools
from jprimfit.data.clouds import LoaderConfig, draw_example
from jprimfit.data.native import Dataset
from jprimfit.data.pool import SPANS, STEPS, open_pool
from jprimfit.geometry.hierarchy import HierarchySpec

SPEC = HierarchySpec((32, 8), (8, 8), (0, 4), (8, 8), (0.5, 1.0), (0.25, 0.5), (np.inf, np.inf))
SIZES = (8, 16)


@pytest.fixture
def config(blocks, tmp_path):
    return LoaderConfig(
        file=str(blocks),
        num_points=256,
        num_query=64,
        num_clouds=40,
        thin_share=0.3,
        min_points=40,
        num_samples=12,
        cache=str(tmp_path / "pools"),
        workers=0,
    )


def open_quietly(config, **settings):
    return open_pool(dataclasses.replace(config, **settings), spec=SPEC, neighborhoods=SIZES, progress=False)


def contents(pool):
    return {path.name: path.read_bytes() for path in sorted(pool.folder.iterdir())}


def test_a_cloud_is_stored_as_it_was_drawn(config):
    pool = open_quietly(config)
    assert len(pool) == 40 and pool.num_left_out == 0
    arrays = pool.arrays
    assert arrays["part"].tolist() == [0, 1, 2, 3, 4] * 8
    with Dataset(config.file) as dataset:
        for number in (0, 6, 39):
            example = draw_example(dataset[number % 5], config=config, spec=SPEC, neighborhoods=SIZES, number=number)
            np.testing.assert_array_equal(arrays["points"][number], example.points)
            assert arrays["num_valid"][number] == example.mask.sum()
            np.testing.assert_array_equal(arrays["labels"][number], example.truth.labels)
            np.testing.assert_array_equal(arrays["kind"][number], example.truth.kind)
            np.testing.assert_array_equal(arrays["axis"][number], example.truth.axis)
            exact = example._asdict() | example.truth._asdict()
            for name, span in SPANS.items():
                values = pool.values(name, number)
                assert values.dtype == np.float32
                np.testing.assert_allclose(values, exact[name], atol=0.51 * span / STEPS)
            for stored, expected in zip(pool.index_sets(np.array([number])), example.sets, strict=True):
                for found, values in zip(stored, expected, strict=True):
                    assert found.dtype == values.dtype
                    np.testing.assert_array_equal(found[0], values)


def test_equal_settings_give_equal_bytes_and_one_build(config, monkeypatch, tmp_path):
    first = open_quietly(config)
    expected = contents(first)
    again = open_quietly(config, cache=str(tmp_path / "other"))
    assert contents(again) == expected
    monkeypatch.setattr(pools, "draw_example", None)  # whoever draws now fails
    assert open_quietly(config, num_query=32, workers=3).folder == first.folder
    assert not list(first.folder.parent.glob("*.partial"))
    with pytest.raises(TypeError):
        open_quietly(config, pool_seed=1)


def test_a_stopped_build_goes_on(config, monkeypatch):
    expected = contents(open_quietly(config))
    shutil.rmtree(config.cache)
    drawn, stop_at = [], 20

    def draw_or_stop(part, *, number, **settings):
        if number == stop_at:
            raise KeyboardInterrupt
        drawn.append(number)
        return draw_example(part, number=number, **settings)

    monkeypatch.setattr(pools, "draw_example", draw_or_stop)
    with pytest.raises(KeyboardInterrupt):
        open_quietly(config)
    assert drawn == [0, *range(20)]  # the first tells the shapes
    drawn.clear()
    stop_at = -1
    assert contents(open_quietly(config)) == expected
    assert drawn == [0, *range(16, 40)]  # the second chunk was not complete


def test_processes_build_the_same(config, tmp_path):
    expected = contents(open_quietly(config))
    assert contents(open_quietly(config, workers=2, cache=str(tmp_path / "other"))) == expected


def test_one_cloud_per_part_unless_told(config):
    pool = open_quietly(config, split="val", num_clouds=0, num_samples=0)
    assert pool.arrays["part"].tolist() == [5, 6]
    assert pool.arrays["samples"].shape == (2, 32, 0, 3)


def test_a_cache_that_cannot_be_written_is_named(config, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written"):
        open_quietly(config, cache=str(tmp_path / "file"))
