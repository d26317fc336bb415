"""A pool of prepared clouds: drawn, made noisy and searched once, then read by every training that wants the same.

A pool is a folder of .npy arrays with one row per cloud, memory-mapped, so that several processes share it. Its name is
a digest of all that determines its bytes. It is built in chunks by processes: a chunk is complete, with a mark beside
it, or is done again, so that a build that was stopped goes on. Unit vectors, curvature and samples are kept as fixed
point of 16 bits: value = number * SPANS[array] / STEPS.
"""

import hashlib
import json
import multiprocessing
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from jprimfit.cores import num_cores
from jprimfit.data.clouds import SCANNING, LoaderConfig, draw_example, usable_parts
from jprimfit.data.digest import content_hash
from jprimfit.data.examples import Example
from jprimfit.data.native import Dataset
from jprimfit.geometry.hierarchy import HierarchySpec, IndexSets

VERSION = 2  # raised whenever equal settings give other bytes
STEPS = 32767
SPANS = {"local_normals": 1.0, "normals": 1.0, "curvature": 0.5, "samples": 2.5}
CHUNK = 16  # clouds between two marks
_FREE = ("file", "num_query", "cache", "workers", "feed")  # settings that do not touch the stored clouds


class Pool:
    """The arrays of a complete pool, open for reading; row j of each belongs to cloud j.

    points (n, 3) float32; num_valid (): points before the padding; part (): number in the dataset; num_instances ();
    local_normals (n, g, 3), curvature (n, g), normals (n, 3), samples (i, m, 3) int16 as above; labels (n,); kind (i,);
    axis (i, 3) float32; and the index sets, see index_sets.
    """

    def __init__(self, folder: Path):
        about = json.loads((folder / "pool.json").read_text(encoding="utf-8"))
        self.folder = folder
        self.num_left_out: int = about["num_left_out"]  # parts of the split with too many instances, or none
        self.arrays = {name: _open(folder, name, layout, mode="r") for name, layout in about["arrays"].items()}
        self._num_steps = sum(name.startswith("sets.index.") for name in self.arrays)

    def __len__(self) -> int:
        return len(self.arrays["points"])

    def values(self, name: str, rows: Any) -> np.ndarray:
        """Some rows of an array that is kept as fixed point, float32."""
        return np.multiply(self.arrays[name][rows], np.float32(SPANS[name] / STEPS), dtype=np.float32)

    def index_sets(self, rows: np.ndarray, *, out: Mapping[str, np.ndarray] | None = None) -> IndexSets:
        """The index sets of some clouds, stacked; written into the arrays of these names where out is given."""

        def stacked(name: str) -> np.ndarray:
            # Other modes than clip write into a copy of out first.
            return self.arrays[name].take(rows, 0, out=out[name] if out else None, mode="clip")

        steps = range(self._num_steps)
        fields: Any = [tuple(stacked(f"sets.{field}.{step}") for step in steps) for field in IndexSets._fields]
        return IndexSets(*fields)


def open_pool(
    config: LoaderConfig, *, spec: HierarchySpec, neighborhoods: tuple[int, ...], progress: bool = True
) -> Pool:
    """The pool of these settings, built first if it is not there yet.

    ValueError for a dataset that cannot be used, or a cache folder that cannot be written.
    """
    about = _about(config, spec, neighborhoods)
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
    cache = Path(config.cache) if config.cache else Path(config.file).parent / "pools"
    folder = cache / f"{Path(config.file).stem}-{config.split}-{digest}"
    if not (folder / "pool.json").exists():
        try:
            _build(folder, about, config, spec, neighborhoods, progress=progress)
        except OSError as error:
            # Another process may have finished the same pool, and moved it, in the meantime.
            if not (folder / "pool.json").exists():
                raise ValueError(f"The pool {folder} cannot be written: {error}; choose another cache.") from error
    return Pool(folder)


def _about(config: LoaderConfig, spec: HierarchySpec, neighborhoods: tuple[int, ...]) -> dict[str, Any]:
    """All that determines the bytes of a pool, for JSON."""
    defaults = {field.name: field.default for field in fields(config)}
    # What came after the first pools is named where it is used only, so that those keep their digests.
    unused = {name for name in SCANNING if getattr(config, name) == defaults[name]}
    settings = {name: value for name, value in asdict(config).items() if name not in unused.union(_FREE)}
    return {
        "version": VERSION,
        "dataset": content_hash(config.file),
        "settings": settings,
        "hierarchy": asdict(spec),
        "neighborhoods": neighborhoods,
    }


