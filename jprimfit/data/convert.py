"""Parts from files of several formats into one data set, or a folder of TraceParts files.

What a file is is told by its content: STEP, our own format, TraceParts, ParSeNet or HPNet (parsenet.py). Every format
becomes a list of items, each read when its turn comes; an item that cannot be used is complained of and the rest goes
on. The output appears complete or not at all.
"""

import itertools
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jprimfit.cad import step
from jprimfit.cad.step_worker import Reader
from jprimfit.data import from_step, native, parsenet, records, surfaces, traceparts
from jprimfit.data.build import SPLITS, BuildConfig
from jprimfit.data.hdf5 import Source
from jprimfit.data.records import Cloud, Part

MIN_SHARE = BuildConfig.min_share  # of the area (ParSeNet: of the points), below which an instance is background
DEFAULT_SPLIT = "test"  # of what comes without one
NUM_POINTS = 8192  # drawn for TraceParts where nothing else is said
FORMATS = ("native", "traceparts")
_STEP_MARK, _HDF5_MARK = b"ISO-10303-21", b"\x89HDF\r\n\x1a\n"
_SUFFIXES = {".step", ".stp", ".p21", ".h5", ".hdf5"}  # of files that a folder should not hold unless they are readable
_MAX_BYTES = 180  # of a name or family, so that a number fits behind


class Item(NamedTuple):
    """One input, which becomes parts when it is read; ValueError then if it cannot be used."""

    read: Callable[[], from_step.Found]


class Inputs(NamedTuple):
    """What is to be converted."""

    items: list[Item]
    is_native: bool  # all in one file of our own format


class Summary(NamedTuple):
    """What came of it."""

    num_parts: int
    num_failed: int  # items of which nothing came
    kinds: dict[str, int]  # number of instances
    background: float  # share of the area (of the points where areas are not known), mean over parts


def inputs(path: str | os.PathLike, stack: ExitStack, *, split: str | None = None) -> Inputs:
    """The items of a file, or of all files below a folder in the order of their names.

    stack: closes what stays open while the items are read. split: given to all; None keeps those of the input, and
    DEFAULT_SPLIT where it has none. ValueError where nothing can be converted.
    """
    path = Path(path)
    if split is not None and not re.fullmatch(r"[a-z][a-z0-9_]*", split):
        raise ValueError(f"the split {split!r} is no lower-case word; give train, val or test.")
    reader = stack.enter_context(Reader())
    if path.is_file():
        kind = _kind(path)
        if kind is None:
            raise ValueError(f"{path} is neither STEP nor HDF5; give a part as STEP, or a data set.")
        items = _items(path, kind, stack, reader, family=path.absolute().parent.name, split=split)
        return Inputs(items, kind == "native")
    if not path.is_dir():
        raise ValueError(f"{path} does not exist: check the name.")
    items, has_step = [], False
    for file, listed in _files(path):
        family = file.parent.relative_to(path).as_posix()
        family = path.absolute().name if family == "." else family
        try:
            kind = _kind(file)
            has_step = has_step or kind == "step"
            if kind is not None:
                items += _items(file, kind, stack, reader, family=family, split=split or listed)
            elif file.suffix.lower() in _SUFFIXES:
                raise ValueError(f"{file} is neither STEP nor HDF5; make it again.")
        except ValueError as error:
            items.append(Item(partial(_refuse, error)))
    if has_step and not step.available():
        raise ValueError(step.NOT_INSTALLED)
    if not items:
        raise ValueError(f"{path} holds no STEP file and no data set; give a folder that does.")
    return Inputs(items, False)


