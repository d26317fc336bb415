"""Reader of the Fit4CAD benchmark as one HDF5 file: CAD clouds whose points are listed by the primitives they lie on.

The source (Romanengo, Raffo, Qie, Anwer, Falcidieno: Fit4CAD, Computers & Graphics 2021) lists per cloud the points of
every primitive. Points on a shared edge are listed by several primitives, so a primitive is a set of point rows here,
never a label. Faces of one geometric surface share a number: a CAD cylinder is commonly two half cylinders.
Layout of the file: a group PCnnn per cloud with points, member_ptr, member_index, inst_type, inst_surface, inst_params.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jprimfit.data import hdf5

# Kinds of the source by their number; only the first four of KINDS below are primitives of ours.
SOURCE_KINDS = ("other", "plane", "cylinder", "sphere", "cone", "torus")
_WITH_RADIUS = (SOURCE_KINDS.index("cylinder"), SOURCE_KINDS.index("sphere"))
_RADIUS = 6  # column of inst_params


class BenchmarkCloud(NamedTuple):
    """One cloud of the benchmark; instances are sets of rows that may share points."""

    name: str  # as in the source, "PC007"
    points: np.ndarray  # (n, 3) float64, the source's unit
    members: tuple[np.ndarray, ...]  # per instance the rows of its points
    kinds: tuple[str, ...]  # per instance, of SOURCE_KINDS
    surfaces: np.ndarray  # int (instances,): instances on one geometric surface share a number
    radii: np.ndarray  # float64 (instances,), of cylinders and spheres in the source's unit; NaN for the others


def read_clouds(path: str | Path, *, first: int = 1, last: int = 10**6) -> Iterator[BenchmarkCloud]:
    """The clouds PC<first> to PC<last> of a file in ascending order, one at a time.

    Raises ValueError where the file is missing, no HDF5, or holds no group named PC<number>.
    """
    with hdf5.Source(path) as source:
        numbers = sorted(int(name[2:]) for name in source.children() if re.fullmatch(r"PC\d{3,9}", name))
        if not numbers:
            raise ValueError(f"{path} holds no group PC<number>; expected the Fit4CAD clouds in one HDF5 file.")
        for number in numbers:
            if first <= number <= last:
                yield _read_cloud(source, f"PC{number:03d}")


def _read_cloud(source: hdf5.Source, name: str) -> BenchmarkCloud:
    def read(array: str, kind: str, shape: tuple[int | None, ...]) -> np.ndarray:
        return source.array(f"{name}/{array}", kind=kind, shape=shape).read()

    points = read("points", "f", (None, 3)).astype(np.float64)
    bounds, rows = read("member_ptr", "i", (None,)), read("member_index", "i", (None,))
    types, surfaces = read("inst_type", "i", (None,)), read("inst_surface", "i", (None,))
    parameters = read("inst_params", "f", (None, 8))
    sizes = np.diff(bounds.astype(np.int64), prepend=0, append=len(rows))
    counts = {len(bounds) - 1, len(types), len(surfaces), len(parameters)}
    sound = len(counts) == 1 and sizes[0] == sizes[-1] == 0 and np.all(sizes >= 0)
    in_range = np.all((rows >= 0) & (rows < len(points))) and np.all((types >= 0) & (types < len(SOURCE_KINDS)))
    if not (sound and in_range):
        raise ValueError(f"{source.path}: {name} is damaged: its instances do not refer to its points; fetch it again.")
    return BenchmarkCloud(
        name=name,
        points=points,
        members=tuple(rows[a:b] for a, b in zip(bounds[:-1], bounds[1:], strict=True)),
        kinds=tuple(SOURCE_KINDS[kind] for kind in types),
        surfaces=surfaces.astype(np.int64),
        radii=np.where(np.isin(types, _WITH_RADIUS), parameters[:, _RADIUS], np.nan),
    )
