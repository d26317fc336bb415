"""NumPy's own files: .npy with one array (n, 3) or more columns, .npz with named arrays. Nothing is ever unpickled.

In an .npz the points are looked for under the names of POINT_KEYS, then taken as the only array of a fitting shape. A
structured array with fields x y z (nx ny nz) counts as columns. Source: NumPy's format description, NEP 1.
"""

import io
import os
import zipfile
from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Cloud, cloud_of_columns

POINT_KEYS = (
    "points",
    "xyz",
    "positions",
    "position",
    "pos",
    "vertices",
    "coordinates",
    "coords",
    "cloud",
    "pc",
    "arr_0",
)
NORMAL_KEYS = ("normals", "normal", "point_normals")


def read_npy(path: Path) -> Cloud:
    """The cloud of an .npy file; BadFile if it is damaged, holds Python objects or has another shape."""
    with open(path, "rb") as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise BadFile(f"{path} is NPY of version {version}, versions (1, 0) and (2, 0) are read: save it again.")
        reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = reader(file)
        # Compared before anything is allocated: a damaged header may announce any size.
        if dtype.hasobject:
            raise BadFile(f"{path} holds Python objects, which are never unpickled: save an array of numbers (n, 3).")
        num_bytes = dtype.itemsize * int(np.prod([int(s) for s in shape], dtype=object))
        if os.path.getsize(path) - file.tell() < num_bytes:
            raise BadFile(f"{path} is truncated: its header announces {num_bytes} bytes of numbers; copy it again.")
        file.seek(0)
        return _cloud(np.load(file, allow_pickle=False), path)


def read_npz(path: Path) -> Cloud:
    """The cloud of an .npz file, with the normals in it; BadFile if it is damaged or no array can be the points."""
    if not zipfile.is_zipfile(path):
        raise BadFile(f"{path} is not an NPZ archive or is truncated: save it again with numpy.savez.")
    # Opened here: numpy.load leaves a damaged archive's file open.
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
        names = archive.files
        key = next((name for name in POINT_KEYS if name in names), None)
        if key is None:
            arrays = {name: archive[name] for name in names}
            fitting = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] in (3, 6)]
            if len(fitting) != 1:
                raise BadFile(
                    f"{path} holds the arrays {', '.join(names[:8]) or 'none'}, none of which is clearly the points: "
                    "name them 'points', an array of shape (n, 3)."
                )
            key = fitting[0]
        cloud = _cloud(archive[key], path)
        normal_key = next((name for name in NORMAL_KEYS if name in names), None)
        if normal_key is None or archive[normal_key].shape != cloud.points.shape:
            return cloud
        return Cloud(cloud.points, np.asarray(archive[normal_key], np.float64))


def _cloud(array: np.ndarray, path: Path) -> Cloud:
    if array.dtype.names and {"x", "y", "z"} <= set(array.dtype.names):
        names = ("x", "y", "z", "nx", "ny", "nz") if {"nx", "ny", "nz"} <= set(array.dtype.names) else ("x", "y", "z")
        array = np.stack([np.ravel(array[name]) for name in names], axis=1)
    if array.ndim != 2 or array.dtype.kind not in "fiu" or array.shape[1] < 3:
        raise BadFile(
            f"{path} holds an array of shape {array.shape} and type {array.dtype}, but points are numbers of "
            "shape (n, 3): save it in that shape."
        )
    if array.shape[0] in (3, 6) and array.shape[1] > 16:
        raise BadFile(
            f"{path} holds an array of shape {array.shape}, one point per column: save its transpose, (n, 3)."
        )
    return cloud_of_columns(np.asarray(array, np.float64), path)


def npz_bytes(arrays: dict[str, np.ndarray]) -> bytes:
    """The .npz file of the named arrays, bit for bit the same for the same arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()