def _build(
    folder: Path,
    about: dict[str, Any],
    config: LoaderConfig,
    spec: HierarchySpec,
    neighborhoods: tuple[int, ...],
    *,
    progress: bool,
) -> None:
    """Fills folder.partial, chunk by chunk, and renames it once it is complete."""
    with Dataset(config.file) as dataset:
        parts, num_left_out = usable_parts(dataset, config)
        count = config.num_clouds or len(parts)
        if count < len(parts):  # some of every family, which stand one after the other
            parts = parts[np.arange(count) * len(parts) // count]
        partial = folder.with_name(folder.name + ".partial")
        partial.mkdir(parents=True, exist_ok=True)
        # The first cloud tells the types and shapes of all.
        first = draw_example(dataset[int(parts[0])], config=config, spec=spec, neighborhoods=neighborhoods, number=0)
    packed = _pack(first, part=0)
    layouts = {name: [values.dtype.str, [count, *values.shape]] for name, values in packed.items()}
    for name, layout in layouts.items():
        _create(partial, name, layout)
    starts = [start for start in range(0, count, CHUNK) if not _mark(partial, start).exists()]
    jobs = [
        (
            partial,
            layouts,
            config,
            spec,
            neighborhoods,
            [(j, int(parts[j % len(parts)])) for j in range(s, min(s + CHUNK, count))],
        )
        for s in starts
    ]
    done = count - sum(len(job[-1]) for job in jobs)
    with tqdm(
        total=count, initial=done, unit="cloud", desc=f"preparing {config.split}", disable=not progress, smoothing=0.05
    ) as bar:
        for finished in _run(jobs, config.workers):
            bar.update(finished)
    text = json.dumps({**about, "num_left_out": num_left_out, "arrays": layouts}, indent=1, sort_keys=True)
    (partial / "pool.json").write_text(text, encoding="utf-8")
    for start in range(0, count, CHUNK):
        _mark(partial, start).unlink(missing_ok=True)
    partial.rename(folder)


def _run(jobs: list[tuple], workers: int) -> Iterator[int]:
    """The number of clouds of each chunk as it is completed."""
    workers = min(num_cores() if workers < 0 else workers, len(jobs))
    if workers == 0:
        yield from map(_fill, jobs)
        return
    import jax

    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(cache,)) as executor:
        try:
            for future in as_completed([executor.submit(_fill, job) for job in jobs]):
                yield future.result()
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


def _start_worker(compilation_cache: str | None) -> None:
    """Keeps a worker off the accelerator, which belongs to the training, and lets it use what is compiled already."""
    import jax

    jax.config.update("jax_platforms", "cpu")
    if compilation_cache:
        jax.config.update("jax_compilation_cache_dir", compilation_cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _fill(job: tuple) -> int:
    """Draws and stores the clouds of one chunk, then marks it; returns their number."""
    partial, layouts, config, spec, neighborhoods, clouds = job
    arrays = {name: _open(partial, name, layout, mode="r+") for name, layout in layouts.items()}
    dataset = _dataset(config.file)
    for number, part in clouds:
        example = draw_example(dataset[part], config=config, spec=spec, neighborhoods=neighborhoods, number=number)
        for name, values in _pack(example, part=part).items():
            arrays[name][number] = values
    for array in arrays.values():
        if isinstance(array, np.memmap):
            array.flush()
    _mark(partial, clouds[0][0]).touch()
    return len(clouds)


@lru_cache(maxsize=1)
def _dataset(file: str) -> Dataset:
    """The dataset of this process: opening one reads the table of all parts."""
    return Dataset(file)


def _pack(example: Example, *, part: int) -> dict[str, np.ndarray]:
    """What is stored of one cloud."""
    truth = example.truth
    kept = {
        "points": example.points,
        "num_valid": np.int32(np.sum(example.mask)),
        "part": np.int32(part),
        "num_instances": np.int32(np.sum(truth.instance_mask)),
        "labels": truth.labels.astype(np.int8 if len(truth.kind) <= 128 else np.int16),
        "kind": truth.kind.astype(np.int8),
        "axis": truth.axis,
    }
    exact = {"local_normals": example.local_normals, "curvature": example.curvature}
    for name, values in (exact | {"normals": truth.normals, "samples": truth.samples}).items():
        kept[name] = np.rint(values * (STEPS / SPANS[name])).clip(-STEPS, STEPS).astype(np.int16)
    for field, steps in zip(IndexSets._fields, example.sets, strict=True):
        for step, values in enumerate(steps):
            kept[f"sets.{field}.{step}"] = values
    return {name: np.asarray(values) for name, values in kept.items()}


def _create(folder: Path, name: str, layout: list) -> None:
    dtype, shape = layout
    path = folder / f"{name}.npy"
    if np.prod(shape) and not path.exists():
        # Renamed when its full length is there, so that a build that stops here leaves no short file.
        unfinished = folder / f"{name}.{os.getpid()}.new"
        np.lib.format.open_memmap(unfinished, mode="w+", dtype=dtype, shape=tuple(shape)).flush()
        unfinished.rename(path)


def _open(folder: Path, name: str, layout: list, *, mode: Any) -> np.ndarray:
    """One array of a pool; an empty one has no file."""
    dtype, shape = layout
    if not np.prod(shape):
        return np.zeros(shape, dtype)
    array = np.load(folder / f"{name}.npy", mmap_mode=mode)
    # Reading through the subclass memmap costs more than the bytes do.
    return np.asarray(array) if mode == "r" else array


def _mark(folder: Path, start: int) -> Path:
    return folder / f"chunk-{start}.done"
