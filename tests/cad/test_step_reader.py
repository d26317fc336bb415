"""What is read from STEP is exact: kinds, parameters and areas of faces, whole triangulations within the chord."""

import numpy as np
import pytest

from jprimfit.cad import charts, patches, step, step_reader
from jprimfit.types import Cone, Cylinder, Plane, Sphere

CENTER = np.array([3.0, -1.0, 2.0])
AXIS = np.array([1.0, 2.0, 2.0]) / 3


@pytest.fixture
def write(tmp_path):
    """write(shape, unit="MM") -> path of a STEP file of an OpenCASCADE shape."""
    pytest.importorskip("OCP")
    from OCP.Interface import Interface_Static
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer

    def write(shape, *, unit="MM", name="part.step"):
        with step.quiet():
            writer = STEPControl_Writer()
            Interface_Static.SetCVal_s("write.step.unit", unit)
            writer.Transfer(shape, STEPControl_StepModelType.STEPControl_AsIs)
            writer.Write(str(tmp_path / name))
            Interface_Static.SetCVal_s("write.step.unit", "MM")
        return tmp_path / name

    return write


def placed():
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    return gp_Ax2(gp_Pnt(*CENTER.tolist()), gp_Dir(*AXIS.tolist()))


def only_body(path, *, closed=True):
    contents = step_reader.read_step(path)
    assert len(contents.bodies) == 1 and (contents.num_loose, contents.num_open) == (0, not closed)
    return contents.bodies[0]


def check_body(body, *, closed=True):
    """Closed, turned outwards, and within the chord of every surface; middles of triangles are farthest away."""
    corners = body.vertices[body.triangles]
    if closed:
        sides = np.sort(body.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert np.all(np.unique(sides, axis=0, return_counts=True)[1] == 2)
        assert np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) > 0
    diagonal = np.sqrt(np.sum(np.ptp(body.vertices, axis=0) ** 2))
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.bincount(body.face_index, weights=np.sqrt(np.sum(doubled**2, axis=1)) / 2)
    for row, surface in enumerate(body.surfaces):
        mine = corners[body.face_index == row]
        if surface is not None:
            for points, limit in ((mine.reshape(-1, 3), 1e-7), (mine.mean(axis=1), step_reader.CHORD)):
                gap = np.sqrt(np.sum((points - charts.feet(surface, points)) ** 2, axis=1))
                assert gap.max() <= limit * diagonal
        assert flat[row] == pytest.approx(body.areas[row], rel=2e-3)


def kinds(body):
    return [None if surface is None else surface.kind for surface in body.surfaces]


def test_a_box(write):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox

    body = only_body(write(BRepPrimAPI_MakeBox(10.0, 20.0, 30.0).Shape()))
    check_body(body)
    assert kinds(body) == ["plane"] * 6 and len(body.vertices) == 8 and len(body.triangles) == 12
    assert sorted(body.areas) == pytest.approx([200, 200, 300, 300, 600, 600], rel=1e-12)
    found = {tuple(np.round(np.abs(plane.normal) * plane.offset * np.sum(plane.normal), 9)) for plane in body.surfaces}
    assert found == {(0, 0, 0), (10, 0, 0), (0, 20, 0), (0, 0, 30)}


def test_a_cylinder(write):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder

    body = only_body(write(BRepPrimAPI_MakeCylinder(placed(), 3.0, 10.0).Shape()))
    check_body(body)
    assert sorted(kinds(body)) == ["cylinder", "plane", "plane"]
    row = kinds(body).index("cylinder")
    tube = body.surfaces[row]
    assert abs(tube.axis @ AXIS) == pytest.approx(1, abs=1e-12) and tube.radius == pytest.approx(3, rel=1e-12)
    assert np.cross(tube.center - CENTER, AXIS) == pytest.approx(np.zeros(3), abs=1e-9)
    assert body.areas[row] == pytest.approx(60 * np.pi, rel=1e-9)
    assert np.delete(body.areas, row) == pytest.approx([9 * np.pi] * 2, rel=1e-9)


@pytest.mark.parametrize("radii", [(3.0, 1.0), (1.0, 3.0), (3.0, 0.0)])
def test_a_cone_points_into_the_nappe_of_its_face(write, radii):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCone

    low, high = radii
    body = only_body(write(BRepPrimAPI_MakeCone(placed(), low, high, 4.0).Shape()))
    check_body(body)
    row = kinds(body).index("cone")
    cone = body.surfaces[row]
    slope = (low - high) / 4
    assert cone.axis == pytest.approx(-np.sign(slope) * AXIS, abs=1e-12)
    assert cone.half_angle == pytest.approx(np.arctan(abs(slope)), abs=1e-12)
    assert cone.apex == pytest.approx(CENTER + low / slope * AXIS, abs=1e-9)
    assert body.areas[row] == pytest.approx(np.pi * (low + high) * np.hypot(4, low - high), rel=1e-9)


