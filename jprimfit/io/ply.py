"""PLY, the Stanford polygon format: clouds and meshes read, labelled clouds written.

Read: ascii, binary_little_endian and binary_big_endian 1.0, properties in any order, elements and properties not needed
skipped (lists too). x y z are the points, nx ny nz their normals, the lists of `face` its polygons, cut into fans.
Written: binary little endian, one row per point, float64 coordinates (a scan may lie 1e6 units from its origin).
Source: G. Turk, The PLY Polygon File Format, 1994.
"""

import io
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jprimfit.io.files import BadFile, Mesh, fans, replacing

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
LENGTH_TYPES = {name: code for name, code in TYPES.items() if code[0] != "f"}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
FACE_LISTS = ("vertex_indices", "vertex_index")
LABEL_NAMES = ("label", "scalar_label")  # the second as CloudCompare saves the first


class Property(NamedTuple):
    """One property of an element: its name, NumPy type code, and the code of the list's length (None for a scalar)."""

    name: str
    code: str
    length_code: str | None


class Element(NamedTuple):
    """One element of the header: its name, number of rows and properties in file order."""

    name: str
    count: int
    properties: list[Property]


def read(path: Path) -> Mesh:
    """The vertices of a PLY file with its polygons as triangles (none for a cloud); BadFile if it is not one."""
    data = path.read_bytes()
    encoding, elements, start = _header(data, path)
    body = _AsciiBody(data[start:], path) if encoding == "ascii" else _BinaryBody(data, start, ORDERS[encoding], path)
    vertices = normals = None
    faces = np.zeros((0, 3), np.int64)
    wanted = [i for i, element in enumerate(elements) if element.name in ("vertex", "face")]
    for element in elements[: max(wanted, default=-1) + 1]:  # what follows them need not even be complete
        columns, lists = body.rows(element)
        if element.name == "vertex":
            vertices = _triple(columns, ("x", "y", "z"))
            normals = _triple(columns, ("nx", "ny", "nz"))
            if vertices is None:
                raise BadFile(f"{path} has vertices without x y z: give a PLY file whose vertex element has them.")
        elif element.name == "face":
            faces = fans(next((lists[name] for name in FACE_LISTS if name in lists), []))
    if vertices is None or len(vertices) == 0:
        raise BadFile(f"{path} is a PLY file without vertices: give one that holds points.")
    return Mesh(vertices, faces, normals)


def read_labels(path: Path) -> Int[np.ndarray, "n"]:
    """The property `label` of the vertices, as write_segments writes it; BadFile if the file is none or has none."""
    data = path.read_bytes()
    encoding, elements, start = _header(data, path)
    body = _AsciiBody(data[start:], path) if encoding == "ascii" else _BinaryBody(data, start, ORDERS[encoding], path)
    for element in elements:
        columns, _ = body.rows(element)
        if element.name == "vertex":
            name = next((name for name in LABEL_NAMES if name in columns), None)
            if name is None:
                raise BadFile(
                    f"{path} has vertices without a property 'label': give segments.ply of a fit, or the like."
                )
            return np.rint(np.nan_to_num(columns[name].astype(np.float64), nan=-1.0)).astype(np.int64)
    raise BadFile(f"{path} is a PLY file without vertices: give segments.ply of a fit, or the like.")


