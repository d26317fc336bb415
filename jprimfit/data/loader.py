"""Batches of prepared clouds: a pure function of (seed, step), so that resuming a training needs the step only.

Examples are numbered through the whole training: row r of global batch s is example s * batch_size + r. Each epoch
passes once through the pool in an order of its own, and every example is turned by a rotation and asked at points that
depend on (seed, its number) alone: neither on the number of hosts and devices nor on what came before. Index sets do
not change under rotation. Letters: b examples, n points, q queries; a leading axis b on everything.
"""

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jprimfit.data.clouds import LoaderConfig, random_rotation
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

    def batch(self, step: int, batch_size: int, *, shard: tuple[int, int] = (0, 1)) -> Example:
        """The examples of one step: shard (i, k) gives the i-th of k equal runs of rows of the global batch.

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
        numbers = range(first, first + size)
        clouds = np.array([self.cloud_of(number) for number in numbers])
        rotations, queries = np.empty((size, 3, 3), np.float32), []
        for row, number in enumerate(numbers):
            generator = np.random.default_rng([self.seed, _EXAMPLE, number])
            rotations[row] = random_rotation(generator) if self.config.rotate else np.eye(3)
            queries.append(self._queries(generator, int(self.pool.arrays["num_valid"][clouds[row]])))
        return self._assemble(clouds, rotations, np.stack(queries))

    def cloud_of(self, number: int) -> int:
        """The cloud of the pool that example `number` of the training shows."""
        epoch, place = divmod(number, len(self.pool))
        known, order = self._order
        if known != epoch:
            order = np.random.default_rng([self.seed, _ORDER, epoch]).permutation(len(self.pool))
            self._order = (epoch, order)
        return int(order[place])

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

    def _queries(self, generator: np.random.Generator, num_valid: int) -> Int[np.ndarray, "q"]:
        """num_query rows without repetition, ascending; padding only where the valid points do not suffice."""
        num_points, num_query = self.config.num_points, self.config.num_query
        if num_query in (0, num_points):
            return np.arange(num_points, dtype=np.int32)
        chosen = generator.choice(num_valid, min(num_query, num_valid), replace=False, shuffle=False)
        filling = np.arange(num_valid, num_valid + num_query - len(chosen))
        return np.concatenate([np.sort(chosen), filling]).astype(np.int32)

    def _assemble(
        self, clouds: Int[np.ndarray, "b"], rotations: Float[np.ndarray, "b 3 3"] | None, query: Int[np.ndarray, "b q"]
    ) -> Example:
        arrays, size = self.pool.arrays, len(clouds)
        points = arrays["points"].take(clouds, 0)
        num_points, at_queries = points.shape[1], (clouds[:, None], query)
        valid = arrays["num_valid"][clouds][:, None]
        instance_mask = np.arange(arrays["kind"].shape[1])[None] < arrays["num_instances"][clouds][:, None]
        local_normals = arrays["local_normals"].take(clouds, 0)
        local_normals = _turned(local_normals.reshape(size, -1, 3), rotations, "local_normals")
        samples = arrays["samples"].take(clouds, 0)
        truth = Truth(
            mask=query < valid,
            normals=_unit(_turned(arrays["normals"][at_queries], rotations, "normals")),
            labels=np.where(query < valid, arrays["labels"][at_queries], BACKGROUND).astype(np.int32),
            instance_mask=instance_mask,
            kind=arrays["kind"].take(clouds, 0).astype(np.int32),
            axis=_turned(arrays["axis"].take(clouds, 0), rotations),
            samples=_turned(samples.reshape(size, -1, 3), rotations, "samples").reshape(samples.shape),
        )
        return Example(
            points=_turned(points, rotations),
            mask=np.arange(num_points)[None] < valid,
            local_normals=local_normals.reshape(size, num_points, -1, 3),
            curvature=self.pool.values("curvature", clouds),
            sets=self.pool.index_sets(clouds),
            query=np.array(query),
            truth=truth,
        )


def prefetch(
    loader: Loader,
    *,
    first_step: int,
    batch_size: int,
    last_step: int | None = None,
    shard: tuple[int, int] = (0, 1),
    depth: int = 2,
    place: Callable[[Example], Any] | None = None,
) -> Iterator[tuple[int, Any]]:
    """(step, batch) from first_step up to, not including, last_step (None = for ever), made ahead by one thread.

    At most `depth` batches wait, those in `place` (which puts a batch on the device, in the thread) included. An error
    in the thread is raised here. Closing the generator, or leaving it to the collector, ends the thread.
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


def _turned(vectors: np.ndarray, rotations: np.ndarray | None, packed: str | None = None) -> np.ndarray:
    """(b, rows, 3) vectors, unpacked if they are fixed point, each cloud's turned by its rotation: float32."""
    scale = np.float32(SPANS[packed] / STEPS if packed else 1.0)
    vectors = vectors.astype(np.float32, copy=False)
    if rotations is None:
        return vectors * scale
    return vectors @ np.swapaxes(rotations * scale, 1, 2)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of which the rounding to fixed point has been taken back; zeros stay."""
    sq_length = np.einsum("bqc,bqc->bq", vectors, vectors)
    return vectors / np.sqrt(np.where(sq_length > 0.0, sq_length, 1.0))[:, :, None]
