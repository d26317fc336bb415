"""Data sets of random parts with exact labels: built in parallel, the same whatever the number of workers.

Part number index of a split comes from the generator of (seed, split, index, attempt) alone. A draw that fails (an
empty or divided solid, too many instances, too much of other surfaces) is redrawn with the next attempt, so that a
build never depends on what else is built. Families take turns.
"""

import itertools
import os
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context

import numpy as np

from jprimfit.data import families as known
from jprimfit.data import instances, native
from jprimfit.data.records import Part

SPLITS = ("train", "val", "test")
_CHUNK = 16  # parts that a worker makes at a time
_MAX_RESIDUAL = 5e-3  # of a corner from its surface, normalised frame: chords are off by less; more is a fault


@dataclass(frozen=True)
class SplitFamilies:
    """The families of each split; a name that stands twice takes two turns."""

    train: tuple[str, ...] = known.TRAIN
    val: tuple[str, ...] = known.VALIDATION
    test: tuple[str, ...] = known.TEST

    def __post_init__(self):
        homes: dict[str, str] = {}
        for split in SPLITS:
            for name in getattr(self, split):
                if name not in known.FAMILIES:
                    raise ValueError(f"{name!r} is no family of parts; known are {', '.join(known.FAMILIES)}.")
                if homes.setdefault(name, split) != split:
                    raise ValueError(f"the family {name!r} stands in {homes[name]} and in {split}; keep it in one.")


@dataclass(frozen=True)
class BuildConfig:
    """What is built: how many parts of each split, of which families, and what a part may be."""

    train: int = 6000
    val: int = 300
    test: int = 330
    seed: int = 0
    families: SplitFamilies = field(default_factory=SplitFamilies)
    max_instances: int = 40
    min_share: float = 0.005  # pieces under this part of the area become background
    max_background: float = 0.25  # largest part of the area that may be background
    max_attempts: int = 50  # draws for one part before the build gives up

    def __post_init__(self):
        for split in SPLITS:
            if getattr(self, split) < 0 or (getattr(self, split) and not getattr(self.families, split)):
                raise ValueError(f"{split} is {getattr(self, split)}; expected 0 or more, and families.{split} for it.")
        if not any(getattr(self, split) for split in SPLITS):
            raise ValueError("no split has any part; give train, val or test a number above 0.")
        if not 0 <= self.seed < 2**63 or self.max_instances < 1 or self.max_attempts < 1:
            raise ValueError("seed must be 0 or more, max_instances and max_attempts 1 or more.")
        if not (0 <= self.min_share < 1 and 0 <= self.max_background <= 1):
            raise ValueError("min_share and max_background must be parts of 1.")


def build(
    path: str | os.PathLike,
    config: BuildConfig,
    *,
    workers: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Counter[str]:
    """Writes the data set of config to path, complete or not at all; returns the number of redrawn draws per family.

    workers is the number of processes (None = one per CPU, 1 = none but this one); progress(1) is called per part. The
    file's info holds the settings. ValueError where a family gives no valid part in max_attempts draws.
    """
    workers = min(workers or os.cpu_count() or 1, total(config))
    redrawn: Counter[str] = Counter()

    def parts(found: Iterator[tuple[Part, int]]) -> Iterator[Part]:
        for part, attempts in found:
            redrawn[part.family] += attempts
            if progress is not None:
                progress(1)
            yield part

    jobs = [(config, split, index) for split in SPLITS for index in range(getattr(config, split))]
    info = {"generator": "solids", "seed": config.seed, "min_share": config.min_share}
    if workers == 1:
        native.write(path, parts(map(_make, jobs)), info=info)
        return redrawn
    executor = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    try:
        native.write(path, parts(_in_order(executor, jobs, waiting=4 * workers)), info=info)
    finally:
        executor.shutdown(cancel_futures=True)
    return redrawn


def seeded_test_set(num_parts: int = 330, *, seed: int = 0) -> BuildConfig:
    """The settings of the test set that evaluation uses: parts of the test families, num_parts of them, nothing else.

    A part depends on (seed, split, index) alone, so they are the first test parts of any build of that seed.
    """
    return BuildConfig(train=0, val=0, test=num_parts, seed=seed)


def total(config: BuildConfig) -> int:
    """The number of parts of all splits."""
    return sum(getattr(config, split) for split in SPLITS)


def make(config: BuildConfig, split: str, index: int) -> tuple[Part, int]:
    """Part number index of a split, and how many draws before it failed."""
    names = getattr(config.families, split)
    family = names[index % len(names)]
    for attempt in range(config.max_attempts):
        draw = np.random.default_rng([config.seed, zlib.crc32(split.encode()), index, attempt])
        part = instances.make_part(
            known.FAMILIES[family](draw),
            min_share=config.min_share,
            name=f"{split}_{index:06d}",
            family=family,
            split=split,
            seed=config.seed,
        )
        if part is not None and is_valid(part, config):
            return part, attempt
    raise ValueError(
        f"the family {family!r} gave no valid part in {config.max_attempts} draws; "
        "loosen max_instances or max_background."
    )


def is_valid(part: Part, config: BuildConfig) -> bool:
    """Whether a part keeps the limits of config and lies on its surfaces."""
    area = float(np.sum(0.0 if part.areas is None else part.areas)) + part.background_area
    return (
        len(part.primitives) <= config.max_instances
        and part.background_area <= config.max_background * area
        and instances.largest_residual(part) <= _MAX_RESIDUAL
    )


def _make(job: tuple[BuildConfig, str, int]) -> tuple[Part, int]:
    return make(*job)


def _make_all(jobs: list[tuple[BuildConfig, str, int]]) -> list[tuple[Part, int]]:
    return [_make(job) for job in jobs]


def _in_order(executor: ProcessPoolExecutor, jobs: list, *, waiting: int) -> Iterator[tuple[Part, int]]:
    """The results in the order of the jobs, with at most this many chunks begun and not yet taken."""
    chunks = (jobs[start : start + _CHUNK] for start in range(0, len(jobs), _CHUNK))
    begun = [executor.submit(_make_all, chunk) for chunk in itertools.islice(chunks, waiting)]
    while begun:
        yield from begun.pop(0).result()
        begun += [executor.submit(_make_all, chunk) for chunk in itertools.islice(chunks, 1)]