def _header(data: bytes, path: Path) -> tuple[str, list[Element], int]:
    """Encoding, elements and the position of the first byte after the header."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise BadFile(f"{path} is not a PLY file (no header from 'ply' to 'end_header'): export the scan again as PLY.")
    newline = data.find(b"\n", end)
    start = len(data) if newline < 0 else newline + 1
    encoding, elements = None, []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), start=1):
        words = line.split()
        try:
            if not words or words[0] in ("ply", "comment", "obj_info"):
                continue
            elif words[0] == "format" and words[1] in ORDERS:
                encoding = words[1]
            elif words[0] == "element" and int(words[2]) >= 0:
                elements.append(Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(Property(words[4], TYPES[words[3]], LENGTH_TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(Property(words[2], TYPES[words[1]], None))
            else:
                raise KeyError(line)
        except (KeyError, IndexError, ValueError):
            shown = line.strip()[:60]
            raise BadFile(
                f"{path} has a PLY header whose line {number} ('{shown}') means nothing: export it again."
            ) from None
    if encoding is None:
        raise BadFile(f"{path} has a PLY header without a format line: export the scan again as PLY.")
    return encoding, elements, start


def _truncated(path: Path, element: Element) -> BadFile:
    return BadFile(
        f"{path} is truncated: its header announces {element.count} {element.name} rows, "
        "the file ends before; copy it again."
    )


class _BinaryBody:
    """Reads element after element from the bytes behind a binary header."""

    def __init__(self, data: bytes, start: int, order: str, path: Path):
        self.data, self.position, self.order, self.path = data, start, order, path

    def rows(self, element: Element) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
        """Scalar columns and list properties of the element that starts here, by name."""
        if not element.properties or element.count == 0:
            return {p.name: np.zeros(0) for p in element.properties}, {}
        if all(p.length_code is None for p in element.properties):
            return self._scalars(element), {}
        return self._with_lists(element)

    def _scalars(self, element: Element) -> dict[str, np.ndarray]:
        # Names are made unique by position: a header may name a property twice.
        dtype = np.dtype([(str(i), self.order + p.code) for i, p in enumerate(element.properties)])
        if self.position + element.count * dtype.itemsize > len(self.data):
            raise _truncated(self.path, element)
        table = np.frombuffer(self.data, dtype, element.count, self.position)
        self.position += element.count * dtype.itemsize
        return {p.name: table[str(i)] for i, p in enumerate(element.properties)}

    def _with_lists(self, element: Element) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
        uniform = self._uniform(element)
        if uniform is not None:
            return {}, uniform
        lists: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties if p.length_code}
        scalars: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties if not p.length_code}
        for _ in range(element.count):
            for p in element.properties:
                length = int(self._take(p.length_code, 1, element)[0]) if p.length_code else 1
                values = self._take(p.code, length, element)
                (lists if p.length_code else scalars)[p.name].append(values)
        return {name: np.concatenate(values) for name, values in scalars.items()}, lists

    def _uniform(self, element: Element) -> dict[str, list[np.ndarray]] | None:
        """The one list of an element whose rows all hold as many entries as the first, without a loop; else None."""
        lists = [i for i, p in enumerate(element.properties) if p.length_code]
        if len(lists) != 1 or any(p.length_code is None for p in element.properties[: lists[0]]):
            return None
        one = element.properties[lists[0]]
        length = (
            int(np.frombuffer(self.data, self.order + str(one.length_code), 1, self.position)[0])
            if self._left(8)
            else 0
        )
        if not 0 < length < 64:
            return None
        fields: list = [("length", self.order + str(one.length_code)), ("values", self.order + one.code, (length,))]
        fields += [(str(i), self.order + p.code) for i, p in enumerate(element.properties) if i != lists[0]]
        dtype = np.dtype(fields)
        if not self._left(element.count * dtype.itemsize):
            return None
        table = np.frombuffer(self.data, dtype, element.count, self.position)
        if not np.all(table["length"] == length):
            return None
        self.position += element.count * dtype.itemsize
        return {one.name: [table["values"]]}

    def _left(self, num_bytes: int) -> bool:
        return self.position + num_bytes <= len(self.data)

    def _take(self, code: str, count: int, element: Element) -> np.ndarray:
        size = count * np.dtype(code).itemsize
        if count < 0 or not self._left(size):
            raise _truncated(self.path, element)
        values = np.frombuffer(self.data, self.order + code, count, self.position)
        self.position += size
        return values


class _AsciiBody:
    """Reads element after element from the text behind an ascii header, one line per row."""

    def __init__(self, data: bytes, path: Path):
        self.lines, self.path = io.BytesIO(data), path
        self.size = len(data)

    def rows(self, element: Element) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
        """Scalar columns and list properties of the element that starts here, by name."""
        if not element.properties or element.count == 0:
            return {p.name: np.zeros(0) for p in element.properties}, {}
        if element.count > self.size:
            raise _truncated(self.path, element)
        if any(p.length_code for p in element.properties):
            return self._with_lists(element)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # loadtxt warns of blank lines and of an empty body
                columns = tuple(range(len(element.properties)))
                table = np.loadtxt(self.lines, max_rows=element.count, usecols=columns, comments=None, ndmin=2)
        except ValueError as error:
            raise BadFile(
                f"{self.path} holds a {element.name} row that is not {len(columns)} numbers ({_short(error)}): "
                "export it again."
            ) from None
        if len(table) < element.count:
            raise _truncated(self.path, element)
        return {p.name: table[:, i] for i, p in enumerate(element.properties)}, {}

    def _with_lists(self, element: Element) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
        lists: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties if p.length_code}
        scalars: dict[str, list[float]] = {p.name: [] for p in element.properties if not p.length_code}
        for _ in range(element.count):
            line = self.lines.readline()
            while line and not line.strip():
                line = self.lines.readline()
            if not line:
                raise _truncated(self.path, element)
            try:
                words = np.array(line.split(), np.float64)
                place = 0
                for p in element.properties:
                    length = int(words[place]) if p.length_code else 1
                    place += 1 if p.length_code else 0
                    if length < 0 or place + length > len(words):
                        raise ValueError
                    if p.length_code:
                        lists[p.name].append(words[place : place + length])
                    else:
                        scalars[p.name].append(float(words[place]))
                    place += length
            except (ValueError, IndexError, OverflowError):
                shown = line.decode("latin-1").strip()[:60]
                raise BadFile(
                    f"{self.path} holds a {element.name} row that does not fit its header ('{shown}'): export it again."
                ) from None
        return {name: np.array(values) for name, values in scalars.items()}, lists


def _short(error: ValueError) -> str:
    return str(error).rstrip(".").replace("\n", " ")[:100]


def _triple(columns: dict[str, np.ndarray], names: tuple[str, str, str]) -> Float[np.ndarray, "n 3"] | None:
    if not all(name in columns for name in names):
        return None
    return np.stack([np.asarray(columns[name], np.float64) for name in names], axis=1)


def write_segments(
    path: str | Path,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"],
    labels: Int[np.ndarray, "n"],
    kind_ids: Int[np.ndarray, "n"],
) -> None:
    """Writes one row per point: x y z, nx ny nz, red green blue, label and kind (0-3 by type id), -1 for none."""
    columns = {letter: points[:, i] for i, letter in enumerate("xyz")}
    columns |= {"n" + letter: normals[:, i].astype("<f4") for i, letter in enumerate("xyz")}
    columns |= {name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns |= {"label": labels.astype("<i4"), "kind": kind_ids.astype("i1")}
    comment = "jprimfit segments; label = row of the primitive, -1 none; kind 0 plane 1 sphere 2 cylinder 3 cone"
    _write_columns(path, columns, comment)


def write_deviations(
    path: str | Path,
    points: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"],
    deviations: Float[np.ndarray, "n"],
    labels: Int[np.ndarray, "n"],
    *,
    scale: float,
) -> None:
    """Writes one row per point: x y z, red green blue, deviation (signed length, NaN where the label is -1), label.

    scale: the deviation of full colour, which a comment in the header tells.
    """
    columns = {letter: points[:, i] for i, letter in enumerate("xyz")}
    columns |= {name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns |= {"deviation": deviations.astype("<f4"), "label": labels.astype("<i4")}
    comment = f"jprimfit deviations; blue {-scale:.6g} or less, white 0, red {scale:.6g} or more, grey no primitive"
    _write_columns(path, columns, comment)


def _write_columns(path: str | Path, columns: dict[str, np.ndarray], comment: str) -> None:
    """Writes the vertices of a binary file, a property per column in the column's own type."""
    names = {"f8": "double", "f4": "float", "u1": "uchar", "i4": "int", "i1": "char"}
    fields = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    table = np.zeros(len(columns["x"]), np.dtype(fields))
    for name, values in columns.items():
        table[name] = values
    properties = "".join(f"property {names[dtype.str[1:]]} {name}\n" for name, dtype in fields)
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\n"
        f"element vertex {len(table)}\n{properties}end_header\n"
    )
    with replacing(path) as file:
        file.write(header.encode("ascii"))
        file.write(table.tobytes())
