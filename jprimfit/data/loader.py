"""Batches of prepared clouds: a pure function of (seed, step), so that resuming a training needs the step only.

Examples are numbered through the whole training: row r of global batch s is example s * batch_size + r. Each epoch
passes once through the pool in an order of its own, and every example is turned by a rotation and asked at points that
depend on (seed, its number) alone: neither on the number of hosts and devices nor on what came before. Index sets do
not change under rotation. Letters: b examples, n points, q queries; a leading axis b on everything.
"""

import math
import queue
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jprimfit.data.clouds import LoaderConfig, choose_queries, random_rotation
from jprimfit.data.examples import Example
from jprimfit.data.pool import SPANS, STEPS, open_pool
from jprimfit.data.records import BACKGROUND
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.types import Truth

__all__ = ["Loader", "LoaderConfig", "ValidationBatch", "prefetch"]

_ORDER, _EXAMPLE = 0, 1  # streams of random numbers of one training
_WAIT = 0.1  # seconds after which a thread looks whether it is still wanted


class ValidationBatch(NamedTuple):
    """Some clouds of a pool as they are, asked at all of their points."""

    example: Example  # leading axis b
    mask: Bool[np.ndarray, "b"]  # False = a copy of the first example that fills the last batch
    part: Int[np.ndarray, "b"]  # number of the part in the dataset


