"""STEP files (ISO 10303-21) read as triangles that know their exact surface, through OpenCASCADE, imported when used.

Every solid of a file becomes one body; a solid that is placed several times counts once; a file without solids is one
body of all its faces. A face on a plane, sphere, cylinder or cone has that primitive, a face on anything else None;
swept surfaces that are one of the four count as such. Triangles deviate from their face by at most CHORD of the body's
diagonal, and turn by at most ANGLE between neighbours, so that their area is right to 0.1 %. Host code, float64.
v vertices, t triangles, f faces of the file.
"""

# pyright: reportAttributeAccessIssue=false
# OCP is one binary module that registers its submodules at run time: the checker cannot look inside.

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jprimfit.cad import charts, step
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

CHORD = 5e-4  # of the diagonal of the body's box
ANGLE = 0.1  # radians: chords of a turn by this lose 0.04 % of the area
WELD = 1e-6  # of the diagonal: corners of neighbouring faces nearer than this are one
MAX_HALVINGS = 3  # of the deviation that the mesher is asked for, where it did not keep to it
FACES_NAMED = 3
# Units by their names in files: our name, and the length in mm, in which OpenCASCADE gives all lengths.
UNITS = {
    "MILLIMETRE": ("mm", 1.0),
    "CENTIMETRE": ("cm", 10.0),
    "METRE": ("m", 1e3),
    "MICROMETRE": ("um", 1e-3),
    "INCH": ("in", 25.4),
    "FOOT": ("ft", 304.8),
}


class Body(NamedTuple):
    """One solid, or all faces of a file that has none; neighbouring triangles share vertices."""

    vertices: Float64[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]  # rows of vertices; counter-clockwise seen from outside if it is a solid
    face_index: Int[np.ndarray, "t"]  # rows of surfaces
    surfaces: tuple[Primitive | None, ...]  # of every face, float64; a cone's axis points into the nappe of the face
    areas: Float64[np.ndarray, "f"]  # of every face, integrated over the exact surface


class Contents(NamedTuple):
    """What a file holds."""

    bodies: tuple[Body, ...]  # in mm, whatever the unit of the file
    unit: str  # of the file, "mm" where it names none of UNITS or several
    millimetres: float  # in one unit
    num_loose: int  # faces beside the solids, which belong to no body
    num_open: int  # bodies with gaps: they were never solids, faces do not meet, or OpenCASCADE gave up some


def read_step(path: str | os.PathLike[str]) -> Contents:
    """The bodies of a STEP file in its order.

    ValueError of one sentence: OpenCASCADE is not installed, the file is no whole STEP file, holds no face, or a face
    cannot be meshed within CHORD. Some broken files crash OpenCASCADE, and with it the process: step_worker.py reads
    what others made.
    """
    if not step.available():
        raise ValueError(step.NOT_INSTALLED)
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist: check the name.")
    try:
        with step.quiet():
            shape, unit = _shape(path)
            solids = _solids(shape)
            bodies = tuple(_body(solid) for solid in solids or [shape])
            num_loose = _num_loose(shape) if solids else 0
    except _Unusable as reason:
        raise ValueError(f"{path} cannot be read: {reason}.") from None
    # OpenCASCADE reports what it did not expect by exceptions of many types.
    except Exception as error:
        raise ValueError(f"{path} cannot be read: OpenCASCADE found it damaged; export it again.") from error
    num_open = sum(not _is_closed(body) for body in bodies)
    return Contents(bodies, *UNITS.get(unit.upper(), ("mm", 1.0)), num_loose, num_open)


class _Unusable(Exception):
    """What is wrong with a file, as the end of a sentence."""


def _shape(path: Path) -> tuple[Any, str]:
    """Everything in the file as one shape, and the name of its unit, "" if it has none or several."""
    from OCP.collections import Sequence_TCollection_AsciiString
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.ShapeCustom import ShapeCustom
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_ReturnStatus.IFSelect_RetDone:
        raise _Unusable("it is no whole STEP file; export it again")
    lengths, angles, solid_angles = (Sequence_TCollection_AsciiString() for _ in range(3))
    reader.FileUnits(lengths, angles, solid_angles)
    names = {lengths.Value(row).ToCString() for row in range(1, lengths.Length() + 1)}
    reader.TransferRoots()
    shape = reader.OneShape()
    if shape.IsNull():
        raise _Unusable("it holds no shape; export it as solids or faces")
    return ShapeCustom.SweptToElementary_s(shape), names.pop() if len(names) == 1 else ""


def _solids(shape: Any) -> list[Any]:
    """The different solids of a shape, each as it is placed first."""
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location

    solids, unplaced = [], []
    for solid in _explored(TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_SOLID)):
        own = solid.Located(TopLoc_Location())
        if not any(own.IsSame(other) for other in unplaced):
            solids.append(solid)
            unplaced.append(own)
    return solids


def _num_loose(shape: Any) -> int:
    """The number of faces that lie in no solid."""
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer

    loose = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_FACE, TopAbs_ShapeEnum.TopAbs_SOLID)
    return sum(1 for _ in _explored(loose))


