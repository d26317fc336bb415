"""Batches depend on (seed, step) alone, turn a cloud and its truth together, and arrive in order from a thread."""

import dataclasses
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.data import loader as loaders
from jprimfit.data.clouds import LoaderConfig
from jprimfit.data.loader import Loader, prefetch
from jprimfit.data.records import KINDS
from jprimfit.geometry import hierarchy
from jprimfit.geometry.hierarchy import HierarchySpec

SPEC = HierarchySpec((32, 8), (8, 8), (4, 4), (8, 8), (0.5, 1.0), (0.25, 0.5), (np.inf, np.inf))
NUM_CLOUDS, NUM_POINTS, NUM_QUERY = 7, 256, 128


@pytest.fixture(scope="module")
def make_loader(blocks, tmp_path_factory):
    cache = tmp_path_factory.mktemp("pools")
    standard = LoaderConfig(
        file=str(blocks),
        num_points=NUM_POINTS,
        num_query=NUM_QUERY,
        num_clouds=NUM_CLOUDS,
        thin_share=0.5,
        min_points=40,
        num_samples=12,
        cache=str(cache),
        workers=0,
        uniform_noise=(0.0, 0.0),
        max_instances=8,
    )

    def make(seed=0, **settings):
        config = dataclasses.replace(standard, **settings)
        return Loader(config, SPEC, (8, 16), seed=seed, progress=False)

    return make


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def differ(a, b):
    return not np.array_equal(a.points, b.points)


