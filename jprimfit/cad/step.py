"""STEP files (ISO 10303-21) of trimmed primitives, through OpenCASCADE, imported when used; step_reader.py reads them.

Every connected piece of a patch becomes one face on the exact surface, named "kind number". How a face is trimmed:
planes by their outlines, holes included, straight pieces and circles to within about two point spacings;
cylinders and cones by the intervals of angle and length that hold the piece, all the way round where it goes round;
spheres whole, or by intervals of latitude and longitude about the axis for which these are tightest (a cap: about its
middle). Such rectangles reach over notches of the piece. STEP knows units, scans do not: one unit of the input is
written as 1 mm.
"""

# pyright: reportAttributeAccessIssue=false
# OCP is one binary module that registers its submodules at run time: the checker cannot look inside.

import contextlib
import importlib.util
import os
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from jprimfit.cad import charts, outlines, patches
from jprimfit.types import Cylinder, Plane, Primitive, Sphere

TOLERANCE = 0.8  # of outlines, in edges of the patch: about a cell of its occupancy
NOT_INSTALLED = "STEP files need OpenCASCADE, which is not installed: run pip install 'jprimfit[cad]'."
GAP = 2.0  # edges without a vertex that make an opening in a turn


class _Rectangle(NamedTuple):
    """Limits on a surface of revolution: angle around, and length or latitude along the axis."""

    angle: charts.Interval
    low: float
    high: float


def available() -> bool:
    """Whether OpenCASCADE is installed (`pip install jprimfit[cad]`); nothing is imported to find out."""
    return importlib.util.find_spec("OCP") is not None


def write_step(
    path: str | os.PathLike[str], primitives: Sequence[Primitive], patch_list: Sequence[patches.Patch]
) -> list[int]:
    """Writes one face per connected piece of each primitive's patch, whole or not at all.

    Args:
        path: of the file.
        primitives: the surfaces.
        patch_list: their trimmed triangulations, one each, in the same frame (jprimfit.cad.patches.patch).

    Returns:
        The primitives that are not in the file because their patch is empty or no valid face came of it. If that is
        all of them, no file is written.

    Raises:
        ValueError: OpenCASCADE is not installed, the numbers of primitives and patches differ, or it cannot write.
    """
    if not available():
        raise ValueError(NOT_INSTALLED)
    if len(primitives) != len(patch_list):
        raise ValueError(f"{len(primitives)} primitives came with {len(patch_list)} patches: give one patch for each.")
    faces: list[tuple[str, Any]] = []
    left_out = []
    for i, (primitive, patch) in enumerate(zip(primitives, patch_list, strict=True)):
        made = []
        for piece in patches.components(patch):
            # OpenCASCADE reports degenerate input by exceptions of many types; one bad face must not cost the others.
            with contextlib.suppress(Exception):
                made += _faces(primitive, piece)
        valid = [face for face in made if _is_valid(face)]
        faces += [(f"{primitive.kind} {i}", face) for face in valid]
        if not valid:
            left_out.append(i)
    if faces:
        _write(Path(path), faces)
    return left_out


