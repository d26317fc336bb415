"""From STEP to parts: halves of one surface merge, other surfaces are background, areas and drawn points are exact."""

import numpy as np
import pytest

from jprimfit.cad import step, step_reader
from jprimfit.data import from_step, records, surfaces

pytest.importorskip("OCP")
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepPrimAPI import (
    BRepPrimAPI_MakeBox,
    BRepPrimAPI_MakeCone,
    BRepPrimAPI_MakeCylinder,
    BRepPrimAPI_MakeSphere,
    BRepPrimAPI_MakeTorus,
)
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt
from OCP.Interface import Interface_Static
from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer


@pytest.fixture
def found(tmp_path):
    """found(shape, ...) -> the parts of a STEP file of an OpenCASCADE shape."""

    def found(*shapes, unit="MM", min_share=0.0, name="part"):
        with step.quiet():
            writer = STEPControl_Writer()
            Interface_Static.SetCVal_s("write.step.unit", unit)
            for shape in shapes:
                writer.Transfer(shape, STEPControl_StepModelType.STEPControl_AsIs)
            writer.Write(str(tmp_path / "part.step"))
            Interface_Static.SetCVal_s("write.step.unit", "MM")
        contents = step_reader.read_step(tmp_path / "part.step")
        return from_step.parts(contents, source="part.step", min_share=min_share, name=name, family="f", split="test")

    return found


def cylinder(radius, height, *, low=0.0, turn=2 * np.pi):
    return BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(0, 0, low), gp_Dir(0, 0, 1)), radius, height, turn).Shape()


def kinds(part):
    return sorted(primitive.kind for primitive in part.primitives)


def check_clean(part):
    """Drawn points lie on their primitives with their normals; the exact areas are near those of the triangles."""
    records.check(part, source="test")
    cloud = surfaces.draw(part, num_points=3000, seed=0)
    rows = cloud.labels >= 0
    foot = surfaces.project(records.pack(part.primitives), cloud.labels[rows], cloud.points[rows])
    diagonal = np.sqrt(np.sum(np.ptp(part.mesh.vertices, axis=0) ** 2))
    assert np.abs(foot.points - cloud.points[rows]).max() < 1e-6 * diagonal
    assert np.abs(np.sum(foot.normals * cloud.normals[rows], axis=1)).min() > np.cos(np.radians(0.01))
    np.testing.assert_allclose(np.ptp(part.mesh.vertices, axis=0).max(), 2, rtol=1e-6)


def test_a_drilled_block_in_its_frame_and_unit(found):
    block = BRepPrimAPI_MakeBox(gp_Pnt(10, 0, 0), gp_Pnt(14, 2, 1)).Shape()
    hole = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(12, 1, -1), gp_Dir(0, 0, 1)), 0.5, 9).Shape()
    parts, notes = found(BRepAlgoAPI_Cut(block, hole).Shape(), unit="INCH", min_share=0.005)
    assert notes == () and len(parts) == 1
    (part,) = parts
    check_clean(part)
    assert kinds(part) == ["cylinder"] + ["plane"] * 6
    assert (part.name, part.family, part.split, part.unit) == ("part", "f", "test", "in")
    disc, size = np.pi / 4, part.scale * 25.4  # the block is given in mm and written in inches
    assert part.areas * size**2 == pytest.approx([8 - disc, 8 - disc, 4, 4, np.pi, 2, 2], rel=1e-6)
    assert size == pytest.approx(2, rel=1e-6) and part.center * 25.4 == pytest.approx([12, 1, 0.5], abs=1e-6)
    hole = part.primitives[4]
    assert hole.axis == pytest.approx([0, 0, 1]) and hole.center == pytest.approx([0, 0, 0], abs=1e-6)
    assert hole.radius * size == pytest.approx(0.5, rel=1e-6)


def test_halves_of_a_cylinder_are_one_instance(found):
    halves = BRepAlgoAPI_Cut(
        cylinder(3.0, 10.0), BRepPrimAPI_MakeBox(gp_Pnt(-4, -4, -1), gp_Pnt(4, 0, 11)).Shape()
    ).Shape()
    other = BRepAlgoAPI_Cut(
        cylinder(3.0, 10.0), BRepPrimAPI_MakeBox(gp_Pnt(-4, 0, -1), gp_Pnt(4, 4, 11)).Shape()
    ).Shape()
    both = BRepAlgoAPI_Fuse(halves, other).Shape()
    whole = found(both).parts[0]
    check_clean(whole)
    assert kinds(whole) == ["cylinder", "plane", "plane"]
    assert whole.areas * whole.scale**2 == pytest.approx([60 * np.pi, 9 * np.pi, 9 * np.pi], rel=1e-9)
    apart = BRepAlgoAPI_Cut(cylinder(3.0, 10.0), BRepPrimAPI_MakeBox(gp_Pnt(-4, -4, 4), gp_Pnt(4, 4, 6)).Shape())
    assert [kinds(part) for part in found(apart.Shape()).parts] == [["cylinder", "plane", "plane"]] * 2


def test_cone_sphere_and_background(found):
    cone = BRepPrimAPI_MakeCone(3.0, 1.0, 4.0).Shape()
    (part,) = found(cone).parts
    check_clean(part)
    assert kinds(part) == ["cone", "plane", "plane"]
    frustum = next(primitive for primitive in part.primitives if primitive.kind == "cone")
    assert frustum.axis == pytest.approx([0, 0, -1], abs=1e-12) and np.tan(frustum.half_angle) == pytest.approx(0.5)
    assert frustum.apex * part.scale + part.center == pytest.approx([0, 0, 6], abs=1e-9)
    (ball,) = found(BRepPrimAPI_MakeSphere(2.0).Shape()).parts
    check_clean(ball)
    assert kinds(ball) == ["sphere"] and ball.areas * ball.scale**2 == pytest.approx([16 * np.pi], rel=1e-9)
    ring = BRepAlgoAPI_Fuse(BRepPrimAPI_MakeTorus(10.0, 2.0).Shape(), cylinder(9.0, 0.5)).Shape()
    (part,) = found(ring).parts
    check_clean(part)
    share = part.background_area / (part.background_area + np.sum(part.areas))
    assert kinds(part) == ["plane", "plane"] and 0.4 < share < 0.8
    assert np.any(part.mesh.labels == records.BACKGROUND)


def test_small_faces_are_background(found):
    plate = BRepAlgoAPI_Cut(BRepPrimAPI_MakeBox(20.0, 20.0, 2.0).Shape(), cylinder(0.3, 5.0)).Shape()
    assert len(found(plate).parts[0].primitives) == 7
    (part,) = found(plate, min_share=0.005).parts
    assert len(part.primitives) == 6
    assert part.background_area * part.scale**2 == pytest.approx(0.5 * np.pi * 0.3 * 2, rel=1e-9)


def test_solids_are_numbered_and_what_is_left_out_is_told(found):
    torus = BRepPrimAPI_MakeTorus(10.0, 2.0).Shape()
    parts, notes = found(BRepPrimAPI_MakeBox(1.0, 2.0, 3.0).Shape(), torus, cylinder(1.0, 5.0), min_share=0.02)
    assert [part.name for part in parts] == ["part_1", "part_3"]
    assert len(notes) == 1 and notes[0].startswith("part.step: solid 2 is left out") and notes[0].endswith(".")
    with pytest.raises(ValueError, match=r"part\.step cannot be used: no plane, sphere, cylinder or cone has 2 %"):
        found(torus, min_share=0.02)
