"""The dataset file: thousands of parts in one HDF5 file, any of them read with one slice per array.

The arrays of all parts lie one after the other. Each belongs to an axis; part j owns the rows parts/<axis>_start[j] to
parts/<axis>_start[j + 1] of it. An axis on which no part has a row is left out together with its arrays. The groups
clouds, meshes and trims hold the fields of the records of those names. docs/data-format.md describes the file for other
readers; records.py says what the values mean. Whoever changes a meaning raises VERSION.
"""

import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jprimfit.data import records
from jprimfit.data.hdf5 import Scalar, Source, Target, create
from jprimfit.data.records import KINDS, MAX_ROWS, NUM_PARAMETERS, Cloud, Mesh, Part, Table, Trims

FORMAT = "jprimfit-dataset"
VERSION = 1

# array: (axis, type, shape of a row, packed?). Random coordinates gain little by packing and would cost time to unpack.
_ARRAYS: dict[str, tuple[str, str, tuple[int | None, ...], bool]] = {
    "instances/kind": ("instance", "i1", (), True),
    "instances/parameters": ("instance", "f8", (NUM_PARAMETERS,), True),
    "instances/area": ("instance", "f8", (), True),
    "clouds/points": ("point", "f", (3,), False),
    "clouds/normals": ("point", "f", (3,), False),
    "clouds/labels": ("point", "i4", (), True),
    "clouds/noisy_points": ("noisy_point", "f", (3,), False),
    "clouds/samples": ("sample", "f", (None, 3), False),
    "clouds/sample_normals": ("sample_normal", "f", (None, 3), False),
    "meshes/vertices": ("vertex", "f", (3,), True),
    "meshes/faces": ("face", "i4", (3,), True),
    "meshes/labels": ("face", "i4", (), True),
    "trims/labels": ("trim", "i4", (), True),
    "trims/frames": ("trim", "f8", (3, 3), True),
    "trims/outward": ("trim", "i1", (), True),
    "trims/loop_face": ("loop", "i4", (), True),
    "trims/loop_size": ("loop", "i4", (), True),
    "trims/corners": ("corner", "f8", (2,), True),
}
_AXES = tuple(dict.fromkeys(axis for axis, *_ in _ARRAYS.values()))
_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {  # parts/<field>, one row per part: type, shape of a row
    **dict.fromkeys(("name", "family", "split", "unit"), ("S", ())),
    "seed": ("i8", ()),
    "center": ("f8", (3,)),
    "scale": ("f8", ()),
    "background_area": ("f8", ()),
}


def write(path: str | os.PathLike, parts: Iterable[Part], *, info: Mapping[str, Scalar] | None = None) -> None:
    """Writes all parts in the order given, and free attributes of the file (how it was made); equal input, equal bytes.

    Parts are taken one at a time and never held together. ValueError, and no file, if one breaks the rules of records,
    if two have one name, if a family lies in two splits, or if two parts hold the same array in different types.
    """
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    counts: dict[str, list[int]] = {axis: [] for axis in _AXES}
    with create(path, checksums=True) as target:
        for part in parts:
            records.check(part, source=f"Part {part.name!r}")
            sizes = dict.fromkeys(_AXES, 0)
            for name, rows in _rows(part).items():
                sizes[_ARRAYS[name][0]] = len(rows)
                if len(rows):
                    target.append(name, rows, packed=_ARRAYS[name][3])
            for axis, size in sizes.items():
                counts[axis].append(size)
            for name, column in columns.items():
                column.append(getattr(part, name))
        if not columns["name"]:
            raise ValueError(f"{path} was not written: there are no parts; give at least one.")
        _splits(columns["name"], columns["family"], columns["split"], source=str(path))
        _write_columns(target, columns, counts)
        for name, value in {"format": FORMAT, "version": VERSION, "kinds": " ".join(KINDS)}.items():
            target.attribute("", name, value)
        for name, value in sorted((info or {}).items()):
            target.attribute("info", name, value)


