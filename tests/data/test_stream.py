"""Fresh batches depend on (seed, step) alone, whoever draws them; workers report, and leave with their parent."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from multiprocessing.shared_memory import SharedMemory

import jax
import numpy as np
import pytest

from jprimfit.data import native
from jprimfit.data.clouds import LoaderConfig
from jprimfit.data.loader import Loader, prefetch
from jprimfit.data.native import Dataset
from jprimfit.data.stream import Stream
from jprimfit.geometry.hierarchy import HierarchySpec

NUM_POINTS, NUM_QUERY = 200, 64


@pytest.fixture
def config(blocks):
    return LoaderConfig(
        file=str(blocks),
        num_points=NUM_POINTS,
        num_query=NUM_QUERY,
        num_clouds=7,
        thin_share=0.5,
        min_points=40,
        num_samples=3,
        max_instances=8,
        workers=0,
    )


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def with_workers(config, count, **settings):
    return dataclasses.replace(config, workers=count, **settings)


class TestBatch:
    def test_seed_and_step_alone_decide(self, config):
        one, other = Stream(config), Stream(config)
        expected = [one.batch(step, 4) for step in range(3)]
        for step in (2, 0, 1):
            assert_same(other.batch(step, 4), expected[step])
        assert not np.array_equal(expected[0].points, expected[1].points)
        assert not np.array_equal(expected[0].points, Stream(config, seed=1).batch(0, 4).points)

    def test_shards_are_the_rows_of_the_batch(self, config):
        stream = Stream(config)
        parts = [stream.batch(2, 6, shard=(place, 3)) for place in range(3)]
        assert_same(jax.tree.map(lambda *rows: np.concatenate(rows), *parts), stream.batch(2, 6))
        with pytest.raises(ValueError, match="multiple"):
            stream.batch(0, 6, shard=(0, 4))

    def test_it_has_the_shapes_and_types_of_a_loader(self, config, tmp_path):
        spec = HierarchySpec((8,), (4,), (4,), (4,), (1.0,), (0.5,), (np.inf,))
        loader = Loader(dataclasses.replace(config, cache=str(tmp_path)), spec, (), progress=False)
        expected, found = loader.batch(0, 3), Stream(config).batch(0, 3)
        for name, values in found._asdict().items():
            for a, b in zip(jax.tree.leaves(values), jax.tree.leaves(getattr(expected, name)), strict=True):
                assert (a.shape, a.dtype) == (b.shape, b.dtype)

    def test_queries_ask_for_the_truth_of_their_points(self, config):
        example = Stream(dataclasses.replace(config, uniform_noise=(0.0, 0.0))).batch(0, 8)
        assert not example.mask.all()  # the case occurs
        for row in range(8):
            query, truth = example.query[row], jax.tree.map(lambda values, row=row: values[row], example.truth)
            assert len(set(query.tolist())) == NUM_QUERY
            np.testing.assert_array_equal(truth.mask, example.mask[row][query])
            seen = example.points[row][query].astype(np.float64)
            for instance in range(6):  # planes
                own = truth.labels == instance
                offset = truth.samples[instance] @ truth.axis[instance]
                np.testing.assert_allclose(seen[own] @ truth.axis[instance], offset[0], atol=1e-5)

    def test_no_cloud_comes_twice_and_every_part_comes_as_often(self, config):
        stream = Stream(dataclasses.replace(config, num_clouds=0))
        assert stream.num_clouds == 5 and stream.num_left_out == 0
        example = stream.batch(0, 15)
        assert len({points.tobytes() for points in example.points}) == 15
        shown = [stream._part_of(number) for number in range(15)]
        assert all(sorted(shown[first : first + 5]) == [0, 1, 2, 3, 4] for first in (0, 5, 10))

    def test_a_dataset_that_cannot_be_used_is_named(self, config):
        with pytest.raises(ValueError, match="no split 'test'"):
            Stream(dataclasses.replace(config, split="test"))
        with pytest.raises(ValueError, match="no noisy points"):
            Stream(dataclasses.replace(config, noise="stored"))


@pytest.mark.slow
class TestWorkers:
    def test_they_draw_what_one_process_draws_in_any_order_of_steps(self, config):
        alone = Stream(config)
        with Stream(with_workers(config, 2), num_slots=5) as stream:
            # A batch may be larger than the ring; another size, shard or step forgets what was drawn ahead.
            for step, size, shard in [(0, 1, (0, 1)), (0, 8, (0, 1)), (1, 8, (0, 1)), (7, 4, (1, 2)), (2, 8, (0, 1))]:
                assert_same(stream.batch(step, size, shard=shard), alone.batch(step, size, shard=shard))

    def test_prefetch_resumes_at_a_step(self, config):
        alone = Stream(config)
        with Stream(with_workers(config, 1), num_slots=4) as stream:
            for step, batch in prefetch(stream, first_step=3, last_step=6, batch_size=2):
                assert_same(batch, alone.batch(step, 2))

    def test_an_error_is_one_sentence_of_the_training(self, config, tmp_path):
        with Dataset(config.file) as dataset:
            parts = [dataset[number] for number in range(3)]
        bare = parts[2].mesh._replace(labels=np.minimum(parts[2].mesh.labels, 5))  # no triangle on the cylinder
        parts[2] = parts[2]._replace(mesh=bare)
        native.write(tmp_path / "bad.h5", parts)
        settings = with_workers(config, 1, file=str(tmp_path / "bad.h5"), num_clouds=0)
        with Stream(settings) as stream, pytest.raises(ValueError, match="bad.h5 cannot be drawn: Part .* no triangle"):
            stream.batch(0, 3)

    def test_a_worker_that_dies_is_noticed(self, config):
        with Stream(with_workers(config, 2), num_slots=4) as stream:
            stream.batch(0, 2)
            os.kill(stream._ring.workers[1].process.pid, signal.SIGKILL)
            with pytest.raises(ValueError, match=r"died \(exit code -9\)"):
                for step in range(1, 50):
                    stream.batch(step, 2)

    def test_closing_ends_workers_and_frees_the_memory(self, config):
        stream = Stream(with_workers(config, 2))
        processes, name = [worker.process for worker in stream._ring.workers], stream._ring.memory.name
        stream.batch(0, 2)
        stream.close()
        stream.close()
        assert [process.exitcode for process in processes] == [0, 0]
        with pytest.raises(FileNotFoundError):
            SharedMemory(name)
        with pytest.raises(ValueError, match="closed"):
            stream.batch(1, 2)

    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
    def test_workers_die_with_their_parent(self, blocks, number):
        program = (
            "import sys, time\n"
            "from jprimfit.data.stream import LoaderConfig, Stream\n"
            "if __name__ == '__main__':\n"
            f"    stream = Stream(LoaderConfig(file={str(blocks)!r}, num_points=64, num_query=0, workers=2))\n"
            "    stream.batch(0, 2)\n"
            "    print(*[worker.process.pid for worker in stream._ring.workers], flush=True)\n"
            "    time.sleep(60)\n"
        )
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
            workers = [int(word) for word in parent.stdout.readline().split()]
            assert len(workers) == 2 and all(is_alive(pid) for pid in workers)
            os.kill(parent.pid, number)
        for _ in range(100):
            if not any(is_alive(pid) for pid in workers):
                return
            time.sleep(0.1)
        raise AssertionError("workers outlive their parent")


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rsplit(")", 1)[1].split()[0] != "Z"