def _faces(primitive: Primitive, piece: patches.Patch) -> list[Any]:
    """The trimmed faces of one connected piece (several only where outlines touch in a point)."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.Geom import Geom_ConicalSurface, Geom_CylindricalSurface, Geom_SphericalSurface

    if isinstance(primitive, Plane):
        return _plane_faces(primitive, piece)
    edge, rim = _edge_length(piece), _rim(piece)
    if isinstance(primitive, Sphere):
        axes, limits = _sphere_limits(primitive, piece, edge, rim)
        origin, radius = np.asarray(primitive.center, np.float64), float(primitive.radius)
        surface = Geom_SphericalSurface(_placement(origin, axes), radius)
    elif isinstance(primitive, Cylinder):
        axes = charts.frame(np.asarray(primitive.axis))
        origin, radius = np.asarray(primitive.center, np.float64), float(primitive.radius)
        local = (piece.vertices - origin[None, :]) @ axes.T
        limits = _Rectangle(_turn(local, rim, edge / radius), *_span(local[:, 2], rim, edge))
        surface = Geom_CylindricalSurface(_placement(origin, axes), radius)
    else:
        axes = charts.frame(np.asarray(primitive.axis))
        local = (piece.vertices - np.asarray(primitive.apex, np.float64)[None, :]) @ axes.T
        cosine, sine = np.cos(float(primitive.half_angle)), np.sin(float(primitive.half_angle))
        # The surface is placed in the middle of the piece: a radius of zero at its origin is not for every program.
        low, high = _span(local[:, 2] / cosine, rim, edge)
        middle = (low + high) / 2
        limits = _Rectangle(_turn(local, rim, edge / (high * sine)), low - middle, high - middle)
        origin = np.asarray(primitive.apex, np.float64) + middle * cosine * axes[2]
        surface = Geom_ConicalSurface(_placement(origin, axes), float(primitive.half_angle), middle * sine)
    start, width, _ = limits.angle
    return [BRepBuilderAPI_MakeFace(surface, start, start + width, limits.low, limits.high, 1e-9 * edge).Face()]


def _plane_faces(primitive: Plane, piece: patches.Patch) -> list[Any]:
    """A face with holes; should simplified outlines cross each other, the exact ones are taken."""
    axes = charts.frame(np.asarray(primitive.normal))
    origin = piece.vertices.mean(axis=0)
    loops = [(piece.vertices[loop] - origin[None, :]) @ axes[:2].T for loop in patches.boundary_loops(piece)]
    tolerance = TOLERANCE * _edge_length(piece)
    for allowed in (tolerance, 0.0):
        faces = _faces_of_loops(loops, origin, axes, allowed)
        if faces and all(_is_valid(face) for face in faces):
            return faces
    return []


def _faces_of_loops(loops: list[np.ndarray], origin: np.ndarray, axes: np.ndarray, tolerance: float) -> list[Any]:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.Geom import Geom_Plane

    surface = Geom_Plane(_placement(origin, axes))
    outer = [loop for loop in loops if outlines.signed_area(loop) > 0]
    holes = [loop for loop in loops if outlines.signed_area(loop) < 0]
    faces = []
    for loop in outer:
        maker = BRepBuilderAPI_MakeFace(surface, _wire(loop, origin, axes, tolerance), True)
        # A connected piece has one outer outline, unless outlines touch: then holes go to the largest.
        if loop is max(outer, key=outlines.signed_area):
            for hole in holes:
                maker.Add(_wire(hole, origin, axes, tolerance))
        faces.append(maker.Face())
    return faces


def _wire(loop: np.ndarray, origin: np.ndarray, axes: np.ndarray, tolerance: float) -> Any:
    """A circle where the loop is one within the tolerance, else a polygon; turning as the loop does."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge, BRepBuilderAPI_MakePolygon, BRepBuilderAPI_MakeWire
    from OCP.gp import gp_Ax2, gp_Circ, gp_Dir, gp_Pnt

    round_one = outlines.circle(loop, tolerance=tolerance) if tolerance > 0 else None
    if round_one is not None:
        axis = axes[2] if outlines.signed_area(loop) > 0 else -axes[2]
        center = origin + round_one.center @ axes[:2]
        place = gp_Ax2(gp_Pnt(*center.tolist()), gp_Dir(*axis.tolist()), gp_Dir(*axes[0].tolist()))
        return BRepBuilderAPI_MakeWire(BRepBuilderAPI_MakeEdge(gp_Circ(place, round_one.radius)).Edge()).Wire()
    corners = outlines.simplified(loop, tolerance=tolerance)
    polygon = BRepBuilderAPI_MakePolygon()
    for corner in (origin[None, :] + corners @ axes[:2]).tolist():
        polygon.Add(gp_Pnt(*corner))
    polygon.Close()
    return polygon.Wire()


def _sphere_limits(
    primitive: Sphere, piece: patches.Patch, edge: float, rim: np.ndarray
) -> tuple[np.ndarray, _Rectangle]:
    """The axes, and the limits about them, that enclose the piece with the least area."""
    radius = float(primitive.radius)
    directions = charts.normals(primitive, piece.vertices)
    loops = patches.boundary_loops(piece)
    if not loops:
        whole = charts.Interval(0.0, 2 * np.pi, True)
        return np.eye(3), _Rectangle(whole, -np.pi / 2, np.pi / 2)
    mean = directions.mean(axis=0)
    candidates = [mean] if np.sqrt(mean @ mean) > 0.05 else []
    candidates += list(np.linalg.eigh(directions.T @ directions)[1].T)
    candidates += [np.cross(directions[loop], np.roll(directions[loop], -1, axis=0)).sum(axis=0) for loop in loops]
    best = None
    for axis in candidates:
        if not axis @ axis > 1e-12:
            continue
        axes = charts.frame(axis)
        local = directions @ axes.T
        latitude = np.arcsin(np.clip(local[:, 2], -1.0, 1.0))
        low, high = _span(latitude, rim, edge / radius)
        # Vertices surround a pole, they do not hit it.
        low = -np.pi / 2 if low < -np.pi / 2 + edge / radius else low
        high = np.pi / 2 if high > np.pi / 2 - edge / radius else high
        turn = _turn(local, rim, edge / radius / np.cos(latitude).max())
        area = turn.width * (np.sin(high) - np.sin(low))
        if best is None or area < best[0]:
            best = (area, axes, _Rectangle(turn, low, high))
    assert best is not None  # eigenvectors are never zero
    return best[1], best[2]


