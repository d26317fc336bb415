"""STL, triangles without connections, binary and ascii. Read only: surfaces with names and colours go to OBJ.

A binary file is 80 bytes of anything, the number of triangles, and 50 bytes for each: normal, three corners (float32),
two spare bytes. Many binary files begin with the word 'solid' of the ascii form, so the length decides.
Source: 3D Systems, StereoLithography Interface Specification, 1988.
"""

from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Mesh

RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("spare", "<u2")])


def read(path: Path) -> Mesh:
    """The triangles of an STL file, three vertices each; BadFile if it is truncated or neither binary nor ascii."""
    data = path.read_bytes()
    count = int(np.frombuffer(data, "<u4", 1, 80)[0]) if len(data) >= 84 else -1
    if len(data) == 84 + count * RECORD.itemsize:
        corners = np.frombuffer(data, RECORD, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        corners = _ascii_corners(data, path)
    elif count >= 0:
        raise BadFile(
            f"{path} is no whole STL file: its header announces {count} triangles, {84 + 50 * count} bytes, and it has "
            f"{len(data)}; copy or export it again."
        )
    else:
        raise BadFile(f"{path} is not an STL file ({len(data)} bytes, no header): export the mesh again.")
    if len(corners) == 0:
        raise BadFile(f"{path} is an STL file without triangles: export the mesh again.")
    return Mesh(corners, np.arange(len(corners)).reshape(-1, 3), None)


def _ascii_corners(data: bytes, path: Path) -> np.ndarray:
    words = data.lower().split()
    places = [i for i, word in enumerate(words) if word == b"vertex"]
    try:
        corners = np.array([[float(word) for word in words[i + 1 : i + 4]] for i in places], np.float64).reshape(-1, 3)
    except ValueError:
        raise BadFile(
            f"{path} is an STL file with a vertex that is not three numbers: export the mesh again."
        ) from None
    if len(corners) != len(places) or len(corners) % 3 or b"endsolid" not in words:
        raise BadFile(f"{path} is truncated: it ends before its 'endsolid'; copy or export the mesh again.")
    return corners