def test_a_ball(write):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeSphere

    body = only_body(write(BRepPrimAPI_MakeSphere(placed(), 2.5).Shape()))
    check_body(body)
    (ball,) = body.surfaces
    assert ball.kind == "sphere" and ball.center == pytest.approx(CENTER, abs=1e-9)
    assert ball.radius == pytest.approx(2.5, rel=1e-12) and body.areas == pytest.approx([25 * np.pi], rel=1e-9)


def test_a_torus_is_none_of_the_four_and_keeps_the_chord(write):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeTorus

    body = only_body(write(BRepPrimAPI_MakeTorus(10.0, 2.0).Shape()))
    check_body(body)
    assert kinds(body) == [None] and body.areas == pytest.approx([80 * np.pi**2], rel=1e-9)
    middle = body.vertices[body.triangles].mean(axis=1)
    from_ring = np.hypot(np.hypot(middle[:, 0], middle[:, 1]) - 10, middle[:, 2])
    diagonal = np.sqrt(24**2 + 24**2 + 4**2)
    assert np.abs(from_ring - 2).max() < step_reader.CHORD * diagonal


def test_a_swept_circle_is_a_cylinder_and_a_swept_line_a_cone(write):
    pytest.importorskip("OCP")
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.Geom import Geom_Circle, Geom_Line, Geom_SurfaceOfLinearExtrusion, Geom_SurfaceOfRevolution
    from OCP.gp import gp_Ax1, gp_Ax2, gp_Dir, gp_Pnt

    up = gp_Dir(0.0, 0.0, 1.0)
    circle = Geom_Circle(gp_Ax2(gp_Pnt(1.0, 2.0, 3.0), up), 4.0)
    line = Geom_Line(gp_Pnt(1.0, 0.0, 0.0), gp_Dir(1.0, 0.0, 1.0))
    swept = {
        "cylinder": (Geom_SurfaceOfLinearExtrusion(circle, up), (0.0, 2 * np.pi, 0.0, 5.0), 40 * np.pi),
        "cone": (
            Geom_SurfaceOfRevolution(line, gp_Ax1(gp_Pnt(0.0, 0.0, 0.0), up)),
            (0.0, 2 * np.pi, 0.0, np.sqrt(2)),
            np.pi * 3 * np.sqrt(2),
        ),
    }
    for kind, (surface, limits, area) in swept.items():
        body = only_body(write(BRepBuilderAPI_MakeFace(surface, *limits, 1e-6).Shape()), closed=False)
        check_body(body, closed=False)
        assert kinds(body) == [kind] and body.areas == pytest.approx([area], rel=1e-9)


def test_a_cone_face_through_the_apex_is_none_of_the_four(write):
    pytest.importorskip("OCP")
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.Geom import Geom_ConicalSurface
    from OCP.gp import gp_Ax3, gp_Dir, gp_Pnt

    surface = Geom_ConicalSurface(gp_Ax3(gp_Pnt(0.0, 0.0, 0.0), gp_Dir(0.0, 0.0, 1.0)), 0.5, 1.0)
    for low, kind in ((-1.5, "cone"), (-5.0, None)):  # the apex lies at -1 / sin(0.5), about -2.1
        body = only_body(write(BRepBuilderAPI_MakeFace(surface, 0.0, 1.0, low, 3.0, 1e-6).Shape()), closed=False)
        assert kinds(body) == [kind]


@pytest.mark.parametrize(("unit", "name", "size"), [("MM", "mm", 1), ("INCH", "in", 25.4), ("M", "m", 1000)])
def test_units_are_those_of_the_file(write, unit, name, size):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox

    contents = step_reader.read_step(write(BRepPrimAPI_MakeBox(10.0, 20.0, 30.0).Shape(), unit=unit))
    assert (contents.unit, contents.millimetres) == (name, size)
    assert np.ptp(contents.bodies[0].vertices, axis=0) == pytest.approx([10, 20, 30], rel=1e-9)