def _rim(piece: patches.Patch) -> Bool[np.ndarray, "v"]:
    """Which vertices lie on the boundary."""
    rim = np.zeros(len(piece.vertices), bool)
    for loop in patches.boundary_loops(piece):
        rim[loop] = True
    return rim


def _span(values: Float64[np.ndarray, "v"], rim: Bool[np.ndarray, "v"], edge: float) -> tuple[float, float]:
    """Least and greatest value. Where that is on the ragged boundary: the median of the boundary within two edges."""
    ends = []
    for sign in (1.0, -1.0):
        signed = sign * values
        end = float(signed.min())
        on_rim = signed[rim & (signed <= end + 2 * edge)]
        # A pole or an apex inside the piece is no raggedness.
        if len(on_rim) and on_rim.min() <= end + 1e-3 * edge:
            end = float(np.median(on_rim))
        ends.append(sign * end)
    return ends[0], ends[1]


def _turn(local: Float64[np.ndarray, "v 3"], rim: Bool[np.ndarray, "v"], edge: float) -> charts.Interval:
    """The angles around the third axis; `edge` as an angle."""
    angles = np.arctan2(local[:, 1], local[:, 0])
    interval = charts.angular_interval(angles, gap=GAP * edge)
    if interval.full:
        return interval
    low, high = _span(np.mod(angles - interval.start + 1e-9, 2 * np.pi), rim, edge)
    return charts.Interval(interval.start + low, high - low, False)


def _edge_length(piece: patches.Patch) -> float:
    ends = piece.vertices[charts.edges(piece.faces)[0]]
    return float(np.median(np.sqrt(np.sum((ends[:, 0] - ends[:, 1]) ** 2, axis=1))))


def _placement(origin: np.ndarray, axes: np.ndarray) -> Any:
    from OCP.gp import gp_Ax3, gp_Dir, gp_Pnt

    return gp_Ax3(gp_Pnt(*origin.tolist()), gp_Dir(*axes[2].tolist()), gp_Dir(*axes[0].tolist()))


def _is_valid(face: Any) -> bool:
    from OCP.BRepCheck import BRepCheck_Analyzer

    return not face.IsNull() and BRepCheck_Analyzer(face).IsValid()


def _write(path: Path, faces: Sequence[tuple[str, Any]]) -> None:
    """All faces in one compound, to a file beside the wanted one that takes its name at the end."""
    from OCP.BRep import BRep_Builder
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.Interface import Interface_Static
    from OCP.STEPConstruct import STEPConstruct
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer
    from OCP.TCollection import TCollection_HAsciiString
    from OCP.TopoDS import TopoDS_Compound

    compound, builder = TopoDS_Compound(), BRep_Builder()
    builder.MakeCompound(compound)
    for _, face in faces:
        builder.Add(compound, face)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with quiet():
            writer = STEPControl_Writer()
            Interface_Static.SetCVal_s("write.step.unit", "MM")
            writer.Transfer(compound, STEPControl_StepModelType.STEPControl_AsIs)
            finder = writer.WS().TransferWriter().FinderProcess()
            for name, face in faces:
                item = STEPConstruct.FindEntity_s(finder, face)
                if item is not None:
                    item.SetName(TCollection_HAsciiString(name))
            status = writer.Write(str(partial))
        if status != IFSelect_ReturnStatus.IFSelect_RetDone or not partial.exists():
            raise ValueError(f"OpenCASCADE could not write {path}: choose a folder that exists and is writable.")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """OpenCASCADE's messenger, which prints to stdout, is silent for as long as the block lasts."""
    from OCP.Message import Message

    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)