class Dataset:
    """A dataset file open for reading: len(dataset) parts, dataset[j] reads one; use it in a with statement.

    Opening reads and checks what is small: names, families, units, background_areas (one per part), splits (name ->
    parts), instances and areas (part j owns rows starts["instance"][j] to starts["instance"][j + 1]), info (the free
    attributes). A pickled Dataset, as sent to a worker process, opens its file anew. Every fault is a ValueError of one
    sentence.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = path
        self.source = Source(path)
        try:
            self._read_head()
            self._read_columns()
            self._read_starts()
            self._read_instances()
        except BaseException:
            self.source.close()
            raise

    def __len__(self) -> int:
        return len(self.names)

    def __enter__(self) -> "Dataset":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.path,)

    def close(self) -> None:
        """Closes the file."""
        self.source.close()

    def __getitem__(self, index: int) -> Part:
        """Part number index, checked; IndexError outside 0 .. len - 1."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path} has parts 0 to {len(self) - 1}, asked for {index}.")
        bounds = {axis: (int(start[index]), int(start[index + 1])) for axis, start in self.starts.items()}
        rows = {name: stored.read(*bounds[_ARRAYS[name][0]]) for name, stored in self._stored.items()}
        instances = slice(*bounds.get("instance", (0, 0)))
        areas = self.areas[instances]
        columns = {name: values[index] for name, values in self._columns.items()}
        part = Part(
            primitives=records.unpack(Table(self.instances.kind[instances], self.instances.parameters[instances])),
            cloud=_build(Cloud, "clouds", rows),
            mesh=_build(Mesh, "meshes", rows),
            trims=_build(Trims, "trims", rows),
            areas=areas.copy() if np.any(areas) else None,
            **{name: value.copy() if np.ndim(value) else value.item() for name, value in columns.items()},
        )
        records.check(part, source=f"{self.path}: part {index}")
        return part

    def _read_head(self) -> None:
        names = self.source.attribute_names()
        if not {"format", "version", "kinds"} <= set(names) or self.source.attribute("", "format") != FORMAT:
            self._refuse("it is no jprimfit dataset; make one with jprimfit data convert")
        version = self.source.attribute("", "version")
        if not isinstance(version, int) or not 1 <= version <= VERSION:
            self._refuse(f"its version is {version!r} and this jprimfit reads up to {VERSION}; update jprimfit")
        kinds = str(self.source.attribute("", "kinds")).split()
        if len(set(kinds)) < len(kinds) or not set(kinds) <= set(KINDS):
            self._refuse(f"it names the kinds {kinds}, expected some of {list(KINDS)}")
        self._kind_ids = np.array([KINDS.index(kind) for kind in kinds], np.int8)
        known = {*_ARRAYS, *(f"parts/{name}" for name in (*_COLUMNS, *(f"{axis}_start" for axis in _AXES)))}
        groups = {name.split("/")[0] for name in known} | {"info"}
        children = self.source.children()
        if not set(children) <= groups:
            self._refuse(f"it holds {sorted(children)}, expected some of {sorted(groups)}")
        self._layout = {"": [], **{group: list(self.source.children(group)) for group in children}}
        odd = {f"{group}/{name}" for group, members in self._layout.items() for name in members} - known
        if odd:
            self._refuse(f"it holds {min(odd)}, which version {version} does not know")
        info = self.source.attribute_names("info") if "info" in children else []
        self.info = {name: self.source.attribute("info", name) for name in info}

    def _read_columns(self) -> None:
        self._columns: dict[str, Any] = {}
        count = None
        for name, (kind, tail) in _COLUMNS.items():
            values = self.source.array(f"parts/{name}", kind=kind, shape=(count, *tail)).read()
            count = len(values)
            try:
                self._columns[name] = np.char.decode(values, "utf-8") if kind == "S" else values
            except UnicodeDecodeError:
                self._refuse(f"parts/{name} is not UTF-8 text")
        self.names, self.families, self.units = (self._columns[name].tolist() for name in ("name", "family", "unit"))
        self.background_areas = self._columns["background_area"]
        self.splits = _splits(self.names, self.families, self._columns["split"].tolist(), source=str(self.path))

    def _read_starts(self) -> None:
        self.starts = {}
        for axis in _AXES:
            if f"{axis}_start" in self._layout["parts"]:
                start = self.source.array(f"parts/{axis}_start", kind="i8", shape=(len(self) + 1,)).read()
                if start[0] != 0 or np.any(start[1:] < start[:-1]) or np.any(start[1:] - start[:-1] > MAX_ROWS):
                    self._refuse(f"the offsets of {axis} do not ascend from 0 in steps of at most {MAX_ROWS}")
                self.starts[axis] = start
        self._stored = {}
        for name, (axis, kind, tail, _) in _ARRAYS.items():
            group, field = name.split("/")
            if axis in self.starts:
                self._stored[name] = self.source.array(name, kind=kind, shape=(int(self.starts[axis][-1]), *tail))
            elif field in self._layout.get(group, ()):
                self._refuse(f"it holds {name} but no offsets of {axis}")

    def _read_instances(self) -> None:
        kind, parameters, self.areas = np.zeros(0, np.int8), np.zeros((0, NUM_PARAMETERS)), np.zeros(0)
        if "instance" in self.starts:
            arrays = [self._stored.pop(name) for name in _ARRAYS if name.startswith("instances/")]
            kind, parameters, self.areas = (array.read() for array in arrays)
        if np.any((kind < 0) | (kind >= len(self._kind_ids))) or not np.all(self.areas >= 0):
            self._refuse("an instance has an unknown kind or a negative area")
        self.instances = Table(self._kind_ids[kind], parameters)
        records.check_table(self.instances, source=str(self.path))

    def _refuse(self, words: str) -> None:
        raise ValueError(f"{self.path} cannot be used: {words}.")


