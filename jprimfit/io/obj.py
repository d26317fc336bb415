"""OBJ, Wavefront's text format: meshes and clouds read, the fitted patches written with a colour each (.mtl).

Read: v (further values of a line are colours, ignored), vn where there is one per v, f with any of the forms a, a/b,
a//c, a/b/c and negative numbers, polygons cut into fans; everything else is skipped. Written: one object and one
material per primitive, both named like `cylinder_3`, 3 being the label in the scene. Source: Wavefront, Object Files.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jprimfit.io.files import BadFile, Mesh, fans, replacing


def read(path: Path) -> Mesh:
    """The vertices and faces (none: a cloud) of an OBJ file; BadFile if a line means nothing or no vertex is there."""
    vertices: list[list[float]] = []
    normals: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(path.read_bytes().replace(b"\\\n", b" ").split(b"\n"), start=1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == b"v":
                vertices.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == b"vn":
                normals.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == b"f":
                corners = [int(word.split(b"/")[0]) for word in words[1:]]
                polygons.append([c - 1 if c > 0 else len(vertices) + c for c in corners])
        except (ValueError, IndexError):
            shown = line.decode("latin-1").strip()[:60]
            raise BadFile(f"{path} has an OBJ line {number} ('{shown}') that means nothing: export it again.") from None
    if not vertices:
        raise BadFile(f"{path} has no vertex line ('v x y z'): give an OBJ file that holds a mesh or points.")
    paired = np.array(normals, np.float64) if len(normals) == len(vertices) else None
    return Mesh(np.array(vertices, np.float64), fans([np.array(p) for p in polygons if p]), paired)


def write_surfaces(
    path: str | Path, names: Sequence[str], patches: Sequence[Any], colors: UInt8[np.ndarray, "p 3"]
) -> None:
    """Writes the patches, one object each, and beside `path` the .mtl file of their colours (0-255).

    A patch has vertices (v, 3), faces (f, 3), rows of vertices, and normals (v, 3), as those of cad/patches.
    """
    path = Path(path)
    materials = ["# colours of segments.ply\n"]
    for name, color in zip(names, colors, strict=True):
        red, green, blue = (int(c) / 255 for c in color)
        materials.append(f"newmtl {name}\nKd {red:.4f} {green:.4f} {blue:.4f}\nKa 0 0 0\nKs 0 0 0\nillum 1\n")
    with replacing(path.with_suffix(".mtl")) as file:
        file.write("".join(materials).encode())
    with replacing(path) as file:
        file.write(f"mtllib {path.with_suffix('.mtl').name}\n".encode())
        offset = 1
        for name, patch in zip(names, patches, strict=True):
            file.write(f"o {name}\ng {name}\nusemtl {name}\n".encode())
            # 17 digits would double the file; 12 are 1 µm where the scan lies 1000 km from its origin.
            file.write(_lines("v %.12g %.12g %.12g\n", patch.vertices))
            file.write(_lines("vn %.6f %.6f %.6f\n", patch.normals))
            file.write(_lines("f %d//%d %d//%d %d//%d\n", np.repeat(patch.faces + offset, 2, axis=1)))
            offset += len(patch.vertices)


def _lines(form: str, table: np.ndarray) -> bytes:
    """The form once per row; one formatting of all rows is five times faster than numpy.savetxt."""
    return ((form * len(table)) % tuple(table.ravel().tolist())).encode()