class TestBatch:
    def test_seed_and_step_alone_decide(self, make_loader):
        loader, other = make_loader(), make_loader()
        wanted = [loader.batch(step, 4) for step in (0, 1, 5)]
        for step, expected in zip((5, 1, 0), reversed(wanted), strict=True):
            assert_same(other.batch(step, 4), expected)
        assert differ(wanted[0], wanted[1]) and differ(wanted[0], make_loader(seed=1).batch(0, 4))

    def test_shapes_and_types(self, make_loader):
        example = make_loader().batch(0, 3)
        shapes = {
            name: (np.shape(values), values.dtype)
            for name, values in example._asdict().items()
            if name not in ("sets", "truth")
        }
        assert shapes == {
            "points": ((3, 256, 3), np.float32),
            "mask": ((3, 256), np.bool_),
            "local_normals": ((3, 256, 2, 3), np.float32),
            "curvature": ((3, 256, 2), np.float32),
            "query": ((3, 128), np.int32),
        }
        assert {name: (np.shape(values), values.dtype) for name, values in example.truth._asdict().items()} == {
            "mask": ((3, 128), np.bool_),
            "normals": ((3, 128, 3), np.float32),
            "labels": ((3, 128), np.int32),
            "instance_mask": ((3, 8), np.bool_),
            "kind": ((3, 8), np.int32),
            "axis": ((3, 8, 3), np.float32),
            "samples": ((3, 8, 12, 3), np.float32),
        }

    def test_shards_are_the_rows_of_the_batch(self, make_loader):
        loader = make_loader()
        whole, parts = loader.batch(3, 6), [loader.batch(3, 6, shard=(place, 3)) for place in range(3)]
        assert_same(jax.tree.map(lambda *rows: np.concatenate(rows), *parts), whole)
        with pytest.raises(ValueError, match="multiple"):
            loader.batch(0, 6, shard=(0, 4))
        with pytest.raises(ValueError, match="part 3 of 3"):
            loader.batch(0, 6, shard=(3, 3))

    def test_an_epoch_shows_every_cloud_once_in_an_order_of_its_own(self, make_loader):
        loader = make_loader()
        epochs = [[loader.cloud_of(7 * epoch + place) for place in range(7)] for epoch in range(4)]
        assert all(sorted(order) == list(range(7)) for order in epochs)
        assert len({tuple(order) for order in epochs}) == 4
        # A batch may lie across two epochs.
        example, other = loader.batch(0, 9), loader.batch(0, 7)
        np.testing.assert_array_equal(example.points[:7], other.points)
        np.testing.assert_array_equal(example.points[7], loader.batch(7, 1).points[0])

    def test_cloud_and_truth_are_turned_together(self, make_loader):
        loader = make_loader()
        example, numbers = loader.batch(2, 4), range(8, 12)
        stored = next(iter(make_loader(num_query=0).validation(7))).example
        for row, number in enumerate(numbers):
            cloud = loader.cloud_of(number)
            before, after = (
                np.asarray(batch.points[place], np.float64) for batch, place in ((stored, cloud), (example, row))
            )
            rotation = np.linalg.lstsq(before, after)[0]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
            assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5) and np.abs(rotation - np.eye(3)).max() > 0.01
            query, mask = example.query[row], example.truth.mask[row]
            truth = jax.tree.map(lambda values, cloud=cloud: values[cloud], stored.truth)
            pairs = [
                (example.local_normals[row], stored.local_normals[cloud], 1e-4),
                (example.truth.normals[row], truth.normals[query], 1e-4),
                (example.truth.axis[row], truth.axis, 1e-5),
                (example.truth.samples[row], truth.samples, 1e-4),
            ]
            for found, expected, tolerance in pairs:
                np.testing.assert_allclose(found, expected @ rotation, atol=tolerance)
            np.testing.assert_array_equal(mask, stored.mask[cloud][query])
            np.testing.assert_array_equal(example.truth.labels[row], truth.labels[query])
            np.testing.assert_allclose(np.sum(np.square(example.truth.normals[row]), axis=1), 1.0, atol=1e-5)

    def test_samples_lie_on_the_turned_surfaces(self, make_loader):
        example = make_loader().batch(0, 7)
        for row in range(7):
            truth = jax.tree.map(lambda values, row=row: values[row].astype(np.float64), example.truth)
            points = example.points[row, example.query[row]].astype(np.float64)
            for instance in np.flatnonzero(truth.instance_mask):
                own = points[truth.labels == instance]
                both = np.concatenate([own, truth.samples[instance]])
                axis = truth.axis[instance]
                if KINDS[int(truth.kind[instance])] == "plane":
                    assert np.ptp(both @ axis) < 3e-4
                else:  # without the axial part, all lie on one circle
                    flat = both - np.outer(both @ axis, axis)
                    frame = np.linalg.svd(flat - flat.mean(axis=0))[2][:2]
                    plane = flat @ frame.T
                    unknowns = np.column_stack([2 * plane, np.ones(len(plane))])
                    x, y, _ = np.linalg.lstsq(unknowns, np.sum(plane**2, axis=1))[0]
                    assert np.ptp(np.hypot(plane[:, 0] - x, plane[:, 1] - y)) < 1e-3

    def test_stored_index_sets_hold_for_the_turned_cloud(self, make_loader):
        example = make_loader().batch(0, 7)
        row = int(np.argmax(example.mask.sum(axis=1)))
        points, mask = jnp.asarray(example.points[row]), jnp.asarray(example.mask[row])
        sets = jax.tree.map(lambda values: jnp.asarray(values[row]), example.sets)
        found = jax.jit(hierarchy.from_index_sets)(points, sets, mask)
        expected = jax.jit(hierarchy.build, static_argnames="spec")(points, mask, spec=SPEC)

        for a, b in zip(found.points + found.density, expected.points + expected.density, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        for a, b in zip(
            found.encoder_groups + found.decoder_groups, expected.encoder_groups + expected.decoder_groups, strict=True
        ):
            np.testing.assert_array_equal(a.mask, b.mask)
            np.testing.assert_allclose(a.sq_distance, b.sq_distance, atol=1e-4)

    def test_queries(self, make_loader):
        loader = make_loader()
        examples = [loader.batch(step, 7) for step in range(3)]
        for example in examples:
            for query, mask, valid in zip(example.query, example.truth.mask, example.mask, strict=True):
                assert len(set(query.tolist())) == NUM_QUERY and query.min() >= 0 and query.max() < NUM_POINTS
                assert mask.sum() == min(valid.sum(), NUM_QUERY)
                np.testing.assert_array_equal(mask, valid[query])
        assert min(example.truth.mask.sum(axis=1).min() for example in examples) < NUM_QUERY  # the case occurs
        fullest = int(np.argmax(loader.pool.arrays["num_valid"]))
        shown = [
            examples[step].query[place]
            for step in (0, 1)
            for place in range(7)
            if loader.cloud_of(7 * step + place) == fullest
        ]
        assert len(shown) == 2 and not np.array_equal(*shown)
        everywhere = make_loader(num_query=0).batch(0, 2)
        np.testing.assert_array_equal(everywhere.query, np.tile(np.arange(NUM_POINTS), (2, 1)))

    def test_nothing_turns_unless_asked(self, make_loader):
        loader = make_loader(rotate=False)
        np.testing.assert_array_equal(
            loader.batch(0, 7).points, loader.pool.arrays["points"][[loader.cloud_of(j) for j in range(7)]]
        )


class TestValidation:
    def test_every_cloud_once_in_the_normalised_frame(self, make_loader):
        loader = make_loader()
        batches = list(loader.validation(3))
        assert [batch.mask.tolist() for batch in batches] == [[True] * 3, [True] * 3, [True, False, False]]
        assert np.concatenate([batch.part[batch.mask] for batch in batches]).tolist() == [0, 1, 2, 3, 4, 0, 1]
        for batch in batches:
            points, mask = batch.example.points, batch.example.mask
            assert batch.example.query.shape == mask.shape
            for cloud, valid in zip(points, mask, strict=True):
                assert np.ptp(cloud[valid], axis=0).max() == pytest.approx(2.0, abs=1e-5)
        np.testing.assert_array_equal(batches[-1].example.points[2], batches[-1].example.points[0])
        for again, batch in zip(make_loader(seed=9).validation(3), batches, strict=True):
            assert_same(again, batch)

    def test_the_first_few(self, make_loader):
        batches = list(make_loader().validation(4, num_clouds=5))
        assert [batch.mask.sum() for batch in batches] == [4, 1]


class TestPrefetch:
    def test_batches_come_in_order(self, make_loader):
        loader = make_loader()
        for (step, batch), expected in zip(
            prefetch(loader, first_step=3, last_step=6, batch_size=2), (3, 4, 5), strict=True
        ):
            assert step == expected
            assert_same(batch, loader.batch(step, 2))

    def test_they_are_placed_in_the_thread(self, make_loader):
        names = prefetch(
            make_loader(), first_step=0, last_step=2, batch_size=2, place=lambda _: threading.current_thread().name
        )
        assert list(names) == [(0, "prefetch"), (1, "prefetch")]

    @pytest.mark.parametrize("depth", [1, 4])
    def test_an_error_is_raised_where_the_batch_is_awaited(self, make_loader, depth):
        def fail(example):
            raise RuntimeError("no device")

        with pytest.raises(RuntimeError, match="no device"):
            next(prefetch(make_loader(), first_step=0, batch_size=2, place=fail, depth=depth))
        assert "prefetch" not in {thread.name for thread in threading.enumerate()}

    def test_closing_ends_the_thread(self, make_loader, monkeypatch):
        monkeypatch.setattr(loaders, "_WAIT", 0.01)
        batches = prefetch(make_loader(), first_step=0, batch_size=2)
        assert next(batches)[0] == 0
        assert "prefetch" in {thread.name for thread in threading.enumerate()}
        batches.close()
        assert "prefetch" not in {thread.name for thread in threading.enumerate()}
