"""Batches of clouds that are drawn for every step anew, by worker processes, into shared memory.

The second way to feed a training, for devices that search faster than the host: nothing is prepared or stored, and no
cloud comes twice. Examples are numbered as in data/loader, and each is a function of (seed, its number) alone, whoever
draws it. Workers run ahead of the training as far as a ring of slots, one cloud each, reaches. Letters: b clouds.
"""

import atexit
import contextlib
import itertools
import math
import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.shared_memory import SharedMemory
from typing import Any, NamedTuple

import numpy as np

from jprimfit.cores import num_cores
from jprimfit.data.clouds import LoaderConfig, draw_queried, usable_parts
from jprimfit.data.examples import Scan
from jprimfit.data.loader import example_numbers, numbered_cloud
from jprimfit.data.native import Dataset
from jprimfit.types import Truth

_PATIENCE = 5.0  # seconds that a worker has to end by itself
_ALIGNMENT = 64
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class _Worker(NamedTuple):
    process: Any
    connection: Connection


class Stream:
    """The examples of a training, drawn from the parts of a split; close it, or use it in a with statement.

    An epoch is config.num_clouds clouds, 0 = one of each part; num_left_out tells how many parts of the split have no
    instance or too many. config.workers = 0 draws where it is called. ValueError for a dataset that cannot be used.
    """

    def __init__(self, config: LoaderConfig, *, seed: int = 0, num_slots: int = 64):
        self.config, self.seed = config, seed
        with Dataset(config.file) as dataset:
            self.parts, self.num_left_out = usable_parts(dataset, config)
            self.num_clouds = config.num_clouds or len(self.parts)
            # One cloud tells the types and shapes of all, and what is wrong with the settings.
            first = _flat(draw_queried(dataset[int(self.parts[0])], config=config, seed=(seed, 0)))
        self._layout = [(values.dtype.str, values.shape) for values in first]
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))
        self._expected: tuple | None = None  # the arguments of the next call of batch, if it is as usual
        self._ahead: Iterator[int] = iter(())  # the numbers to be drawn
        self._dataset: Dataset | None = None
        self._ring: _Ring | None = None
        count = num_cores() if config.workers < 0 else config.workers
        if count:
            self._ring = _Ring(config, seed, self._layout, num_slots=max(num_slots, count), num_workers=count)

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the workers and frees the shared memory; a second time it does nothing."""
        if self._ring is not None:
            self._ring.close()
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def batch(self, step: int, batch_size: int, *, shard: tuple[int, int] = (0, 1)) -> Scan:
        """The examples of one step, with a leading axis b; steps, shards and errors as in data/loader.Loader.batch.

        Steps may be asked for in any order; in ascending order they are drawn ahead. ValueError, too, where a worker
        cannot draw a cloud or has died.
        """
        numbers = example_numbers(step, batch_size, shard=shard)
        rows = [np.empty((len(numbers), *shape), kind) for kind, shape in self._layout]
        if self._ring is None:
            for row, number in enumerate(numbers):
                for values, own in zip(rows, _flat(self._draw(number)), strict=True):
                    values[row] = own
            return _unflat(rows)
        if not self._ring.workers:
            raise ValueError("The stream of clouds is closed; open another.")
        if self._expected != (step, batch_size, shard):
            self._ring.forget()
            steps = (example_numbers(later, batch_size, shard=shard) for later in itertools.count(step))
            self._ahead = itertools.chain.from_iterable(steps)
        self._expected = None
        for row, number in enumerate(numbers):
            self._fill(self._ring)
            while number not in self._ring.ready:
                self._ring.wait()
                self._fill(self._ring)
            self._ring.take(number, [values[row] for values in rows])
        self._expected = (step + 1, batch_size, shard)
        return _unflat(rows)

    def _fill(self, ring: "_Ring") -> None:
        """Has clouds drawn ahead, as many as there is room for."""
        while ring.free:
            number = next(self._ahead)
            ring.ask(number, self._part_of(number))

    def _draw(self, number: int) -> Scan:
        if self._dataset is None:
            self._dataset = Dataset(self.config.file)
        return draw_queried(self._dataset[self._part_of(number)], config=self.config, seed=(self.seed, number))

    def _part_of(self, number: int) -> int:
        self._order, cloud = numbered_cloud(self._order, number, num_clouds=self.num_clouds, seed=self.seed)
        return int(self.parts[cloud % len(self.parts)])


class _Ring:
    """Slots of shared memory, a cloud each, and the processes that fill them."""

    def __init__(self, config: LoaderConfig, seed: int, layout: list, *, num_slots: int, num_workers: int):
        self.file = config.file
        self.memory = SharedMemory(create=True, size=num_slots * _slot_bytes(layout))
        self.slots = _views(self.memory, layout, num_slots)
        self.free = list(range(num_slots))
        self.number: dict[int, int] = {}  # of the example in each slot that is asked for; without it nobody wants it
        self.ready: dict[int, int] = {}  # example: slot
        self.jobs: list[set[int]] = [set() for _ in range(num_workers)]  # slots that each worker has to fill
        self.workers: list[_Worker] = []
        atexit.register(self.close)
        context = multiprocessing.get_context("spawn")
        try:
            with _environment(_ONE_THREAD, "1"):
                for _ in range(num_workers):
                    own, other = context.Pipe()
                    arguments = (other, self.memory.name, layout, num_slots, config, seed)
                    process = context.Process(target=_work, args=arguments, name="clouds", daemon=True)
                    self.workers.append(_Worker(process, own))
                    process.start()
                    other.close()  # else the end of the worker would not show in `own`
        except BaseException:
            self.close()
            raise

    def ask(self, number: int, part: int) -> None:
        """Has example `number` drawn from a part, by the worker that has least to do."""
        slot = self.free.pop()
        least = min(range(len(self.jobs)), key=lambda worker: len(self.jobs[worker]))
        self.number[slot] = number
        self.jobs[least].add(slot)
        try:
            self.workers[least].connection.send((slot, number, part))
        except OSError:
            self._died(least)

    def take(self, number: int, rows: list[np.ndarray]) -> None:
        """Copies example `number`, which is ready, into rows, and frees its slot."""
        slot = self.ready.pop(number)
        for values, slots in zip(rows, self.slots, strict=True):
            values[...] = slots[slot]
        self._release(slot)

    def wait(self) -> None:
        """Takes in what workers report, once one does."""
        connections = [worker.connection for worker in self.workers]
        for connection in wait(connections):
            worker = connections.index(connection)  # pyright: ignore[reportArgumentType]
            try:
                slot, problem = connections[worker].recv()
            except (EOFError, OSError):
                self._died(worker)
            self.jobs[worker].discard(slot)
            if slot not in self.number:
                self._release(slot)
            elif problem:
                raise ValueError(f"A cloud of {self.file} cannot be drawn: {problem}")
            else:
                self.ready[self.number[slot]] = slot

    def forget(self) -> None:
        """Wants nothing of what was asked for; what is being drawn keeps its slot until it is done."""
        for slot in self.ready.values():
            self._release(slot)
        self.ready = {}
        self.number = {}

    def close(self) -> None:
        """Ends the workers, which do so when their connection is closed, and frees the memory."""
        atexit.unregister(self.close)
        workers, self.workers, self.slots = self.workers, [], []
        for worker in workers:
            worker.connection.close()
        for worker in workers:
            if worker.process.pid is not None:
                worker.process.join(_PATIENCE)
                worker.process.kill()
                worker.process.join()
        with contextlib.suppress(FileNotFoundError):
            self.memory.close()
            self.memory.unlink()

    def _release(self, slot: int) -> None:
        self.number.pop(slot, None)
        self.free.append(slot)

    def _died(self, worker: int) -> None:
        process = self.workers[worker].process
        process.join(_PATIENCE)
        raise ValueError(
            f"A process that draws clouds died (exit code {process.exitcode}); give data.workers fewer where memory, "
            "or the shared memory in /dev/shm, is short."
        )


def _work(connection: Connection, memory_name: str, layout: list, num_slots: int, config: LoaderConfig, seed: int):
    """The life of a worker: fills slots until its connection ends, which it does with the process at the other end."""
    # A signal is for the training, which may still want a batch before it stops.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    memory = SharedMemory(memory_name)
    slots = _views(memory, layout, num_slots)
    dataset = None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            slot, number, part = connection.recv()
            problem = ""
            try:
                dataset = dataset or Dataset(config.file)
                scan = draw_queried(dataset[part], config=config, seed=(seed, number))
                for values, own in zip(slots, _flat(scan), strict=True):
                    values[slot] = own
            except Exception as error:
                words = " ".join(str(error).split()) or "no words"
                problem = words if isinstance(error, ValueError) else f"{type(error).__name__}, {words}"
            connection.send((slot, problem))
    del slots  # the memory cannot be closed while arrays look at it
    memory.close()


def _flat(scan: Scan) -> list[np.ndarray]:
    return [*scan[:3], *scan.truth]


def _unflat(arrays: list[np.ndarray]) -> Scan:
    points, mask, query, *truth = arrays
    return Scan(points, mask, query, Truth._make(truth))


def _slot_bytes(layout: list) -> int:
    return sum(_padded_bytes(kind, shape) for kind, shape in layout)


def _padded_bytes(kind: str, shape: tuple[int, ...]) -> int:
    return -(-math.prod(shape) * np.dtype(kind).itemsize // _ALIGNMENT) * _ALIGNMENT


def _views(memory: SharedMemory, layout: list, num_slots: int) -> list[np.ndarray]:
    """The arrays of a ring, the slots along their first axis."""
    views, start = [], 0
    for kind, shape in layout:
        views.append(np.ndarray((num_slots, *shape), kind, memory.buf, start))
        start += num_slots * _padded_bytes(kind, shape)
    return views


@contextlib.contextmanager
def _environment(names: tuple[str, ...], value: str) -> Iterator[None]:
    """Variables that processes started meanwhile inherit: their matrix products would fight for the cores."""
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, value))
    try:
        yield
    finally:
        for name, old in before.items():
            if old is None:
                del os.environ[name]
            else:
                os.environ[name] = old