def test_every_solid_counts_once_and_loose_faces_are_counted(write):
    from OCP.BRep import BRep_Builder
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeSphere
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS_Compound

    box, ball = BRepPrimAPI_MakeBox(1.0, 2.0, 3.0).Shape(), BRepPrimAPI_MakeSphere(1.0).Shape()
    move = gp_Trsf()
    move.SetTranslation(gp_Vec(50.0, 0.0, 0.0))
    loose = TopExp_Explorer(BRepPrimAPI_MakeBox(5.0, 5.0, 5.0).Shape(), TopAbs_ShapeEnum.TopAbs_FACE).Current()
    compound, builder = TopoDS_Compound(), BRep_Builder()
    builder.MakeCompound(compound)
    for shape in (box, ball, box.Moved(TopLoc_Location(move)), loose):
        builder.Add(compound, shape)
    contents = step_reader.read_step(write(compound))
    assert [len(body.surfaces) for body in contents.bodies] == [6, 1] and (contents.num_loose, contents.num_open) == (
        1,
        0,
    )


def test_a_solid_without_a_face_is_open(write):
    from OCP.BRep import BRep_Builder
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS_Shell, TopoDS_Solid

    explorer = TopExp_Explorer(BRepPrimAPI_MakeBox(1.0, 2.0, 3.0).Shape(), TopAbs_ShapeEnum.TopAbs_FACE)
    shell, solid, builder = TopoDS_Shell(), TopoDS_Solid(), BRep_Builder()
    builder.MakeShell(shell)
    for _ in range(5):
        builder.Add(shell, explorer.Current())
        explorer.Next()
    shell.Closed(True)
    builder.MakeSolid(solid)
    builder.Add(solid, shell)
    contents = step_reader.read_step(write(solid))
    assert len(contents.bodies) == 1 and len(contents.bodies[0].surfaces) == 5 and contents.num_open == 1


def test_surfaces_that_we_wrote_come_back(tmp_path):
    pytest.importorskip("OCP")
    rng = np.random.default_rng(0)
    u, v, angle = rng.uniform(-1, 1, 3000), rng.uniform(-1, 1, 3000), rng.uniform(0, 2 * np.pi, 3000)
    radial = np.stack([np.cos(angle), np.sin(angle), 0 * u], axis=1)
    given = [
        (Plane(np.array([0.0, 0, 1]), np.float64(2)), np.stack([u, v, 2 + 0 * u], axis=1)),
        (Cylinder(np.array([0.0, 0, 1]), np.zeros(3), np.float64(0.7)), 0.7 * radial + u[:, None] * [0, 0, 1]),
        (Cone(np.array([0.0, 0, 1]), np.zeros(3), np.arctan(0.5)), (u + 2)[:, None] * (0.5 * radial + [0, 0, 1])),
        (
            Sphere(CENTER, np.float64(1.2)),
            CENTER + 1.2 * (np.sqrt(1 - u**2)[:, None] * radial + u[:, None] * [0, 0, 1]),
        ),
    ]
    meshes = [patches.patch(primitive, points) for primitive, points in given]
    assert step.write_step(tmp_path / "a.step", [primitive for primitive, _ in given], meshes) == []
    body = only_body(tmp_path / "a.step", closed=False)
    check_body(body, closed=False)
    assert kinds(body) == ["plane", "cylinder", "cone", "sphere"]
    for (primitive, points), surface in zip(given, body.surfaces, strict=True):
        assert np.abs(points - charts.feet(surface, points)).max() < 1e-9
        if primitive.kind == "cone":
            assert surface.axis @ primitive.axis == pytest.approx(1, abs=1e-12)


def broken():
    return {
        "empty": b"",
        "text": b"Dear Sir,\nthe part is late.\n",
        "header": b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n",
        "bytes": bytes(range(256)) * 40,
    }


@pytest.mark.parametrize("name", broken())
def test_what_is_no_part_is_one_sentence(tmp_path, name, capfd):
    pytest.importorskip("OCP")
    path = tmp_path / "bad.step"
    path.write_bytes(broken()[name])
    with pytest.raises(ValueError, match="cannot be read") as caught:
        step_reader.read_step(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert capfd.readouterr().out == ""


def test_cut_files_give_a_sentence_or_what_is_left(write):
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCone

    path = write(BRepPrimAPI_MakeCone(3.0, 1.0, 4.0).Shape())
    whole = path.read_bytes()
    refused = 0
    for share in (0.2, 0.5, 0.8, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            step_reader.read_step(path)
        except ValueError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)
            refused += 1
    assert refused >= 3


def test_an_absent_file_and_absent_opencascade(tmp_path, monkeypatch):
    pytest.importorskip("OCP")
    with pytest.raises(ValueError, match="does not exist"):
        step_reader.read_step(tmp_path / "no.step")
    monkeypatch.setattr(step, "available", lambda: False)
    with pytest.raises(ValueError, match=r"pip install 'jprimfit\[cad\]'"):
        step_reader.read_step(tmp_path / "no.step")
