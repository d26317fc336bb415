"""What all formats share: the cloud that readers return, columns turned into a cloud, files written whole.

A reader of a format is `read(path) -> Cloud` (a mesh: `-> Mesh`) and knows nothing of other formats; whatever is wrong
with a file is a BadFile of one sentence that names the file, what was found and what to do. Coordinates stay float64
and in the unit and frame of the file. Nothing here imports JAX.
"""

import contextlib
import os
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float, Int

# How far the length of a normal may be from 1 for three unnamed columns to be taken for normals.
UNIT_TOLERANCE = 0.02


class BadFile(ValueError):
    """A file that cannot be read; its message is the sentence for the user."""


class Cloud(NamedTuple):
    """Points of one scan, with the normals that came with them or None."""

    points: Float[np.ndarray, "n 3"]  # float64, unit and frame of the file
    normals: Float[np.ndarray, "n 3"] | None  # as in the file: neither scaled nor checked
    tolerance: float | None = (
        None  # how far they may lie from the surface that is meant, where the file tells; its unit
    )


class Mesh(NamedTuple):
    """A triangulated surface as a file holds it; faces may be empty."""

    vertices: Float[np.ndarray, "v 3"]  # float64
    faces: Int[np.ndarray, "f 3"]  # int64, rows of vertices
    normals: Float[np.ndarray, "v 3"] | None  # of the vertices


def cloud_of_columns(table: Float[np.ndarray, "n c"], path: Path) -> Cloud:
    """The cloud in a table without column names: x y z first; normals where three further columns have unit length.

    Those three are looked for right behind x y z, then at the end of the row (x y z r g b nx ny nz). BadFile for
    fewer than three columns or no rows.
    """
    num_rows, num_columns = table.shape
    if num_columns < 3:
        raise BadFile(
            f"{path} has {num_columns} number{'s' if num_columns != 1 else ''} per point, but x y z are needed: "
            "give a file with three or more columns."
        )
    if num_rows == 0:
        raise BadFile(f"{path} holds no points: give a file with at least 4.")
    points = np.asarray(table[:, :3], np.float64)
    for first in dict.fromkeys((3, num_columns - 3)):
        if first >= 3 and first + 3 <= num_columns:
            normals = np.asarray(table[:, first : first + 3], np.float64)
            if _are_unit(normals):
                return Cloud(points, normals)
    return Cloud(points, None)


def _are_unit(vectors: Float[np.ndarray, "n 3"]) -> bool:
    """True where (nearly) every row has length 1; a few missing normals do not make the columns something else."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.sum(vectors**2, axis=1))
    return bool(np.mean(np.abs(length - 1) < UNIT_TOLERANCE) > 0.98)


def needs_formats(path: Path, package: str) -> BadFile:
    """The sentence for a format whose package is not installed."""
    kind = path.suffix[1:].upper()
    return BadFile(
        f"{path} is a {kind} file, read by {package}, which is not installed: pip install 'jprimfit[formats]'."
    )


def fans(polygons: Sequence[np.ndarray]) -> Int[np.ndarray, "f 3"]:
    """Triangles of polygons, each cut into the fan of its first corner.

    An item may be a stack (f, corners) of polygons of equally many corners. Row numbers that are not finite
    become -1, which `meshes.cloud_of_mesh` refuses as out of range.
    """
    stacks: dict[int, list[np.ndarray]] = {}
    for polygon in polygons:
        corners = np.atleast_2d(np.asarray(polygon, np.float64))
        stacks.setdefault(corners.shape[1], []).append(corners)
    triangles = [np.zeros((0, 3))]
    for num_corners, stack in stacks.items():
        fan = [[0, i, i + 1] for i in range(1, num_corners - 1)]
        if fan:
            triangles.append(np.concatenate(stack)[:, fan].reshape(-1, 3))
    return np.nan_to_num(np.concatenate(triangles), nan=-1, posinf=-1, neginf=-1).astype(np.int64)


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A binary file that takes the name `path` when the block ends well and leaves no trace when it does not."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with open(partial, "xb") as file:
            yield file
        os.replace(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise


@contextlib.contextmanager
def only_here(path: Path, refusal: str) -> Iterator[None]:
    """Locks a file, which is made, against other processes; ValueError(refusal) where one has it locked.

    The lock ends with the process, however that ends. Systems without flock go without.
    """
    with open(path, "a") as file:
        if not _lock(file):
            raise ValueError(refusal)
        yield


def _lock(file: IO[str]) -> bool:
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # some network file systems have no locks
    return True
