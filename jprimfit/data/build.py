"""Data sets of random parts with exact labels: built in parallel, the same whatever the number of workers.

Part number index of a split comes from the generator of (seed, split, index, attempt) alone. A draw that fails (an
empty or divided solid, too many instances, too much of other surfaces) is redrawn with the next attempt, so that a
build never depends on what else is built. Families take turns.
"""

import os
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jprimfit.data import families as known
from jprimfit.data import instances, native, resume
from jprimfit.data.hdf5 import Scalar
from jprimfit.data.records import Part
from jprimfit.data.standard_blanks import Measured

SPLITS = ("train", "val", "test")
_FILL, _FULL, _MAX_TRIES = 0.98, 0.93, 3  # of a limit of size: aimed at, enough, corrections
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
    max_mb: float | None = None  # largest file in 10^6 bytes: fewer parts of every split, alike, where it is less

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
        if self.max_mb is not None and self.max_mb <= 0:
            raise ValueError(f"max_mb is {self.max_mb}; expected a size above 0, or null for no limit.")


def build(
    path: str | os.PathLike,
    config: BuildConfig,
    *,
    workers: int | None = None,
    progress: Callable[[int], object] | None = None,
    planned: Callable[[int, int], object] | None = None,
) -> Counter[str]:
    """Writes the data set of config to path, complete or not at all; returns the number of redrawn draws per family.

    Parts are kept in a folder beside path (resume.py) until all are there, so that a killed build goes on where it was
    and gives the same file. Under config.max_mb only the first parts of each split are made, the same share of each:
    parts come in turns of families, so that the families stay even.

    Args:
        path: of the file; its folder must exist.
        config: what is built.
        workers: number of processes; None = one per CPU, 1 = none but this one.
        progress: progress(n) is called when n more parts are finished.
        planned: planned(total, found) is called before parts are made: how many there will be and are there already.

    Raises:
        ValueError: a family gives no valid part in max_attempts draws, max_mb is too little for a part of each split,
            or the folder beside path holds parts of other settings, or is used by another build.
    """
    with resume.entered(path, resume.mark_of(asdict(replace(config, max_mb=None)))) as folder:
        crew = _Crew(folder, config, workers or os.cpu_count() or 1, progress, planned)
        wanted = _written(path, crew) if config.max_mb is None else _fitted(path, crew, config.max_mb * 1e6)
        return resume.redrawn(folder, wanted)


class _Crew(NamedTuple):
    """Who works where, and whom it tells."""

    folder: Path
    config: BuildConfig
    workers: int
    progress: Callable[[int], object] | None
    planned: Callable[[int, int], object] | None


def _written(path: str | os.PathLike, crew: _Crew, share: float = 1.0) -> list[resume.Chunk]:
    """Makes what is missing of this share of all parts and puts the file together; returns its chunks."""
    counts = _shared(crew.config, share)
    wanted = _made(crew, counts)
    native.write(path, resume.load(crew.folder, wanted, counts), info=_info(crew.config))
    return wanted


def _fitted(path: str | os.PathLike, crew: _Crew, limit: float) -> list[resume.Chunk]:
    """As _written, with the share that fills limit bytes: guessed from a few parts, then corrected."""
    draft, share, tries = crew.folder / "draft.h5", limit / _expected_bytes(crew), 0
    while True:
        share = min(1.0, _FILL * share)
        wanted = _written(draft, crew, share)
        size, tries = draft.stat().st_size, tries + 1
        if size <= limit and (share == 1.0 or size >= _FULL * limit or tries > _MAX_TRIES):
            os.replace(draft, path)
            return wanted
        if size > limit and max(_shared(crew.config, share).values()) <= 1:
            raise ValueError(f"max_mb is {crew.config.max_mb}, too little for a part of each split; raise it.")
        share *= limit / size


