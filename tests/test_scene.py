"""Scene: what it counts, that it survives its files exactly, and that damaged files are one sentence."""

import json
from pathlib import Path

import numpy as np
import pytest

import jprimfit
from jprimfit.scene import Scene
from jprimfit.types import Cone, Cylinder, Plane, Sphere

RANDOM = np.random.default_rng(0)
THIRD = np.ones(3) / np.sqrt(3)


def _scene(num_points=40):
    primitives = (
        Plane(THIRD, np.float64(1 / 3)),
        Sphere(RANDOM.normal(size=3) + 1e6, np.float64(2.5)),
        Cylinder(THIRD, RANDOM.normal(size=3), np.float64(1e-6)),
        Cone(-THIRD, RANDOM.normal(size=3), np.float64(0.3)),
        Plane(THIRD, np.float64(1 / 3)),
    )
    labels = RANDOM.integers(-1, 4, num_points).astype(np.int32)
    points = RANDOM.normal(size=(num_points, 3))
    points[labels == -1][:1] = np.nan
    distances = np.where(labels >= 0, np.abs(RANDOM.normal(size=num_points)), np.nan)
    return Scene(
        points=points,
        labels=labels,
        primitives=primitives,
        surface_of=np.array([0, 1, 2, 3, 0], np.int32),
        normals=np.tile(THIRD, (num_points, 1)),
        distances=distances,
        noise=0.125,
        report={
            "removed": np.int32(3),
            "steps": {"filter": np.float32(0.5)},
            "flags": (True, None),
            "nan": float("nan"),
        },
    )


def test_a_saved_scene_comes_back_exactly(tmp_path):
    scene = _scene()
    scene.save(tmp_path / "scene.json")
    again = Scene.load(tmp_path / "scene.json")
    for name in ("points", "labels", "normals", "distances", "surface_of"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
        assert getattr(again, name).dtype == getattr(scene, name).dtype
    for a, b in zip(again.primitives, scene.primitives, strict=True):
        assert a.kind == b.kind and type(a) is type(b)
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
            assert np.asarray(x).dtype == np.float64
    assert again.noise == 0.125
    assert again.report == {"removed": 3, "steps": {"filter": 0.5}, "flags": [True, None], "nan": None}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.json", "scene.npz"]


def test_an_empty_scene_and_unknown_noise_survive(tmp_path):
    none = np.zeros((0, 3))
    scene = Scene(none, np.zeros(0, np.int32), (), np.zeros(0, np.int32), none, np.zeros(0))
    scene.save(tmp_path / "scene.json")
    again = Scene.load(str(tmp_path / "scene.json"))
    assert again.primitives == () and np.isnan(again.noise) and again.surface_of.shape == (0,)
    assert scene.extent() == 0 and scene.table() == "no primitives found"


def test_saving_twice_gives_the_same_bytes(tmp_path):
    scene = _scene()
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        scene.save(tmp_path / name / "scene.json")
    for name in ("scene.json", "scene.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_counts_and_distances_are_those_of_the_labels():
    scene = _scene()
    for i in range(5):
        mine = scene.labels == i
        assert scene.counts()[i] == mine.sum()
        expected = np.sqrt(np.mean(scene.distances[mine] ** 2)) if mine.any() else np.nan
        np.testing.assert_allclose(scene.rms_distances()[i], expected)
    assert scene.names() == ("plane_0", "sphere_1", "cylinder_2", "cone_3", "plane_4")


def test_the_table_has_a_line_per_primitive_and_degrees():
    lines = _scene().table().splitlines()
    assert lines[0].split()[:4] == ["#", "kind", "points", "size"] and "* 4 plane: on the surface of #0" in lines[-1]
    assert lines[5].split()[:2] == ["3*", "cone"] and "17.19 +-" in lines[5]


def test_signed_distances_are_positive_outside_and_on_the_side_of_the_normal():
    scene = _scene()
    signed = scene.signed_distances
    np.testing.assert_array_equal(np.isnan(signed), scene.labels == -1)
    sphere, plane = scene.labels == 1, scene.labels == 0
    expected = np.linalg.norm(scene.points[sphere] - scene.primitives[1].center, axis=1) - 2.5
    np.testing.assert_allclose(signed[sphere], expected, rtol=1e-9)
    np.testing.assert_allclose(signed[plane], scene.points[plane] @ THIRD - 1 / 3, atol=1e-12)


def test_a_scene_without_features_is_read_as_before(tmp_path):
    scene = _scene()
    scene.save(tmp_path / "scene.json")
    document = json.loads((tmp_path / "scene.json").read_text())
    assert all(entry.pop("feature")["area"] >= 0 for entry in document["primitives"])
    (tmp_path / "scene.json").write_text(json.dumps(document))
    again = Scene.load(tmp_path / "scene.json")
    assert [f.num_points for f in again.features] == scene.counts().tolist()
    np.testing.assert_array_equal(again.features[0].position, scene.features[0].position)


def test_renamed_files_and_other_names_are_found(tmp_path):
    scene = _scene()
    scene.save(tmp_path / "scene.json")
    (tmp_path / "scene.json").rename(tmp_path / "part.json")
    (tmp_path / "scene.npz").rename(tmp_path / "part.npz")
    np.testing.assert_array_equal(Scene.load(tmp_path / "part.json").points, scene.points)
    with pytest.raises(ValueError, match="give a name that ends in .json"):
        scene.save(tmp_path / "scene.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=2), "is a scene of version 2, this jprimfit reads version 1"),
        (lambda d: d.pop("version"), "version None"),
        (lambda d: d.update(format="other"), "is JSON but no jprimfit scene"),
        (lambda d: d.pop("primitives"), r"damaged jprimfit scene \(missing 'primitives'\)"),
        (lambda d: d["primitives"][0].update(kind="torus"), "a primitive of kind 'torus'"),
        (lambda d: d["primitives"][0].pop("normal"), "missing 'normal'"),
        (lambda d: d["primitives"][0].update(normal=[1, 2]), r"normal of a plane has shape \(2,\)"),
        (lambda d: d["primitives"][1].update(radius="large"), "damaged"),
        (lambda d: d.update(primitives=d["primitives"][:2]), "a label is outside -1 to 1"),
        (lambda d: d.update(arrays=None), "does not belong to scene.json or is damaged"),
        (lambda d: d["arrays"].update(file="../../etc/passwd.npz", sha256="0"), "does not belong"),
    ],
)
def test_altered_documents_are_one_sentence(tmp_path, change, message):
    _scene().save(tmp_path / "scene.json")
    document = json.loads((tmp_path / "scene.json").read_text())
    change(document)
    (tmp_path / "scene.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match=message) as caught:
        Scene.load(tmp_path / "scene.json")
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b"null"])
def test_foreign_bytes_are_one_sentence(tmp_path, data):
    (tmp_path / "scene.json").write_bytes(data)
    with pytest.raises(ValueError, match="give the scene.json that jprimfit fit wrote"):
        Scene.load(tmp_path / "scene.json")


