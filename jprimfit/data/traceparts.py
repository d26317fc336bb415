"""Reader and writer of the published TraceParts format of SPFN and CPFN: one HDF5 file per part, lists of files as csv.

A file holds gt_points, noisy_points, gt_normals, gt_labels and, per instance k, a group <stem>_soup_<k> with gt_points
and gt_normals of NUM_SAMPLES points of that instance and the attribute meta, a flat dict of kind and parameters, whose
values are texts. Coordinates are kept as they are published (about [-1, 1]), so center is 0 and scale is 1.
Source: the loaders of SPFN (Li et al. 2019) and CPFN (Le et al. 2021).
"""

import itertools
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from jprimfit.data import meta
from jprimfit.data.hdf5 import Source, create
from jprimfit.data.records import KINDS, MAX_INSTANCES, MAX_ROWS, Cloud, Part, Table, check, unpack
from jprimfit.types import Plane, Primitive

NUM_SAMPLES = 512
_POINT = {"plane": "location", "sphere": "location", "cylinder": "location", "cone": "apex"}  # keys of meta
_SIZE = {"sphere": "radius", "cylinder": "radius", "cone": "semi_angle"}
LISTS = "{}_models.csv"
_MAX_LIST_BYTES = 16 << 20
_LAST_PLACES = np.array(sorted(itertools.product(range(-4, 5), repeat=3), key=lambda steps: np.abs(steps).sum()))


def read(path: str | os.PathLike) -> Part:
    """The part in one file; its name is the stem of the file.

    Floats keep their width, labels become int32, axes are made unit and given the signs of types.py (a cone's axis
    points to its samples). ValueError of one sentence for whatever the published readers reject (no instance, gaps in
    the numbers, unequal sample counts, a label without an instance, an unknown kind) and for damaged or crafted files.
    """
    path = Path(path)
    with Source(path) as source:
        children = source.children()
        groups = _soups(children, source=path)
        points = _floats(source, "gt_points", None)
        labels = source.array("gt_labels", kind="i", shape=(len(points),)).read()
        normals = _floats(source, "gt_normals", len(points))
        noisy = _floats(source, "noisy_points", len(points)) if "noisy_points" in children else None
        samples = _samples(source, groups, "gt_points", None)
        with_normals = all("gt_normals" in source.children(group) for group in groups)
        sample_normals = _samples(source, groups, "gt_normals", samples.shape[1]) if with_normals else None
        rows = []
        for group, values in zip(groups, samples, strict=True):
            raw = source.attribute(group, "meta")
            rows.append(_row(meta.parse(raw, source=f"{path}: {group}"), values, source=f"{path}: {group}"))
    table = Table(np.array([kind for kind, _ in rows], np.int8), np.stack([row for _, row in rows]))
    cloud = Cloud(points, normals, labels, noisy, samples, sample_normals)
    part = Part(name=path.stem, primitives=unpack(table), cloud=cloud)
    check(part, source=str(path))
    return part._replace(cloud=cloud._replace(labels=labels.astype(np.int32)))


def write(path: str | os.PathLike, part: Part) -> None:
    """Writes the cloud of a part so that SPFN and CPFN load it; the group names follow the stem of path.

    Where the part has no noisy points the clean ones stand in, because both loaders ask for them; sample normals, which
    only CPFN's preprocessing reads, are left out where there are none. The format keeps neither family nor areas, unit
    or frame. ValueError, and no file, without a cloud, without an instance, or without NUM_SAMPLES samples of each.
    """
    path = Path(path)
    check(part, source=f"Part {part.name!r}")
    cloud = part.cloud
    if cloud is None or not part.primitives or cloud.samples is None or cloud.samples.shape[1] != NUM_SAMPLES:
        words = (
            f"TraceParts files hold a cloud, at least one instance, and {NUM_SAMPLES} samples of each; draw them first"
        )
        raise ValueError(f"Part {part.name!r} cannot be written to {path}: {words}.")
    with create(path, checksums=False) as target:
        target.array("gt_points", cloud.points)
        target.array("noisy_points", cloud.points if cloud.noisy_points is None else cloud.noisy_points)
        target.array("gt_normals", cloud.normals)
        target.array("gt_labels", cloud.labels.astype(np.int32, copy=False))
        for row, primitive in enumerate(part.primitives):
            group = f"{path.stem}_soup_{row}"
            target.array(f"{group}/gt_points", cloud.samples[row])
            if cloud.sample_normals is not None:
                target.array(f"{group}/gt_normals", cloud.sample_normals[row])
            target.attribute(group, "meta", meta.dump(_values(primitive)))


