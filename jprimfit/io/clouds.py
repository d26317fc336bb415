"""A scan from a file, whatever its format: the dispatch by suffix, and the promise that failure is one sentence.

Formats: SUFFIXES. A mesh (OBJ, STL or PLY with faces) is sampled by area (`meshes`); an OBJ or PLY without faces is a
cloud. Points keep the order of the file, its unit and frame; rows with NaN are kept here and dropped in `checks`.
"""

import os
from collections.abc import Callable
from pathlib import Path

from jprimfit.io import e57, las, numpy_files, obj, pcd, ply, stl, text
from jprimfit.io.files import BadFile, Cloud, Mesh
from jprimfit.io.meshes import cloud_of_mesh

READERS: dict[str, Callable[[Path], Cloud | Mesh]] = {
    ".ply": ply.read,
    **dict.fromkeys((".xyz", ".csv", ".txt", ".asc", ".pts", ".xyzn"), text.read),
    ".npy": numpy_files.read_npy,
    ".npz": numpy_files.read_npz,
    ".obj": obj.read,
    ".stl": stl.read,
    ".pcd": pcd.read,
    **dict.fromkeys((".las", ".laz"), las.read),
    ".e57": e57.read,
}
SUFFIXES = tuple(READERS)


def read_cloud(path: str | os.PathLike[str]) -> Cloud:
    """The points of the scan in `path`, float64 (n, 3), n >= 1, and its normals or None.

    Any file whatever gives a cloud or a ValueError of one sentence: what was found, what is expected, what to do.
    """
    path = Path(path)
    if path.is_dir():
        raise BadFile(f"{path} is a folder: give the scan files in it.")
    if not path.is_file():
        raise BadFile(f"{path} does not exist: check the name.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(SUFFIXES)
        raise BadFile(
            f"{path} has the suffix '{path.suffix}', which is none of {known}: export the scan in one of these."
        )
    if path.stat().st_size == 0:
        raise BadFile(f"{path} is empty (0 bytes): export or copy the scan again.")
    try:
        found = reader(path)
    except BadFile:
        raise
    except MemoryError:
        raise BadFile(f"{path} needs more memory than there is: thin the scan out.") from None
    except OSError as error:
        raise BadFile(f"{path} cannot be read ({error.strerror or type(error).__name__}): check the file.") from None
    except Exception as error:
        # The readers of other people's formats raise what they like for damaged files; the user gets a sentence.
        reason = " ".join(str(error).split()).rstrip(".")[:120] or type(error).__name__
        raise BadFile(
            f"{path} is not a whole {path.suffix[1:].upper()} file ({reason}): export or copy it again."
        ) from error
    return cloud_of_mesh(found, path) if isinstance(found, Mesh) else found
