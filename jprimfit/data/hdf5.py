"""HDF5 files read with distrust and written complete or not at all: the only file that knows h5py.

Reading: a Source walks hard links only, looks at the declared type, shape, filters and storage of an array before a
byte is allocated, and turns whatever goes wrong into a ValueError of one sentence. What an array declares must be in
the file: its size is at most what its stored bytes can unpack to, so memory grows with the file, not with its words.
Writing: a Target fills a file beside the goal, renamed at the end; no times are kept, so equal content is equal bytes.
Paths inside a file are "group/name", "" is the root. Source: HDF5 file format specification 3.0, h5py's low-level API.
"""

import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5t, h5z  # pyright: ignore[reportAttributeAccessIssue] (compiled modules)

Scalar = str | int | float | bytes
_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
_MAX_RATIO = 1100  # of deflate: 1032, and a little for the ends
_MAX_CHUNK = 64 << 20  # bytes of one filtered chunk when unpacked
_SMALL_CHUNK = 128 << 10  # a chunk below this may lie about its size: it unpacks to _MAX_RATIO times as much at worst
_MAX_ATTRIBUTE = 64 << 10  # bytes
_MAX_MEMBERS = 1 << 17
_CHUNK_BYTES = 64 << 10  # written: a random read of a part touches few chunks, yet a chunk packs well


class Stored:
    """One checked array in a file: dtype and shape are known, rows are read when asked for."""

    def __init__(self, dataset: h5py.Dataset, source: "Source", name: str):
        self._dataset, self._source, self._name = dataset, source, name
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype = dataset.dtype.newbyteorder("=")

    def __len__(self) -> int:
        return self.shape[0]

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows [start, stop) as a new array in native byte order."""
        with self._source.guard(f"array {self._name}"):
            return np.ascontiguousarray(self._dataset[start : len(self) if stop is None else stop], dtype=self.dtype)


class Source:
    """A file open for reading; close it, or use it in a with statement."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        if not self.path.is_file():
            raise ValueError(f"{self.path} is not a file; give the path of an HDF5 file.")
        self._size = self.path.stat().st_size
        with self.guard("its content"):
            self._file = h5py.File(self.path, "r", locking="best-effort")

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    @contextmanager
    def guard(self, what: str) -> Iterator[None]:
        """Turns every error of h5py, which raises nearly any class on a damaged file, into a sentence."""
        try:
            yield
        except _Refused as refusal:
            raise ValueError(f"{self.path} cannot be used: {what} {refusal}.") from None
        except Exception as error:
            words = f"{what} is damaged or no HDF5; fetch or make the file again"
            raise ValueError(f"{self.path} cannot be used: {words}.") from error

    def children(self, group: str = "") -> dict[str, str]:
        """Names in a group, in order, each with "group" or "array"; links to elsewhere and named types are refused."""
        with self.guard(f"group /{group}"):
            node = self._open(group)
            _refuse(not isinstance(node, h5g.GroupID), "is no group")
            _refuse(node.get_num_objs() > _MAX_MEMBERS, "has too many members")
            found = {name.decode(): _child(node, name) for name in sorted(node)}
            _refuse(any(isinstance(child, h5t.TypeID) for child in found.values()), "holds a named type")
            return {name: "group" if isinstance(child, h5g.GroupID) else "array" for name, child in found.items()}

    def array(self, name: str, *, kind: str | None = None, shape: tuple[int | None, ...] | None = None) -> Stored:
        """The array of that name, its storage checked, nothing read yet; shape may hold None for any length.

        kind: "f" = float of 4 or 8 bytes, "i" = any integer, "S" = bytes, or one type such as "i4"; None = any of them.
        """
        with self.guard(f"array {name}"):
            node = self._open(name)
            _refuse(not isinstance(node, h5d.DatasetID), "is no array")
            dataset: Any = h5py.Dataset(node)
            dtype, found = dataset.dtype, dataset.shape or ()
            kinds = {
                "f": dtype.kind == "f" and dtype.itemsize in (4, 8),
                "i": dtype.kind in "iu",
                "S": dtype.kind == "S",
            }
            good = any(kinds.values()) if kind is None else kinds.get(kind, dtype.newbyteorder("=").str[1:] == kind)
            _refuse(not good, f"has numbers of type {dtype}, expected {kind}")
            expected = (None,) * len(found) if shape is None else shape
            good = len(found) == len(expected) and all(b in (None, a) for a, b in zip(found, expected, strict=True))
            _refuse(not found or not good, f"has shape {found}, expected {expected}")
            _check_storage(dataset, self._size)
            return Stored(dataset, self, name)

    def attribute_names(self, path: str = "") -> list[str]:
        """Names of the attributes of a group or array, in order."""
        with self.guard(f"/{path}"):
            node = self._open(path)
            count = h5a.get_num_attrs(node)
            _refuse(count > _MAX_MEMBERS, "has too many attributes")
            return sorted(h5a.open(node, index=row).name.decode() for row in range(count))

    def attribute(self, path: str, name: str) -> Scalar:
        """A scalar attribute: text, number, or the bytes of an opaque value (nobody unpickles them here)."""
        with self.guard(f"attribute {name} of /{path}"):
            node = self._open(path)
            _refuse(not h5a.exists(node, name.encode()), "is missing")
            handle = h5a.open(node, name.encode())
            kind = handle.get_type()
            _refuse(handle.shape != () or kind.get_size() > _MAX_ATTRIBUTE, "is no scalar or too long")
            known = (h5t.TypeStringID, h5t.TypeIntegerID, h5t.TypeFloatID, h5t.TypeOpaqueID)
            _refuse(not isinstance(kind, known), "is neither text nor number")
            value: Any = (h5py.Group if isinstance(node, h5g.GroupID) else h5py.Dataset)(node).attrs[name]
            if isinstance(value, np.void):
                return value.tobytes()
            if isinstance(value, bytes):
                return value.decode()
            return value if isinstance(value, str) else value.item()

    def _open(self, path: str) -> Any:
        node = h5o.open(self._file.id, b"/")
        for name in filter(None, path.split("/")):
            _refuse(not isinstance(node, h5g.GroupID), "is missing")
            node = _child(node, name.encode())
        return node