def _made(crew: _Crew, counts: Mapping[str, int]) -> list[resume.Chunk]:
    """The chunks of the first counts[split] parts of every split, made where they are missing."""
    wanted = resume.chunks(counts, {split: getattr(crew.config, split) for split in SPLITS})
    missing = [chunk for chunk in wanted if not resume.is_saved(crew.folder, chunk)]
    if crew.planned is not None:
        found = sum(chunk.stop - chunk.start for chunk in wanted if chunk not in missing)
        crew.planned(sum(chunk.stop - chunk.start for chunk in wanted), found)
    jobs = [(crew.folder, crew.config, chunk) for chunk in missing]
    workers = min(crew.workers, len(jobs))
    if workers <= 1:
        _tell(crew, map(_make_chunk, jobs))
        return wanted
    executor = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_end_with_parent)
    try:
        _tell(crew, (done.result() for done in as_completed([executor.submit(_make_chunk, job) for job in jobs])))
    finally:
        executor.shutdown(cancel_futures=True)
    return wanted


def _tell(crew: _Crew, finished: Iterable[int]) -> None:
    for number in finished:
        if crew.progress is not None:
            crew.progress(number)


def _make_chunk(job: tuple[Path, BuildConfig, resume.Chunk]) -> int:
    """Makes and saves the parts of a chunk; returns how many."""
    folder, config, chunk = job
    parts, redrawn = [], Counter[str]()
    for index in range(chunk.start, chunk.stop):
        part, attempts = make(config, chunk.split, index)
        parts.append(part)
        redrawn[part.family] += attempts
    resume.save(folder, chunk, parts, +redrawn)
    return len(parts)


def _end_with_parent() -> None:
    """Lets a worker end when the process that started it is killed, which cannot end it any more."""
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()


def _expected_bytes(crew: _Crew) -> float:
    """The size of the whole file, told by two turns of the families of each split."""
    expected, draft = 0.0, crew.folder / "draft.h5"
    for split, count in _shared(crew.config, 1.0).items():
        if count:
            some = {split: min(count, 2 * len(getattr(crew.config.families, split)))}
            native.write(draft, resume.load(crew.folder, _made(crew._replace(planned=None), some), some))
            expected += draft.stat().st_size * count / some[split]
    return expected


def _shared(config: BuildConfig, share: float) -> dict[str, int]:
    """The number of parts of each split: this share of all, but at least one where there is any."""
    counts = {split: getattr(config, split) for split in SPLITS}
    return {split: min(count, max(1, int(count * share))) if count else 0 for split, count in counts.items()}


def _info(config: BuildConfig) -> dict[str, Scalar]:
    standard = {*known.STANDARD_TRAIN, *known.STANDARD_VALIDATION, *known.STANDARD_TEST}
    names = {name for split in SPLITS if getattr(config, split) for name in getattr(config.families, split)}
    generator = "standard" if names & standard else "solids"
    info: dict[str, Scalar] = {"generator": generator, "seed": config.seed, "min_share": config.min_share}
    return info if config.max_mb is None else info | {"max_mb": config.max_mb}


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
        made = known.FAMILIES[family](draw)
        measured = isinstance(made, Measured)
        part = instances.make_part(
            made.solid if measured else made,
            min_share=config.min_share,
            name=f"{split}_{index:06d}",
            family=family,
            split=split,
            seed=config.seed,
        )
        if part is not None and is_valid(part, config):
            return in_millimetres(part, made.unit) if measured else part, attempt
    raise ValueError(
        f"the family {family!r} gave no valid part in {config.max_attempts} draws; "
        "loosen max_instances or max_background."
    )


def in_millimetres(part: Part, unit: float) -> Part:
    """The part whose way back (center, scale) leads to millimetres instead of units of this many millimetres."""
    return part._replace(center=np.asarray(part.center) * unit, scale=part.scale * unit, unit="mm")


def is_valid(part: Part, config: BuildConfig) -> bool:
    """Whether a part keeps the limits of config and lies on its surfaces."""
    area = float(np.sum(0.0 if part.areas is None else part.areas)) + part.background_area
    return (
        len(part.primitives) <= config.max_instances
        and part.background_area <= config.max_background * area
        and instances.largest_residual(part) <= _MAX_RESIDUAL
    )
