"""What a dataset knows of one part: the record that every reader gives and every writer takes.

A part is a solid whose surface is cut into i instances, each lying on one primitive. Its surface is held as a cloud,
as a labelled triangulation, as trimmed analytic faces, or as several of these. Everything is NumPy on the host.
Coordinates and primitives share one frame; x_part = center + scale * x leads back to the frame and unit of the part.
Axis letters: n points, i instances, m samples each, v vertices, f triangles, t trimmed faces, l loops, c corners.
A label is the number of an instance; BACKGROUND marks what lies on none of the four kinds.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int8

from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

BACKGROUND = -1
KINDS = ("plane", "sphere", "cylinder", "cone")  # the number of a kind is its position
NUM_PARAMETERS = 7  # the longest row: axis, point, size
MAX_ROWS = 1 << 24  # points, vertices, triangles or corners of one part: beyond it a file is taken for damaged
MAX_INSTANCES = 1 << 16
_TEXT_BYTES = {"name": 200, "family": 200, "unit": 16, "split": 32}
_CLASSES: tuple[Any, ...] = (Plane, Sphere, Cylinder, Cone)
_SHORT, _LONG = (slice(0, 3), slice(3, 4)), (slice(0, 3), slice(3, 6), slice(6, 7))
_FIELDS = {"plane": _SHORT, "sphere": _SHORT, "cylinder": _LONG, "cone": _LONG}  # where each field lies in a row


class Cloud(NamedTuple):
    """Points drawn from the surface; row j of every field but the samples belongs to point j."""

    points: Float[np.ndarray, "n 3"]  # exactly on the surface, float32 or float64
    normals: Float[np.ndarray, "n 3"]  # unit, of the surface there
    labels: Int[np.ndarray, "n"]  # int32, BACKGROUND or instance
    noisy_points: Float[np.ndarray, "n 3"] | None = None  # the same points as a scanner saw them
    samples: Float[np.ndarray, "i m 3"] | None = None  # uniform by area on each instance, for the residue (m = 512)
    sample_normals: Float[np.ndarray, "i m 3"] | None = None  # unit


class Mesh(NamedTuple):
    """A triangulation, counter-clockwise seen from outside; points drawn from it are projected onto their primitive."""

    vertices: Float[np.ndarray, "v 3"]  # float32 or float64
    faces: Int[np.ndarray, "f 3"]  # int32, rows of vertices
    labels: Int[np.ndarray, "f"]  # int32, BACKGROUND or instance


class Trims(NamedTuple):
    """Analytic faces, each cut out of its primitive by closed polygons in the parameters (a, b) of the surface.

    x, y, z are the rows of frames[k], z = normal, axis or pole, and u(a) = cos(a)·x + sin(a)·y. The point (a, b) is
    plane: offset·z + a·x + b·y                     sphere: center + radius·(cos(b)·u(a) + sin(b)·z)
    cylinder: center + b·z + radius·u(a)            cone: apex + b·(z + tan(half_angle)·u(a))
    A point belongs to the face if an odd number of its loops encloses (a, b); a loop may run past one turn in a.
    """

    labels: Int[np.ndarray, "t"]  # int32, instance
    frames: Float[np.ndarray, "t 3 3"]  # float64, orthonormal rows
    outward: Int8[np.ndarray, "t"]  # +1 where the gradient of the signed distance leads out of the solid, else -1
    loop_face: Int[np.ndarray, "l"]  # int32, ascending
    loop_size: Int[np.ndarray, "l"]  # int32, number of corners: loops lie one after the other in corners
    corners: Float[np.ndarray, "c 2"]  # float64


class Part(NamedTuple):
    """One part: who it is, what its instances are, and its surface in at least one form."""

    name: str  # unique in a file
    primitives: tuple[Primitive, ...]  # NumPy float64; index = label
    cloud: Cloud | None = None
    mesh: Mesh | None = None
    trims: Trims | None = None
    areas: Float[np.ndarray, "i"] | None = None  # float64, squared lengths of the frame; None or 0 = not known
    background_area: float = 0.0  # of what is labelled BACKGROUND
    family: str = ""  # parts of one family lie in one split; "" = not known
    split: str = ""  # "train", "val", "test" or another; "" = in none
    seed: int = -1  # -1 = not drawn at random
    unit: str = ""  # of the part, such as "mm"; "" = not known
    center: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 0.0)
    scale: float = 1.0


class Table(NamedTuple):
    """Primitives as rows of parameters, zeros behind the last.

    plane: normal, offset; sphere: center, radius; cylinder: axis, center, radius; cone: axis, apex, half_angle.
    """

    kind: Int8[np.ndarray, "i"]
    parameters: Float[np.ndarray, "i 7"]  # float64


def pack(primitives: Sequence[Primitive]) -> Table:
    """Primitives -> rows; what is no primitive, or of the wrong size, raises ValueError."""
    kind = np.zeros(len(primitives), np.int8)
    parameters = np.zeros((len(primitives), NUM_PARAMETERS))
    for row, primitive in enumerate(primitives):
        fields = _FIELDS.get(getattr(primitive, "kind", ""), ())
        if [np.size(value) for value in primitive] != [field.stop - field.start for field in fields]:
            raise ValueError(
                f"Primitive {row} is {primitive!r}, expected a Plane, Sphere, Cylinder or Cone of one item."
            )
        kind[row] = KINDS.index(primitive.kind)
        for field, value in zip(fields, primitive, strict=True):
            parameters[row, field] = value
    return Table(kind, parameters)


def unpack(table: Table) -> tuple[Primitive, ...]:
    """Rows -> primitives of NumPy float64; the inverse of pack."""
    primitives = []
    for kind_id, row in zip(table.kind.tolist(), table.parameters, strict=True):
        *vectors, size = _FIELDS[KINDS[kind_id]]
        primitives.append(_CLASSES[kind_id](*(row[field].copy() for field in vectors), row[size.start]))
    return tuple(primitives)


def check_table(table: Table, *, source: str) -> None:
    """Raises ValueError unless every row is a primitive: finite, unit directions, sizes in range, zeros behind."""
    kind, row = table.kind, table.parameters
    plane, sphere, cylinder, cone = (kind == number for number in range(len(KINDS)))
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.sum(row[:, :3] ** 2, axis=1) - 1.0) < 1e-6
    size = np.where(plane | sphere, row[:, 3], row[:, 6])
    rules = {
        "has an unknown kind": (kind >= 0) & (kind < len(KINDS)),
        "is not finite": np.all(np.isfinite(row), axis=1),
        "has a normal or axis that is not a unit vector": unit | sphere,
        "has a radius that is not positive": (size > 0) | plane | cone,
        "has a half-angle outside (0, pi/2)": ((size > 0) & (size < np.pi / 2)) | ~cone,
        "has more parameters than its kind": np.all(row[:, 4:] == 0, axis=1) | cylinder | cone,
    }
    for words, good in rules.items():
        _require(bool(np.all(good)), source, f"instance {int(np.argmin(good)) if good.size else 0} {words}")


def check(part: Part, *, source: str) -> None:
    """Raises ValueError, one sentence that begins with source, unless the part keeps every promise of this file."""
    for field, limit in _TEXT_BYTES.items():
        text = getattr(part, field)
        good = isinstance(text, str) and len(text.encode(errors="replace")) <= limit and text.isprintable()
        _require(good, source, f"its {field} is not a printable text of at most {limit} bytes")
    _require(part.name != "", source, "it has no name")
    _require(re.fullmatch(r"[a-z][a-z0-9_]*|", part.split) is not None, source, "its split is not a lower-case word")
    _require(isinstance(part.seed, int) and -1 <= part.seed < 2**63, source, "its seed is not in [-1, 2**63)")
    frame = np.append(np.asarray(part.center, np.float64), [part.scale, part.background_area])
    _require(frame.shape == (5,) and bool(np.all(np.isfinite(frame))), source, "its center or scale is not finite")
    _require(part.scale > 0 and part.background_area >= 0, source, "its scale is not positive or an area is negative")
    count = len(part.primitives)
    _require(count <= MAX_INSTANCES, source, f"it has {count} instances, more than {MAX_INSTANCES}")
    table = pack(part.primitives)
    check_table(table, source=source)
    if part.areas is not None:
        _array(part.areas, (count,), "areas", source)
        _require(bool(np.all(part.areas >= 0)), source, "an area is negative")
    _require(any(form is not None for form in (part.cloud, part.mesh, part.trims)), source, "it has no surface")
    if part.cloud is not None:
        _check_cloud(part.cloud, count, source)
    if part.mesh is not None:
        _array(part.mesh.vertices, (None, 3), "vertices", source)
        _integers(part.mesh.faces, (None, 3), 0, len(part.mesh.vertices), "faces", source)
        _integers(part.mesh.labels, (len(part.mesh.faces),), BACKGROUND, count, "mesh labels", source)
    if part.trims is not None:
        _check_trims(part.trims, table, source)


def _check_cloud(cloud: Cloud, count: int, source: str) -> None:
    _array(cloud.points, (None, 3), "points", source)
    _integers(cloud.labels, (len(cloud.points),), BACKGROUND, count, "labels", source)
    _array(cloud.normals, cloud.points.shape, "normals", source, unit=True)
    if cloud.noisy_points is not None:
        _array(cloud.noisy_points, cloud.points.shape, "noisy points", source)
    if cloud.samples is not None:
        _array(cloud.samples, (count, None, 3), "samples", source)
    if cloud.sample_normals is not None:
        shape = (0, 0, 3) if cloud.samples is None else cloud.samples.shape
        _array(cloud.sample_normals, shape, "sample normals", source, unit=True)


def _check_trims(trims: Trims, table: Table, source: str) -> None:
    _integers(trims.labels, (None,), 0, len(table.kind), "trim labels", source)
    _array(trims.frames, (len(trims.labels), 3, 3), "frames", source)
    with np.errstate(over="ignore", invalid="ignore"):
        skew = trims.frames @ np.swapaxes(trims.frames, 1, 2) - np.eye(3)[None]
    _require(bool(np.all(np.abs(skew) < 1e-6)), source, "a frame is not orthonormal")
    kind, direction = table.kind[trims.labels], table.parameters[trims.labels, :3]
    along = np.sum(trims.frames[:, 2] * direction, axis=1)
    along = np.where(kind == KINDS.index("cylinder"), np.abs(along), along)
    good = (np.abs(along - 1.0) < 1e-6) | (kind == KINDS.index("sphere"))
    _require(bool(np.all(good)), source, "the third row of a frame is not the normal or axis")
    _integers(trims.outward, (len(trims.labels),), -1, 2, "outward signs", source)
    _require(bool(np.all(trims.outward != 0)), source, "an outward sign is 0")
    _integers(trims.loop_face, (None,), 0, len(trims.labels), "loop faces", source)
    _require(bool(np.all(np.diff(trims.loop_face) >= 0)), source, "the loops are not in the order of their faces")
    _integers(trims.loop_size, trims.loop_face.shape, 3, MAX_ROWS, "loop sizes", source)
    _array(trims.corners, (int(trims.loop_size.sum(dtype=np.int64)), 2), "corners", source)


def _array(values: Any, shape: tuple, what: str, source: str, *, unit: bool = False) -> None:
    _require(
        isinstance(values, np.ndarray) and values.dtype in (np.float32, np.float64), source, f"{what} are not floats"
    )
    _shape(values, shape, what, source)
    _require(bool(np.all(np.isfinite(values))), source, f"{what} hold NaN or infinity")
    if unit:
        with np.errstate(over="ignore"):
            good = np.abs(np.sum(values * values, axis=-1) - 1.0) < 0.02
        _require(bool(np.all(good)), source, f"{what} are not of length 1")


def _integers(values: Any, shape: tuple, low: int, high: int, what: str, source: str) -> None:
    _require(isinstance(values, np.ndarray) and values.dtype.kind in "iu", source, f"{what} are not integers")
    _shape(values, shape, what, source)
    if values.size:
        found = int(values.min()), int(values.max())
        _require(
            low <= found[0] and found[1] < high, source, f"{what} run over {list(found)}, expected [{low}, {high})"
        )


def _shape(values: np.ndarray, shape: tuple, what: str, source: str) -> None:
    good = values.ndim == len(shape) and all(b in (None, a) for a, b in zip(values.shape, shape, strict=False))
    words = "(" + ", ".join("any" if side is None else str(side) for side in shape) + ")"
    _require(good, source, f"{what} have shape {values.shape}, expected {words}")
    free = [a for a, b in zip(values.shape, shape, strict=True) if b is None]
    _require(all(0 < side <= MAX_ROWS for side in free), source, f"{what} have shape {values.shape}, none or too many")


def _require(good: bool, source: str, words: str) -> None:
    if not good:
        raise ValueError(f"{source} cannot be used: {words}.")