def _rows(part: Part) -> dict[str, np.ndarray]:
    """All arrays of a checked part under their names in the file."""
    table = records.pack(part.primitives)
    areas = np.zeros(len(table.kind)) if part.areas is None else part.areas
    rows = {"instances/kind": table.kind, "instances/parameters": table.parameters, "instances/area": areas}
    for group, record in (("clouds", part.cloud), ("meshes", part.mesh), ("trims", part.trims)):
        for field, values in zip(record._fields, record, strict=True) if record is not None else ():
            if values is not None:
                rows[f"{group}/{field}"] = values
    return {
        name: values if _ARRAYS[name][1] == "f" else values.astype(_ARRAYS[name][1], copy=False)
        for name, values in rows.items()
    }


def _build(record: Any, group: str, rows: dict[str, np.ndarray]) -> Any:
    """The record of a group; None if the part has no row in any of its arrays, and an empty optional field is None."""
    found = {name.split("/")[1]: values for name, values in rows.items() if name.startswith(group + "/")}
    if not any(len(values) for values in found.values()):
        return None
    absent = dict.fromkeys(record._fields)
    return record(**absent | {name: values for name, values in found.items() if len(values)})


def _splits(names: list[str], families: list[str], splits: list[str], *, source: str) -> dict[str, np.ndarray]:
    """Split -> rows of its parts (ascending, int32); near copies must stay on one side, so a family has one split."""
    if len(set(names)) < len(names):
        raise ValueError(f"{source} cannot be used: two parts have one name; number them.")
    home: dict[str, str] = {}
    for family, split in zip(families, splits, strict=True):
        if family and home.setdefault(family, split) != split:
            raise ValueError(f"{source} cannot be used: family {family!r} lies in two splits; keep it on one side.")
    rows = np.array(splits)
    return {str(split): np.flatnonzero(rows == split).astype(np.int32) for split in np.unique(rows) if split}


def _write_columns(target: Target, columns: dict[str, list[Any]], counts: dict[str, list[int]]) -> None:
    for name, (kind, _) in _COLUMNS.items():
        values = [value.encode() for value in columns[name]] if kind == "S" else columns[name]
        target.append(f"parts/{name}", np.array(values, kind), packed=True)
    for axis, sizes in counts.items():
        if any(sizes):
            target.append(f"parts/{axis}_start", np.cumsum([0, *sizes], dtype=np.int64), packed=True)