class Loader:
    """The examples of a training, or of a validation, over the pool of `config`, which is built first if need be.

    pool.num_left_out tells how many parts of the split have too many instances. ValueError as open_pool.
    """

    def __init__(
        self,
        config: LoaderConfig,
        spec: HierarchySpec,
        neighborhoods: tuple[int, ...],
        *,
        seed: int = 0,
        progress: bool = True,
    ):
        self.config, self.seed = config, seed
        self.pool = open_pool(config, spec=spec, neighborhoods=neighborhoods, progress=progress)
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))

    @property
    def num_clouds(self) -> int:
        """Clouds of an epoch."""
        return len(self.pool)

    @property
    def num_left_out(self) -> int:
        """Parts of the split with no instance, or too many."""
        return self.pool.num_left_out

    def close(self) -> None:
        """Nothing is left to close; a Stream has processes."""

    def batch(self, step: int, batch_size: int, *, shard: tuple[int, int] = (0, 1)) -> Example:
        """The examples of one step: shard (i, k) gives the i-th of k equal runs of rows of the global batch.

        ValueError where k does not divide batch_size or i is not in [0, k).
        """
        numbers = example_numbers(step, batch_size, shard=shard)
        size = len(numbers)
        clouds = np.array([self.cloud_of(number) for number in numbers])
        rotations, queries = np.empty((size, 3, 3), np.float32), []
        for row, number in enumerate(numbers):
            generator = np.random.default_rng([self.seed, _EXAMPLE, number])
            rotations[row] = random_rotation(generator) if self.config.rotate else np.eye(3)
            valid = int(self.pool.arrays["num_valid"][clouds[row]])
            queries.append(choose_queries(generator, valid, config=self.config))
        return self._assemble(clouds, rotations, np.stack(queries))

    def cloud_of(self, number: int) -> int:
        """The cloud of the pool that example `number` of the training shows."""
        self._order, cloud = numbered_cloud(self._order, number, num_clouds=self.num_clouds, seed=self.seed)
        return cloud

    def validation(self, batch_size: int, *, num_clouds: int | None = None) -> Iterator[ValidationBatch]:
        """The first num_clouds clouds of the pool (None = all) in order, without any further draw: always the same."""
        count = len(self.pool) if num_clouds is None else min(num_clouds, len(self.pool))
        for first in range(0, count, batch_size):
            clouds = np.arange(first, first + batch_size)
            mask = clouds < count
            clouds = np.where(mask, clouds, first)
            num_points = self.pool.arrays["points"].shape[1]
            queries = np.broadcast_to(np.arange(num_points, dtype=np.int32)[None], (batch_size, num_points))
            yield ValidationBatch(self._assemble(clouds, None, queries), mask, self.pool.arrays["part"][clouds])

    def _assemble(
        self, clouds: Int[np.ndarray, "b"], rotations: Float[np.ndarray, "b 3 3"] | None, query: Int[np.ndarray, "b q"]
    ) -> Example:
        arrays, room = self.pool.arrays, self._room(len(clouds))
        units = {name: span / STEPS for name, span in SPANS.items()}
        num_points, at_queries = arrays["points"].shape[1], (clouds[:, None], query)
        valid = arrays["num_valid"][clouds][:, None]
        normals = np.empty((*query.shape, 3), np.float32)
        _turn(arrays["normals"][at_queries], rotations, normals)
        axis = np.empty((len(clouds), *arrays["axis"].shape[1:]), np.float32)
        _turn(arrays["axis"].take(clouds, 0), rotations, axis)
        for name in ("points", "local_normals", "samples"):
            _turn([arrays[name][cloud] for cloud in clouds], rotations, room[name], unit=units.get(name, 1.0))
        np.multiply(arrays["curvature"][clouds], np.float32(units["curvature"]), out=room["curvature"])
        truth = Truth(
            mask=query < valid,
            normals=_unit(normals),
            labels=np.where(query < valid, arrays["labels"][at_queries], BACKGROUND).astype(np.int32),
            instance_mask=np.arange(arrays["kind"].shape[1])[None] < arrays["num_instances"][clouds][:, None],
            kind=arrays["kind"].take(clouds, 0).astype(np.int32),
            axis=axis,
            samples=room["samples"],
        )
        return Example(
            points=room["points"],
            mask=np.arange(num_points)[None] < valid,
            local_normals=room["local_normals"],
            curvature=room["curvature"],
            sets=self.pool.index_sets(clouds, out=room),
            query=np.array(query),
            truth=truth,
        )

    def _room(self, size: int) -> dict[str, np.ndarray]:
        """Uninitialised arrays for the large parts of a batch, by their names in the pool.

        They lie in one allocation, because a large one is given huge pages: the system clears small pages one by one,
        which takes three times as long as filling them.
        """
        layout, used = {}, 0
        for name, array in self.pool.arrays.items():
            if name in ("points", "local_normals", "curvature", "samples") or name.startswith("sets."):
                dtype = np.dtype(np.float32) if name in SPANS else array.dtype
                shape = (size, *array.shape[1:])
                layout[name] = (used, shape, dtype)
                used += -(-math.prod(shape) * dtype.itemsize // 64) * 64  # where a vector load, and JAX, want it
        memory = np.empty(used + 64, np.uint8)
        memory = memory[-memory.ctypes.data % 64 :]
        return {name: np.ndarray(shape, dtype, memory, start) for name, (start, shape, dtype) in layout.items()}


def example_numbers(step: int, batch_size: int, *, shard: tuple[int, int] = (0, 1)) -> range:
    """The numbers of the examples of one step: shard (i, k) has the i-th of k equal runs of rows of the global batch.

    ValueError where k does not divide batch_size or i is not in [0, k).
    """
    place, count = shard
    if batch_size < 1 or not 0 <= place < count or batch_size % count:
        raise ValueError(
            f"Cannot give part {place} of {count} of a batch of {batch_size}; the batch size must be a "
            "multiple of the number of parts."
        )
    size = batch_size // count
    first = step * batch_size + place * size
    return range(first, first + size)


def numbered_cloud(
    known: tuple[int, np.ndarray], number: int, *, num_clouds: int, seed: int
) -> tuple[tuple[int, np.ndarray], int]:
    """The cloud that example `number` shows, behind the order of its epoch to be handed in with the next call.

    known: an epoch and its order, (-1, anything) at first.
    """
    epoch, place = divmod(number, num_clouds)
    if known[0] != epoch:
        known = epoch, np.random.default_rng([seed, _ORDER, epoch]).permutation(num_clouds)
    return known, int(known[1][place])


def prefetch(
    loader: Any,
    *,
    first_step: int,
    batch_size: int,
    last_step: int | None = None,
    shard: tuple[int, int] = (0, 1),
    depth: int = 2,
    place: Callable[[Any], Any] | None = None,
) -> Generator[tuple[int, Any]]:
    """(step, batch) of a Loader or a Stream from first_step up to, not including, last_step (None = for ever).

    One thread makes them ahead; at most `depth` batches wait, those in `place` (which puts a batch on the device, in
    the thread) included. An error in the thread is raised here. Closing the generator, or leaving it to the collector,
    ends the thread.
    """
    ready: queue.Queue[tuple[int, Any, BaseException | None] | None] = queue.Queue(maxsize=max(depth, 1))
    stopped = threading.Event()

    def hand_over(item: tuple[int, Any, BaseException | None] | None) -> None:
        while not stopped.is_set():
            try:
                return ready.put(item, timeout=_WAIT)
            except queue.Full:
                continue

    def produce() -> None:
        step = first_step
        try:
            while not stopped.is_set() and (last_step is None or step < last_step):
                batch = loader.batch(step, batch_size, shard=shard)
                hand_over((step, place(batch) if place else batch, None))
                step += 1
            hand_over(None)
        except BaseException as error:
            hand_over((step, None, error))

    thread = threading.Thread(target=produce, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not None:
            step, batch, error = item
            if error is not None:
                raise error
            yield step, batch
    finally:
        stopped.set()
        thread.join()


def _turn(
    vectors: Sequence[np.ndarray] | np.ndarray, rotations: np.ndarray | None, out: np.ndarray, *, unit: float = 1.0
) -> None:
    """Fills out, float32, with the vectors (rows of 3) of each cloud in multiples of unit, turned by its rotation."""
    # Cloud by cloud, so that what is unpacked stays in the cache.
    for row, own in enumerate(vectors):
        flat = own.reshape(-1, 3).astype(np.float32, copy=False)
        rotation = np.eye(3, dtype=np.float32) if rotations is None else rotations[row]
        np.matmul(flat, np.float32(unit) * rotation.T, out=out[row].reshape(-1, 3))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of which the rounding to fixed point has been taken back; zeros stay."""
    sq_length = np.einsum("bqc,bqc->bq", vectors, vectors)
    return vectors / np.sqrt(np.where(sq_length > 0.0, sq_length, 1.0))[:, :, None]
