"""Reader of ParSeNet's and HPNet's HDF5 files: clouds whose points know their segment and the kind of its surface.

ParSeNet keeps thousands of shapes in one file: points, normals (s, n, 3), labels, prim (s, n). HPNet has a file per
shape, without the first axis; its T_param is not used. Neither gives the parameters of surfaces in a way that both
share: every segment of one of our kinds is fitted here (fit_primitive, on the stored normals too). What is of another
kind (prim: 1 plane, 3 cone, 4 cylinder, 5 sphere), small, or not described by its fit, becomes BACKGROUND.
Sources: Sharma et al. 2020, Yan et al. 2021, and their loaders. s shapes, n points.
"""

import os
from pathlib import Path

import numpy as np

from jprimfit.data.hdf5 import Source, Stored
from jprimfit.data.records import BACKGROUND, MAX_ROWS, Cloud, Part, check, pack, unpack
from jprimfit.fitting.single import fit_primitive
from jprimfit.geometry import host

ARRAYS = frozenset({"points", "normals", "labels", "prim"})
KIND_OF = {1: "plane", 3: "cone", 4: "cylinder", 5: "sphere"}
MIN_POINTS = 20  # of a segment that is fitted
MAX_RMS = 0.02  # normalised frame, twice the noise that both add; a fit that is farther away describes something else


class Shapes:
    """The shapes of a file, open for reading: len(shapes), shapes.read(row); use it in a with statement."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.source = Source(path)
        try:
            points = self.source.array("points", kind="f")
            self.single = len(points.shape) == 2
            shape = points.shape
            if len(shape) not in (2, 3) or shape[-1] != 3 or not 0 < shape[-2] <= MAX_ROWS or not shape[0]:
                raise ValueError(f"{path} cannot be used: points has shape {shape}, expected (shapes, points, 3).")
            normals = self.source.array("normals", kind="f", shape=shape)
            labels, prim = (self.source.array(name, shape=shape[:-1]) for name in ("labels", "prim"))
            self._stored = points, normals, labels, prim
        except BaseException:
            self.source.close()
            raise

    def __len__(self) -> int:
        return 1 if self.single else len(self._stored[0])

    def __enter__(self) -> "Shapes":
        return self

    def __exit__(self, *_: object) -> None:
        self.source.close()

    def read(self, row: int, *, min_share: float) -> Part:
        """Shape number row, named after the file (and the row), in the normalised frame; its points stay as they are.

        Instances follow the order of the labels; segments under min_share of the points are BACKGROUND. ValueError of
        one sentence for what is damaged, or where no segment is left.
        """
        name = self.path.stem if self.single else f"{self.path.stem}_{row:05d}"
        where = str(self.path) if self.single else f"{self.path}: shape {row}"
        points, normals, labels, prim = (self._rows(stored, row) for stored in self._stored)
        if not (np.all(np.isfinite(points)) and np.all(np.isfinite(normals))):
            raise ValueError(f"{where} cannot be used: its points or normals hold NaN or infinity.")
        lengths = np.sqrt(np.sum(normals.astype(np.float64) ** 2, axis=1))
        if not np.all(lengths > 1e-6):
            raise ValueError(f"{where} cannot be used: a normal is zero.")
        frame = host.normalize(points)[1]
        placed = frame.from_input(points)
        normals = normals / lengths[:, None]
        labels, prim = _whole(labels, where), _whole(prim, where)
        own, primitives = np.full(len(points), BACKGROUND, np.int32), []
        for label in np.unique(labels):
            rows = np.flatnonzero(labels == label)
            numbers, counts = np.unique(prim[rows], return_counts=True)
            kind = KIND_OF.get(int(numbers[np.argmax(counts)]))
            if kind is None or label < 0 or len(rows) < max(MIN_POINTS, min_share * len(points)):
                continue
            primitive, info = fit_primitive(kind, placed[rows], normals=normals[rows])
            if info.ok and info.rms <= MAX_RMS:
                own[rows] = len(primitives)
                primitives.append(primitive)
        if not primitives:
            raise ValueError(f"{where} cannot be used: it has no segment on a plane, sphere, cylinder or cone.")
        cloud = Cloud(placed.astype(points.dtype), normals.astype(points.dtype), own)
        part = Part(name, unpack(pack(primitives)), cloud=cloud, center=frame.center, scale=frame.scale)
        check(part, source=where)
        return part

    def _rows(self, stored: Stored, row: int) -> np.ndarray:
        return stored.read() if self.single else stored.read(row, row + 1)[0]


def _whole(values: np.ndarray, where: str) -> np.ndarray:
    """Integers as int64; floats that are whole numbers too, as some files have them."""
    good = values.dtype.kind in "iuf" and np.all(np.isfinite(values))
    if not good or not np.all((np.abs(values) < 2**31) & (values == np.round(values))):
        raise ValueError(f"{where} cannot be used: its labels or prim are no whole numbers.")
    return values.astype(np.int64)