def test_missing_and_exchanged_files_are_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        Scene.load(tmp_path / "scene.json")
    with pytest.raises(ValueError, match="is a folder"):
        Scene.load(tmp_path)
    _scene().save(tmp_path / "scene.json")
    _scene(num_points=5).save(tmp_path / "other.json")
    (tmp_path / "other.npz").replace(tmp_path / "scene.npz")
    with pytest.raises(ValueError, match="does not belong to scene.json"):
        Scene.load(tmp_path / "scene.json")
    (tmp_path / "scene.npz").unlink()
    with pytest.raises(ValueError, match="has lost its arrays, scene.npz: put that file beside it"):
        Scene.load(tmp_path / "scene.json")


def test_a_failed_save_leaves_the_old_scene(tmp_path, monkeypatch):
    old = _scene()
    old.save(tmp_path / "scene.json")
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        _scene().save(tmp_path / "scene.json")
    monkeypatch.undo()
    np.testing.assert_array_equal(Scene.load(tmp_path / "scene.json").points, old.points)
    assert len(list(tmp_path.iterdir())) == 2


def _conforms(value, schema, root):
    """The few words of JSON Schema that scene.schema.json uses."""
    if "$ref" in schema:
        return _conforms(value, root["$defs"][schema["$ref"].split("/")[-1]], root)
    if "oneOf" in schema:
        return sum(_conforms(value, option, root) for option in schema["oneOf"]) == 1
    if "const" in schema:
        return value == schema["const"]
    types = {
        "object": dict,
        "array": list,
        "boolean": bool,
        "string": str,
        "integer": int,
        "number": int | float,
        "null": type(None),
    }
    wanted = schema.get("type", list(types))
    wanted = wanted if isinstance(wanted, list) else [wanted]
    if isinstance(value, bool):
        return "boolean" in wanted
    if not any(isinstance(value, types[name]) for name in wanted):
        return False
    if isinstance(value, dict):
        properties = schema.get("properties", {})
        known = set(schema.get("required", ())) <= set(value)
        closed = schema.get("additionalProperties", True) or set(value) <= set(properties)
        return known and closed and all(_conforms(value[k], s, root) for k, s in properties.items() if k in value)
    if isinstance(value, list):
        fits = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        return fits and all(_conforms(item, schema.get("items", {}), root) for item in value)
    return not isinstance(value, int | float) or schema.get("minimum", value) <= value


def test_the_document_follows_its_published_schema(tmp_path):
    schema = json.loads((Path(jprimfit.__file__).parent / "assets" / "scene.schema.json").read_text())
    _scene().save(tmp_path / "scene.json")
    document = json.loads((tmp_path / "scene.json").read_text())
    assert _conforms(document, schema, schema)
    for change in (
        {"version": 2},
        {"noise": "small"},
        {"primitives": [{"kind": "torus"}]},
        {"arrays": {}},
        {"num_points": -1},
    ):
        assert not _conforms({**document, **change}, schema, schema), change
    plane = document["primitives"][0]
    assert not _conforms({**document, "primitives": [{**plane, "normal": [1, 2]}]}, schema, schema)


def test_the_example_in_the_documentation_follows_the_schema_too():
    root = Path(jprimfit.__file__).parent
    schema = json.loads((root / "assets" / "scene.schema.json").read_text())
    text = (root.parent / "docs" / "scene.md").read_text()
    assert _conforms(json.loads(text.split("```json")[1].split("```")[0]), schema, schema)
