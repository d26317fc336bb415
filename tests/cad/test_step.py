import numpy as np
import pytest

from jprimfit.cad import patches, step
from jprimfit.types import Cone, Cylinder, Plane, Sphere

needs_occt = pytest.mark.skipif(not step.available(), reason="needs the [cad] extra")

AXIS = np.array([1.0, 2.0, 2.0]) / 3
ACROSS = np.array([[2.0, 1.0, -2.0], [-2.0, 2.0, -1.0]]) / 3  # with AXIS a right-handed frame
CENTER = np.array([3.0, -1.0, 2.0])
HALF_ANGLE = 0.45


def turned(x, y, z):
    return CENTER + np.stack([x, y], axis=1) @ ACROSS + z[:, None] * AXIS


def parts():
    """name: primitive, points, true area."""
    rng = np.random.default_rng(0)
    n = 4_000
    u, v, angle = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    solid = np.hypot(u - 0.2, v) > 0.3
    slant = np.sqrt(rng.uniform(1, 9, n))
    tip = 3 * np.sqrt(rng.uniform(0, 1, n))
    sine, cosine = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
    plane = Plane(AXIS, CENTER @ AXIS)
    cylinder = Cylinder(AXIS, CENTER, np.float64(0.7))
    cone = Cone(AXIS, CENTER, np.float64(HALF_ANGLE))
    sphere = Sphere(CENTER, np.float64(1.2))

    def on_sphere(height, turn):
        ring = np.sqrt(1 - height**2)
        return turned(1.2 * ring * np.cos(turn), 1.2 * ring * np.sin(turn), 1.2 * height)

    return {
        "plate": (plane, turned(u[solid], v[solid], 0 * u[solid]), 4 - np.pi * 0.09),
        "tube": (cylinder, turned(0.7 * np.cos(angle), 0.7 * np.sin(angle), u), 2.8 * np.pi),
        "fillet": (cylinder, turned(0.7 * np.cos(angle / 5), 0.7 * np.sin(angle / 5), u), 0.56 * np.pi),
        "frustum": (
            cone,
            turned(slant * sine * np.cos(angle), slant * sine * np.sin(angle), slant * cosine),
            8 * np.pi * sine,
        ),
        "tip": (cone, turned(tip * sine * np.cos(angle), tip * sine * np.sin(angle), tip * cosine), 9 * np.pi * sine),
        "ball": (sphere, on_sphere(u, angle), 4 * np.pi * 1.44),
        "cap": (sphere, on_sphere(0.75 + u / 4, angle), np.pi * 1.44),
        "belt": (sphere, on_sphere(u / 4, angle), np.pi * 1.44),
    }


def read_back(path):
    """[(kind, parameters, area)] of the faces in the file."""
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.BRepGProp import BRepGProp
    from OCP.GeomAbs import GeomAbs_SurfaceType
    from OCP.GProp import GProp_GProps
    from OCP.STEPControl import STEPControl_Reader
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    with step.quiet():
        reader = STEPControl_Reader()
        reader.ReadFile(str(path))
        reader.TransferRoots()
    explorer = TopExp_Explorer(reader.OneShape(), TopAbs_ShapeEnum.TopAbs_FACE)
    faces = []
    while explorer.More():
        face = TopoDS.Face(explorer.Current())
        surface, properties = BRepAdaptor_Surface(face), GProp_GProps()
        BRepGProp.SurfaceProperties_s(face, properties)
        match surface.GetType():
            case GeomAbs_SurfaceType.GeomAbs_Plane:
                faces.append(("plane", surface.Plane(), properties.Mass()))
            case GeomAbs_SurfaceType.GeomAbs_Cylinder:
                faces.append(("cylinder", surface.Cylinder(), properties.Mass()))
            case GeomAbs_SurfaceType.GeomAbs_Cone:
                faces.append(("cone", surface.Cone(), properties.Mass()))
            case GeomAbs_SurfaceType.GeomAbs_Sphere:
                faces.append(("sphere", surface.Sphere(), properties.Mass()))
        explorer.Next()
    return faces