def convert(
    items: Sequence[Item],
    target: str | os.PathLike,
    *,
    to: str = "native",
    num_points: int | None = None,
    complain: Callable[[str], object],
    progress: Callable[[int], object],
) -> Summary:
    """Writes the parts of all items to a native file, or as a folder of TraceParts files.

    num_points: drawn for parts that hold surfaces only, which TraceParts needs (NUM_POINTS by default) and a native
    file may do without (None). complain gets a sentence for what cannot be used, progress(1) comes after every item.
    ValueError, and no output, if no part is left or the target is in the way.
    """
    if to not in FORMATS:
        raise ValueError(f"unknown format {to!r}: expected one of {', '.join(FORMATS)}.")
    if num_points is not None and not 1 <= num_points <= records.MAX_ROWS:
        raise ValueError(f"{num_points} points cannot be drawn; ask for 1 to {records.MAX_ROWS}.")
    target = Path(target)
    _check_target(target, to)
    tally = _Tally(Counter(), [], [])
    ready = _Preparation(to, num_points or (NUM_POINTS if to == "traceparts" else 0))
    parts = _parts(items, ready, tally, complain, progress)
    first = next(parts, None)
    if first is None:
        raise ValueError(tally.failures[0] if len(items) == 1 else f"none of the {len(items)} inputs could be used.")
    parts = itertools.chain([first], parts)
    if to == "native":
        native.write(target, parts, info={"maker": "jprimfit data convert", "min_share": MIN_SHARE})
    else:
        traceparts.write_folder(target, parts)
    kinds = {kind: tally.kinds[kind] for kind in records.KINDS}
    return Summary(len(tally.background), len(tally.failures), kinds, float(np.mean(tally.background)))


class _Tally(NamedTuple):
    """What has come so far."""

    kinds: Counter[str]
    background: list[float]
    failures: list[str]


def _parts(
    items: Sequence[Item],
    ready: "_Preparation",
    tally: _Tally,
    complain: Callable[[str], object],
    progress: Callable[[int], object],
) -> Iterator[Part]:
    for item in items:
        try:
            found = item.read()
            parts = [ready(part) for part in found.parts]
        except ValueError as error:
            tally.failures.append(" ".join(str(error).split()))
            if len(items) > 1:  # of a single one the failure is that of the whole
                complain(tally.failures[-1])
        else:
            for note in found.notes:
                complain(note)
            for part in parts:
                tally.kinds.update(primitive.kind for primitive in part.primitives)
                tally.background.append(_background(part))
                yield part
        progress(1)


class _Preparation:
    """Makes parts fit for the target: names of their own, points where they are needed, one width of floats."""

    def __init__(self, to: str, num_points: int):
        self.to, self.num_points = to, num_points
        self.names: set[str] = set()
        self.widths: dict[str, np.dtype] = {}

    def __call__(self, part: Part) -> Part:
        seed = [0, len(self.names)]
        part = part._replace(name=self._own_name(part.name))
        if part.cloud is None and self.num_points:
            cloud = surfaces.draw(part, num_points=self.num_points, seed=seed, num_samples=traceparts.NUM_SAMPLES)
            part = part._replace(cloud=_cast(cloud, dict.fromkeys(cloud._fields, np.dtype(np.float32))))
        cloud = part.cloud
        if cloud is not None and self.to == "traceparts":
            if cloud.samples is None or cloud.samples.shape[1] != traceparts.NUM_SAMPLES:
                drawn = surfaces.draw(part, num_points=1, seed=seed, num_samples=traceparts.NUM_SAMPLES)
                drawn = _cast(drawn, dict.fromkeys(drawn._fields, cloud.points.dtype))
                cloud = cloud._replace(samples=drawn.samples, sample_normals=drawn.sample_normals)
                part = part._replace(cloud=cloud)
        if part.cloud is not None and self.to == "native":
            part = part._replace(cloud=self._as_first(part.cloud, part.name))
        records.check(part, source=f"Part {part.name!r}")
        return part

    def _own_name(self, name: str) -> str:
        """A name that is a file name too if it must, and that no part before has."""
        if self.to == "traceparts":
            name = re.sub(r"[/\\]|^\.", "_", name)
        name = _printable(name) or "part"
        number, own = 1, name
        while own in self.names:
            number += 1
            own = f"{name}_{number}"
        self.names.add(own)
        return own

    def _as_first(self, cloud: Cloud, name: str) -> Cloud:
        """A dataset has one width per array, that of the first part; a wider one would lose digits."""
        for field, values in cloud._asdict().items():
            if values is not None and values.dtype.kind == "f":
                width = self.widths.setdefault(field, values.dtype)
                if values.dtype.itemsize > width.itemsize:
                    words = f"its {field} are {values.dtype} and those of the first part {width}; convert it on its own"
                    raise ValueError(f"Part {name!r} cannot join the others: {words}.")
        return _cast(cloud, self.widths)