class Target:
    """A file being written; see create."""

    def __init__(self, file: Any):
        self._file, self._waiting = file, dict[str, tuple[np.ndarray, bool]]()

    def attribute(self, path: str, name: str, value: Scalar) -> None:
        """Sets a scalar attribute of a group; text is stored with its length, bytes as an opaque value."""
        stored: Any = np.void(value) if isinstance(value, bytes) else value
        if isinstance(value, str):
            stored = np.array(value.encode(), h5py.string_dtype("utf-8", max(1, len(value.encode()))))
        self._file.require_group(path or "/").attrs[name] = stored

    def array(self, name: str, values: np.ndarray) -> None:
        """Writes a whole array, unpacked and in one piece."""
        self._file.create_dataset(name, data=values)

    def append(self, name: str, rows: np.ndarray, *, packed: bool) -> None:
        """Appends rows in checksummed chunks; rows of another dtype or shape than the first raise ValueError."""
        waiting, _ = self._waiting.setdefault(name, (rows[:0], packed))
        if (waiting.dtype, waiting.shape[1:]) != (rows.dtype, rows.shape[1:]):
            words = f"{rows.dtype} {rows.shape[1:]} in one part and {waiting.dtype} {waiting.shape[1:]} in another"
            raise ValueError(f"{name} is {words}; give all parts of a file the same.")
        waiting = np.concatenate([waiting, rows])
        # Whole chunks only: a chunk that is packed twice leaves a hole in the file.
        whole = len(waiting) - len(waiting) % _chunk_rows(waiting)
        self._extend(name, waiting[:whole], packed)
        self._waiting[name] = waiting[whole:], packed

    def finish(self) -> None:
        """Writes the rows that still wait for a full chunk."""
        for name, (rows, packed) in self._waiting.items():
            self._extend(name, rows, packed)

    def _extend(self, name: str, rows: np.ndarray, packed: bool) -> None:
        if len(rows) and name not in self._file:
            tail, chunk = rows.shape[1:], min(_chunk_rows(rows), len(rows))
            packing = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if packed else {}
            layout = {"maxshape": (None, *tail), "chunks": (chunk, *tail), "fletcher32": True}
            self._file.create_dataset(name, (0, *tail), rows.dtype, **layout, **packing)
        if len(rows):
            dataset = self._file[name]
            dataset.resize(len(dataset) + len(rows), axis=0)
            dataset[-len(rows) :] = rows