def xyz(thing):
    return np.array([thing.X(), thing.Y(), thing.Z()])


def check_parameters(primitive, surface):
    if primitive.kind == "sphere":
        np.testing.assert_allclose(xyz(surface.Location()), CENTER, atol=1e-6)
        assert surface.Radius() == pytest.approx(1.2, abs=1e-6)
        return
    axis = xyz(surface.Axis().Direction())
    assert abs(abs(axis @ AXIS) - 1) < 1e-12
    if primitive.kind == "plane":
        assert xyz(surface.Location()) @ AXIS == pytest.approx(CENTER @ AXIS, abs=1e-6)
    elif primitive.kind == "cylinder":
        assert np.linalg.norm(np.cross(xyz(surface.Location()) - CENTER, AXIS)) < 1e-6
        assert surface.Radius() == pytest.approx(0.7, abs=1e-6)
    else:
        np.testing.assert_allclose(xyz(surface.Apex()), CENTER, atol=1e-6)
        assert abs(surface.SemiAngle()) == pytest.approx(HALF_ANGLE, abs=1e-6)


@needs_occt
def test_a_file_read_back_holds_the_same_surfaces_and_areas(tmp_path, capfd):
    named = parts()
    primitives = [part[0] for part in named.values()]
    patch_list = [patches.patch(primitive, points) for primitive, points, _ in named.values()]
    path = tmp_path / "surfaces.step"
    assert step.write_step(path, primitives, patch_list) == []
    assert capfd.readouterr().out == ""
    faces = read_back(path)
    assert [kind for kind, _, _ in faces] == [primitive.kind for primitive in primitives]
    for (kind, surface, area), (name, (primitive, _, true_area)) in zip(faces, named.items(), strict=True):
        check_parameters(primitive, surface)
        assert abs(area / true_area - 1) < 0.03, (name, kind, area, true_area)
    text = path.read_text()
    assert "'cylinder 1'" in text and text.rstrip().endswith("END-ISO-10303-21;")
    assert [file.name for file in tmp_path.iterdir()] == ["surfaces.step"]
    # The hole of the plate is a circle of radius 0.3.
    radii = [float(line.rsplit(",", 1)[1].rstrip(");")) for line in text.splitlines() if "= CIRCLE(" in line]
    assert min(abs(radius - 0.3) for radius in radii) < 0.02


@needs_occt
def test_separate_pieces_become_faces_and_hopeless_ones_are_reported(tmp_path):
    rng = np.random.default_rng(1)
    flat = np.concatenate([rng.uniform(0, 1, (1_000, 2)), rng.uniform(0, 1, (1_000, 2)) + np.array([[2.0, 0]])])
    plane = Plane(np.array([0.0, 0, 1]), np.float64(0))
    pair = patches.patch(plane, np.c_[flat, np.zeros(len(flat))])
    nothing = patches.patch(plane, np.zeros((0, 3)))
    broken = patches.Patch(pair.vertices * np.nan, pair.faces, pair.normals)
    path = tmp_path / "a.step"
    assert step.write_step(path, [plane, plane, plane], [nothing, pair, broken]) == [0, 2]
    areas = [area for _, _, area in read_back(path)]
    assert len(areas) == 2 and all(abs(area - 1) < 0.05 for area in areas)
    assert step.write_step(tmp_path / "b.step", [plane], [nothing]) == [0]
    assert not (tmp_path / "b.step").exists()


@needs_occt
def test_a_file_that_cannot_be_written_is_one_sentence(tmp_path):
    primitive, points, _ = parts()["plate"]
    with pytest.raises(ValueError, match="could not write"):
        step.write_step(tmp_path / "missing" / "a.step", [primitive], [patches.patch(primitive, points)])
    with pytest.raises(ValueError, match="one patch for each"):
        step.write_step(tmp_path / "a.step", [primitive], [])
    assert list(tmp_path.iterdir()) == []


def test_without_opencascade_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(step, "available", lambda: False)
    with pytest.raises(ValueError, match=r"jprimfit\[cad\]"):
        step.write_step(tmp_path / "a.step", [], [])