def _printable(text: str) -> str:
    """The end of a name of a file or folder, which may hold any bytes and be of any length."""
    clean = "".join(letter if letter.isprintable() else "_" for letter in text)
    return clean.encode()[-_MAX_BYTES:].decode(errors="ignore")


def _cast(cloud: Cloud, widths: dict[str, np.dtype]) -> Cloud:
    fields = cloud._asdict()
    floats = {name: values for name, values in fields.items() if values is not None and values.dtype.kind == "f"}
    return cloud._replace(**{name: values.astype(widths[name], copy=False) for name, values in floats.items()})


def _background(part: Part) -> float:
    if part.areas is not None:
        return part.background_area / max(part.background_area + float(np.sum(part.areas)), 1e-300)
    return 0.0 if part.cloud is None else float(np.mean(part.cloud.labels == records.BACKGROUND))


def _check_target(target: Path, to: str) -> None:
    if to == "native" and target.is_dir():
        raise ValueError(f"{target} is a folder; give a file such as parts.h5.")
    if to == "traceparts" and target.suffix.lower() in _SUFFIXES:
        raise ValueError(f"{target} is the name of a file; TraceParts is a file per part, so give a folder.")
    if to == "traceparts" and target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise ValueError(f"{target} is there already; give a folder that is new or empty.")


def _files(folder: Path) -> Iterator[tuple[Path, str | None]]:
    """Files and the split that a list of TraceParts gives them; in a folder with such lists, what these name."""
    if any(folder.glob(traceparts.LISTS.format("*"))):
        seen = set()
        for split, files in traceparts.read_folder(folder).items():
            yield from ((file, split) for file in files if file not in seen)
            seen.update(files)
        return
    for file in sorted(folder.rglob("*")):
        if file.is_file() and not any(name.startswith(".") for name in file.relative_to(folder).parts):
            yield file, None


def _kind(path: Path) -> str | None:
    """What a file is by its content; None for what is neither STEP nor HDF5."""
    with path.open("rb") as file:
        head = file.read(256)
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(_STEP_MARK):
        return "step"
    if not head.startswith(_HDF5_MARK):
        return None
    with Source(path) as source:
        names = set(source.children())
        if "format" in source.attribute_names():
            return "native"
    if "gt_points" in names or any("_soup_" in name for name in names):
        return "traceparts"
    if parsenet.ARRAYS <= names:
        return "parsenet"
    words = "expected our own format, TraceParts, ParSeNet or HPNet"
    raise ValueError(f"{path} is an HDF5 file of another layout; {words}.")


def _items(path: Path, kind: str, stack: ExitStack, reader: Reader, *, family: str, split: str | None) -> list[Item]:
    if kind == "step":
        fields = {"name": path.stem, "family": _printable(family), "split": split or DEFAULT_SPLIT}
        return [Item(partial(_step_parts, reader, path, fields))]
    if kind == "traceparts":
        return [Item(partial(_traceparts_part, path, split or DEFAULT_SPLIT))]
    if kind == "native":
        dataset = stack.enter_context(native.Dataset(path))
        return [Item(partial(_native_part, dataset, row, split)) for row in range(len(dataset))]
    shapes = stack.enter_context(parsenet.Shapes(path))
    own = next((word for word in SPLITS if path.stem.startswith(word)), DEFAULT_SPLIT)
    return [Item(partial(_shape_part, shapes, row, split or own)) for row in range(len(shapes))]


def _refuse(error: ValueError) -> from_step.Found:
    raise error


def _step_parts(reader: Reader, path: Path, fields: dict[str, Any]) -> from_step.Found:
    return from_step.parts(reader.read(path), source=str(path), min_share=MIN_SHARE, **fields)


def _traceparts_part(path: Path, split: str) -> from_step.Found:
    return from_step.Found((traceparts.read(path)._replace(split=split),), ())


def _native_part(dataset: native.Dataset, row: int, split: str | None) -> from_step.Found:
    part = dataset[row]
    return from_step.Found((part if split is None else part._replace(split=split),), ())


def _shape_part(shapes: parsenet.Shapes, row: int, split: str) -> from_step.Found:
    return from_step.Found((shapes.read(row, min_share=MIN_SHARE)._replace(split=split),), ())