def read_list(path: str | os.PathLike, *, folder: str | os.PathLike | None = None) -> tuple[Path, ...]:
    """The files that a csv names, one per line, in its order, found in folder (by default the csv's own).

    ValueError for a name that is no plain <name>.h5, that comes twice, or whose file is missing.
    """
    path = Path(path)
    folder = path.parent if folder is None else Path(folder)
    if not path.is_file() or path.stat().st_size > _MAX_LIST_BYTES:
        raise ValueError(f"{path} is not a list of files; expected a csv with one file name per line.")
    try:
        names = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not text; expected a csv with one file name per line.") from None
    present = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    seen: set[str] = set()
    for name in names:
        if not re.fullmatch(r"[^/\\]+\.h5", name) or name in seen:
            raise ValueError(f"{path} names {name[:100]!r} twice or not as a file; expected one <name>.h5 per line.")
        if name not in present:
            raise ValueError(f"{path} names {name[:100]!r}, which is not in {folder}; fetch it or drop the line.")
        seen.add(name)
    return tuple(folder / name for name in names)


def read_folder(folder: str | os.PathLike) -> dict[str, tuple[Path, ...]]:
    """Split -> its files, by the lists <split>_models.csv of a folder; without a list all *.h5, sorted, under ""."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; give the folder of the h5 files and their csv lists.")
    lists = sorted(folder.glob(LISTS.format("*")))
    if lists:
        return {path.name.removesuffix(LISTS.format("")): read_list(path) for path in lists}
    return {"": tuple(sorted(folder.glob("*.h5")))}


def write_folder(folder: str | os.PathLike, parts: Iterable[Part]) -> None:
    """Writes <name>.h5 of every part and the list <split>_models.csv of every split, in the order given.

    folder must be new or empty, and appears when all is complete. ValueError, and no folder, as in write and for a
    name that is no file name.
    """
    folder = Path(folder).absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    draft.mkdir()
    lists: dict[str, list[str]] = {}
    try:
        for part in parts:
            if not re.fullmatch(r"[^/\\.][^/\\]*", part.name):
                raise ValueError(f"Part {part.name!r} cannot be written: its name is no file name; rename it.")
            write(draft / f"{part.name}.h5", part)
            lists.setdefault(part.split, []).append(f"{part.name}.h5")
        for split, names in lists.items():
            if split:
                (draft / LISTS.format(split)).write_text("".join(f"{name}\n" for name in names), newline="\n")
        os.replace(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _soups(children: Mapping[str, str], *, source: Path) -> list[str]:
    """The groups of the instances in the order of their numbers."""
    found: dict[int, str] = {}
    for name, kind in children.items():
        match = re.fullmatch(r".*_soup_([0-9]{1,9})", name, flags=re.DOTALL)
        if match and (kind != "group" or found.setdefault(int(match[1]), name) != name):
            raise ValueError(f"{source} cannot be used: {name!r} is no group, or its number comes twice.")
    if not 0 < len(found) <= MAX_INSTANCES or sorted(found) != list(range(len(found))):
        raise ValueError(
            f"{source} cannot be used: its groups *_soup_<k> are not numbered 0 to n - 1; expected no gap."
        )
    return [found[number] for number in range(len(found))]


def _floats(source: Source, name: str, length: int | None) -> np.ndarray:
    stored = source.array(name, kind="f", shape=(length, 3))
    if len(stored) > MAX_ROWS:
        raise ValueError(f"{source.path} cannot be used: {name} has {len(stored)} rows, more than {MAX_ROWS}.")
    return stored.read()


def _samples(source: Source, groups: list[str], name: str, length: int | None) -> np.ndarray:
    """One array of every instance, stacked: (i, m, 3)."""
    stored = [source.array(f"{group}/{name}", kind="f", shape=(length, 3)) for group in groups]
    # Checked before reading: thousands of groups can share one array.
    if len({(array.shape, array.dtype) for array in stored}) > 1 or len(stored) * len(stored[0]) > MAX_ROWS:
        raise ValueError(
            f"{source.path} cannot be used: its instances have different numbers or types of {name}, or huge."
        )
    return np.stack([array.read() for array in stored])


def _row(values: Mapping[str, meta.Value], samples: np.ndarray, *, source: str) -> tuple[int, np.ndarray]:
    """Number of the kind and parameters of a meta dict; samples tell into which nappe the axis of a cone points."""
    kind = values.get("type")
    if kind not in KINDS:
        raise ValueError(f"{source} cannot be used: its type is {str(kind)[:40]!r}, expected one of {list(KINDS)}.")
    point = np.array([_number(values, f"{_POINT[kind]}_{letter}", source) for letter in "xyz"])
    size = [_number(values, _SIZE[kind], source)] if kind in _SIZE else []
    if kind == "sphere":
        return KINDS.index(kind), np.array([*point, *size, 0, 0, 0])
    axis = _unit(np.array([_number(values, f"axis_{letter}", source) for letter in "xyz"]), source)
    positive = axis[np.argmax(np.abs(axis))]
    if kind == "cone":
        with np.errstate(over="ignore", invalid="ignore"):  # samples that are not finite are refused afterwards
            positive = np.sum((np.mean(samples, axis=0, dtype=np.float64) - point) * axis)
    axis = 0.0 - axis if positive < 0 else axis
    if kind == "plane":
        return KINDS.index(kind), np.array([*axis, np.sum(point * axis), 0, 0, 0])
    return KINDS.index(kind), np.array([*axis, *point, *size])


def _number(values: Mapping[str, meta.Value], key: str, source: str) -> float:
    value = values.get(key)
    try:
        number = float(value) if value is not None else np.nan
    except ValueError:
        number = np.nan
    if not abs(number) < 1e100:  # so that squares and products stay finite
        raise ValueError(f"{source} cannot be used: its meta has {key} = {str(value)[:40]!r}, expected a number.")
    return number


def _unit(axis: np.ndarray, source: str) -> np.ndarray:
    """Axis of length 1; one that is unit but for rounding stays as it is, so that reading what was written is exact."""
    length = np.sqrt(np.sum(axis * axis))
    if length < 1e-100:
        raise ValueError(f"{source} cannot be used: its axis is zero.")
    return axis if abs(length - 1.0) < 1e-12 else axis / length


def _values(primitive: Primitive) -> dict[str, str]:
    """The meta dict of a primitive; every value is a text, as in the published files."""
    kind = primitive.kind
    fields = {name: np.asarray(value, np.float64) for name, value in primitive._asdict().items()}
    axis = fields.get("axis", fields.get("normal"))
    point = _point_on(primitive) if isinstance(primitive, Plane) else fields.get("center", fields.get("apex"))
    values = {"type": kind}
    for name, vector in ((_POINT[kind], point), ("axis", axis)):
        if vector is not None:
            values |= {f"{name}_{letter}": repr(float(number)) for letter, number in zip("xyz", vector, strict=True)}
    if kind in _SIZE:
        values[_SIZE[kind]] = repr(float(fields.get("radius", fields.get("half_angle", np.nan))))
    return values


def _point_on(plane: Plane) -> np.ndarray:
    """A point of the plane, so rounded that _row finds the offset exactly."""
    normal, offset = np.asarray(plane.normal, np.float64), float(plane.offset)
    near = normal * offset
    # Neighbours of the foot of the origin, by so many units in the last place of each coordinate.
    points = near[None] + _LAST_PLACES * np.spacing(near)[None]
    return points[np.argmin(np.abs(np.sum(points * normal[None], axis=1) - offset))]
