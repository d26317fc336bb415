"""What a killed build leaves: finished parts in a folder beside the goal, some of them in each file.

The parts of a split are cut into chunks of CHUNK. A chunk is a data set file of its own, written complete or not at
all, so that a build which is started again makes only what is missing; the settings and the code that made the parts
are marked in the folder, and others are refused. The goal is put together from the chunks in their order.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jprimfit.data import native
from jprimfit.data.records import Part
from jprimfit.io.files import only_here

CHUNK = 16
_MARK = "made-by"
_OTHERS = "parts of other settings or of another jprimfit; delete it, or change --out."
_MAKERS = ("build.py", "families*.py", "instances.py", "records.py", "shapes.py", "solids.py", "standard_*.py")


class Chunk(NamedTuple):
    """Parts start to stop - 1 of a split."""

    split: str
    start: int
    stop: int


def chunks(counts: Mapping[str, int], whole: Mapping[str, int]) -> list[Chunk]:
    """The chunks that hold the first counts[split] of the whole[split] parts of every split; all but the last full."""
    starts = [(split, start) for split, count in counts.items() for start in range(0, count, CHUNK)]
    return [Chunk(split, start, min(start + CHUNK, whole[split])) for split, start in starts]


def folder_of(path: str | os.PathLike) -> Path:
    """Where the unfinished work for a goal lies."""
    return Path(path).with_name(Path(path).name + ".parts")


def mark_of(settings: Mapping) -> str:
    """A digest of settings and of the code that makes parts."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    home = Path(__file__).parent
    for file in sorted(file for pattern in _MAKERS for file in home.glob(pattern)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


@contextlib.contextmanager
def entered(path: str | os.PathLike, mark: str) -> Iterator[Path]:
    """The folder for a goal, made if it is absent, locked, and removed when the block ends well or with a ValueError.

    ValueError where it holds parts of another mark, or another process is in it.
    """
    folder = folder_of(path)
    if not folder.parent.is_dir():
        raise ValueError(f"{folder.parent} is not a folder; make it first.")
    marked = folder / _MARK
    if folder.exists() and any(folder.iterdir()) and not marked.is_file():
        raise ValueError(f"{folder} holds {_OTHERS}")
    folder.mkdir(exist_ok=True)
    with only_here(marked, f"Another process is building {path}: wait for it, or change --out."):
        if marked.read_text(encoding="utf-8") not in ("", mark):
            raise ValueError(f"{folder} holds {_OTHERS}")
        marked.write_text(mark, encoding="utf-8")
        problem = None
        try:
            yield folder
        except ValueError as error:
            problem = error
    shutil.rmtree(folder)  # now that the lock's file is closed
    if problem is not None:
        raise problem


def save(folder: Path, chunk: Chunk, parts: Sequence[Part], redrawn: Counter[str]) -> None:
    """Writes the parts of a chunk, and how many draws failed for each family."""
    native.write(_file(folder, chunk), parts, info={"redrawn": json.dumps(redrawn, sort_keys=True)})


def is_saved(folder: Path, chunk: Chunk) -> bool:
    """Whether a chunk is there and whole; one that is damaged is removed."""
    file = _file(folder, chunk)
    if not file.exists():
        return False
    try:
        with native.Dataset(file) as dataset:
            return len(dataset) == chunk.stop - chunk.start
    except ValueError:
        file.unlink()
        return False


def load(folder: Path, wanted: Sequence[Chunk], counts: Mapping[str, int]) -> Iterator[Part]:
    """The first counts[split] parts of the chunks, in order."""
    for chunk in wanted:
        with native.Dataset(_file(folder, chunk)) as dataset:
            for row in range(min(chunk.stop, counts[chunk.split]) - chunk.start):
                yield dataset[row]


def redrawn(folder: Path, wanted: Sequence[Chunk]) -> Counter[str]:
    """The failed draws of all these chunks."""
    total: Counter[str] = Counter()
    for chunk in wanted:
        with native.Dataset(_file(folder, chunk)) as dataset:
            total.update(json.loads(str(dataset.info["redrawn"])))
    return total


def _file(folder: Path, chunk: Chunk) -> Path:
    return folder / f"{chunk.split}_{chunk.start:06d}.h5"