def _explored(explorer: Any) -> Iterator[Any]:
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _body(shape: Any) -> Body:
    """The triangles of a shape, meshed again and finer where they deviate too far."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.BRepTools import BRepTools
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_FACE)
    faces = [TopoDS.Face(face) for face in _explored(explorer)]
    if not faces:
        raise _Unusable("it holds no face; export it as solids or faces")
    box = Bnd_Box()
    BRepBndLib.Add_s(shape, box)
    diagonal = float(np.sqrt(box.SquareExtent()))
    for halving in range(MAX_HALVINGS + 1):
        BRepTools.Clean_s(shape)  # the mesher keeps triangles that come with the file
        BRepMesh_IncrementalMesh(shape, CHORD / 2 ** (halving + 1) * diagonal, False, ANGLE, False)
        pieces = [_triangles(face) for face in faces]
        surfaces = [_primitive(face, vertices) for face, (vertices, _) in zip(faces, pieces, strict=True)]
        far = [
            row
            for row, (surface, piece) in enumerate(zip(surfaces, pieces, strict=True))
            if surface is not None and _deviation(surface, *piece) > CHORD * diagonal
        ]
        if not far:
            break
    else:
        listed = ", ".join(str(row + 1) for row in far[:FACES_NAMED]) + (", ..." if len(far) > FACES_NAMED else "")
        raise _Unusable(f"the edges of its face {listed} do not lie on the face; repair it in the CAD program")
    return _joined(pieces, surfaces, [_area(face) for face in faces], WELD * diagonal)


def _triangles(face: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a meshed face, turning as the face does."""
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_Orientation
    from OCP.TopLoc import TopLoc_Location

    location = TopLoc_Location()
    mesh = BRep_Tool.Triangulation_s(face, location)
    if mesh is None or mesh.NbTriangles() == 0:
        raise _Unusable("one of its faces cannot be meshed; repair it in the CAD program")
    place = location.Transformation()
    nodes = [mesh.Node(row).Transformed(place) for row in range(1, mesh.NbNodes() + 1)]
    vertices = np.array([(node.X(), node.Y(), node.Z()) for node in nodes])
    triangles = np.array([mesh.Triangle(row).Get() for row in range(1, mesh.NbTriangles() + 1)]) - 1
    turned = (face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED) != place.IsNegative()
    return vertices, triangles[:, ::-1] if turned else triangles


def _primitive(face: Any, vertices: Float64[np.ndarray, "v 3"]) -> Primitive | None:
    """The surface of a face; the vertices tell which nappe of a cone is used, one that uses both is no primitive."""
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.GeomAbs import GeomAbs_SurfaceType

    surface = BRepAdaptor_Surface(face)
    match surface.GetType():
        case GeomAbs_SurfaceType.GeomAbs_Plane:
            plane = surface.Plane()
            normal = _direction(plane.Axis())
            return Plane(normal, np.float64(_coordinates(plane.Location()) @ normal))
        case GeomAbs_SurfaceType.GeomAbs_Sphere:
            sphere = surface.Sphere()
            return Sphere(_coordinates(sphere.Location()), np.float64(sphere.Radius()))
        case GeomAbs_SurfaceType.GeomAbs_Cylinder:
            cylinder = surface.Cylinder()
            center = _coordinates(cylinder.Location())
            return Cylinder(_direction(cylinder.Axis()), center, np.float64(cylinder.Radius()))
        case GeomAbs_SurfaceType.GeomAbs_Cone:
            cone = surface.Cone()
            axis, apex = _direction(cone.Axis()), _coordinates(cone.Apex())
            height = (vertices - apex[None]) @ axis
            if height.min() < -1e-6 * np.ptp(height) and height.max() > 1e-6 * np.ptp(height):
                return None
            return Cone(axis if np.sum(height) > 0 else -axis, apex, np.float64(abs(cone.SemiAngle())))
    return None


def _coordinates(point: Any) -> Float64[np.ndarray, "3"]:
    return np.array([point.X(), point.Y(), point.Z()])


def _direction(axis: Any) -> Float64[np.ndarray, "3"]:
    direction = _coordinates(axis.Direction())
    return direction / np.sqrt(direction @ direction)


def _area(face: Any) -> float:
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    properties = GProp_GProps()
    BRepGProp.SurfaceProperties_s(face, properties)
    return abs(float(properties.Mass()))


def _deviation(surface: Primitive, vertices: Float64[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> float:
    """The largest distance from the surface of the corners, the middles of sides and the middles of triangles."""
    corners = vertices[triangles]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    points = np.concatenate([vertices, middles.reshape(-1, 3), corners.mean(axis=1)])
    return float(np.sqrt(np.max(np.sum((points - charts.feet(surface, points)) ** 2, axis=1))))


def _joined(
    pieces: list[tuple[np.ndarray, np.ndarray]], surfaces: list[Primitive | None], areas: list[float], reach: float
) -> Body:
    """One body of all faces, whose corners nearer than reach are one vertex; triangles that vanish are left out."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    triangles = np.concatenate([start + corners for start, (_, corners) in zip(starts, pieces, strict=False)])
    face_index = np.repeat(np.arange(len(pieces)), [len(corners) for _, corners in pieces])
    close = KDTree(vertices).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(close), np.int8), close.T), shape=(len(vertices),) * 2)
    group = connected_components(graph, directed=False)[1]
    first = np.unique(group, return_index=True)[1]
    triangles = group[triangles]
    whole = np.all(triangles != np.roll(triangles, 1, axis=1), axis=1)
    return Body(vertices[first], triangles[whole], face_index[whole], tuple(surfaces), np.array(areas))


def _is_closed(body: Body) -> bool:
    """Whether every side of a triangle is one of another triangle, too."""
    sides = np.sort(body.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool(np.all(np.unique(sides, axis=0, return_counts=True)[1] >= 2))