@contextmanager
def create(path: str | os.PathLike, *, checksums: bool) -> Iterator[Target]:
    """Opens a Target whose file appears under path when the block ends without an error, and not at all otherwise.

    checksums: HDF5 1.10's format, which finds damage in its own tables; without, the oldest, which every reader knows.
    """
    goal = Path(path)
    if not goal.parent.is_dir():
        raise ValueError(f"{goal.parent} is not a folder; make it first.")
    draft = goal.with_name(f".{goal.name}.{os.getpid()}.tmp")
    try:
        with h5py.File(draft, "w", libver=("v110", "v110") if checksums else ("earliest", "v110")) as file:
            target = Target(file)
            yield target
            target.finish()
        os.replace(draft, goal)
    finally:
        draft.unlink(missing_ok=True)


class _Refused(Exception):
    """What is wrong, as the end of a sentence."""


def _refuse(bad: bool, words: str) -> None:
    if bad:
        raise _Refused(words)


def _chunk_rows(rows: np.ndarray) -> int:
    return max(1, _CHUNK_BYTES // (rows.dtype.itemsize * math.prod(rows.shape[1:])))


def _child(node: Any, name: bytes) -> Any:
    """The object under a hard link; soft and external links lead to other places or files and are not followed."""
    _refuse(not node.links.exists(name), "is missing")
    _refuse(node.links.get_info(name).type != h5l.TYPE_HARD, f"holds {name!r}, a link instead of data")
    return h5o.open(node, name)


def _check_storage(dataset: Any, file_size: int) -> None:
    """Refuses arrays that lie in other files, need foreign filters, or declare more than their bytes can unpack to."""
    plan = dataset.id.get_create_plist()
    stored, size = dataset.id.get_storage_size(), math.prod(dataset.shape) * dataset.dtype.itemsize
    _refuse(plan.get_layout() == h5d.VIRTUAL or plan.get_external_count() > 0, "lies in another file")
    filters = [plan.get_filter(row)[0] for row in range(plan.get_nfilters())]
    _refuse(len(set(filters)) < len(filters) or not set(filters) <= _FILTERS, f"is packed by filters {filters}")
    deflated = h5z.FILTER_DEFLATE in filters
    _refuse(stored > file_size or size > stored * (_MAX_RATIO if deflated else 1), f"is {size} bytes but has {stored}")
    if plan.get_layout() == h5d.CHUNKED and filters:
        chunk = math.prod(dataset.chunks) * dataset.dtype.itemsize
        places: list[Any] = []
        dataset.id.chunk_iter(places.append)
        too_large = any(place.size > chunk + chunk // 100 + 1024 for place in places)
        _refuse(too_large or chunk > _MAX_CHUNK, f"has a chunk that is larger than its {chunk} bytes, or huge")
        for place in places if deflated and chunk > _SMALL_CHUNK else ():
            packed = dataset.id.read_direct_chunk(place.chunk_offset)[1]
            _refuse(len(zlib.decompressobj().decompress(packed, chunk + 1)) > chunk, "has a chunk that unpacks to more")
