"""ParSeNet's and HPNet's files become clouds with labels and fitted primitives; other kinds are background."""

import h5py
import numpy as np
import pytest

from jprimfit.data import parsenet
from jprimfit.data.solids import signed_distance

CENTER, SIZE = np.array([5.0, -2.0, 1.0]), 3.0


def _shape(seed, dtype=np.float32):
    """Points of six segments: plane, cylinder, cone, sphere, open B-spline and a speck; in a frame of their own."""
    draw = np.random.default_rng(seed)
    count = 400
    u, angle = draw.uniform(-1, 1, count), draw.uniform(0, 2 * np.pi, count)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * u], axis=1)
    up = np.array([0.0, 0, 1])
    ball = np.sqrt(1 - u**2)[:, None] * around + u[:, None] * up
    plane = np.stack([u, draw.uniform(-1, 1, count), 0 * u - 1], axis=1)
    bent = np.stack([u, u**3, draw.uniform(-1, 1, count)], axis=1)
    segments = [  # label, prim, points, normals
        (7, 1, plane, np.tile(up, (count, 1))),
        (3, 4, 0.4 * around + u[:, None] * up, around),
        (0, 3, (u + 1.5)[:, None] * (0.5 * around + up), (around - 0.5 * up) / np.sqrt(1.25)),
        (12, 5, [1, 1, 1] + 0.6 * ball, ball),
        (5, 2, bent, np.stack([-3 * u**2, 1 + 0 * u, 0 * u], axis=1)),
        (9, 1, plane[:10] + 0.3, np.tile(up, (10, 1))),
    ]
    labels = np.concatenate([np.full(len(points), label) for label, _, points, _ in segments])
    prim = np.concatenate([np.full(len(points), kind) for _, kind, points, _ in segments])
    points = CENTER + SIZE * np.concatenate([points for _, _, points, _ in segments])
    normals = np.concatenate([normals for *_, normals in segments])
    normals /= np.sqrt(np.sum(normals**2, axis=1, keepdims=True))
    order = draw.permutation(len(points))
    return points[order].astype(dtype), normals[order].astype(dtype), labels[order], prim[order]


def _write(path, shapes, **replaced):
    arrays = [np.stack(values) if len(shapes) > 1 else values[0] for values in zip(*shapes, strict=True)]
    with h5py.File(path, "w") as file:
        for name, values in zip(("points", "normals", "labels", "prim"), arrays, strict=True):
            file[name] = replaced.get(name, values)
        if len(shapes) == 1:
            file["T_param"] = np.zeros((len(arrays[0]), 22), np.float32)


def _check(part, shape):
    points, normals, labels, _ = shape
    assert [primitive.kind for primitive in part.primitives] == ["cone", "cylinder", "plane", "sphere"]
    expected = np.full(len(points), -1)
    for number, label in enumerate((0, 3, 7, 12)):
        expected[labels == label] = number
    np.testing.assert_array_equal(part.cloud.labels, expected)
    np.testing.assert_allclose(part.center + part.scale * part.cloud.points, points, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(part.cloud.normals, normals, atol=1e-6)
    for number, primitive in enumerate(part.primitives):
        distance, _ = signed_distance(primitive, part.cloud.points[expected == number].astype(np.float64))
        assert np.abs(distance).max() < 1e-6
    cone, cylinder, plane, sphere = part.primitives
    size = part.scale / SIZE
    assert cone.axis == pytest.approx([0, 0, 1], abs=1e-5) and np.tan(cone.half_angle) == pytest.approx(0.5, abs=1e-5)
    assert cylinder.radius * size == pytest.approx(0.4, abs=1e-5) and abs(cylinder.axis[2]) == pytest.approx(1)
    assert plane.normal == pytest.approx([0, 0, 1], abs=1e-5)
    assert sphere.radius * size == pytest.approx(0.6, abs=1e-5)
    assert part.scale * sphere.center + part.center == pytest.approx(CENTER + SIZE, abs=1e-4)


def test_many_shapes_in_one_file(tmp_path):
    shapes = [_shape(seed) for seed in range(3)]
    _write(tmp_path / "val_data.h5", shapes)
    with parsenet.Shapes(tmp_path / "val_data.h5") as found:
        assert len(found) == 3
        for row, shape in enumerate(shapes):
            part = found.read(row, min_share=0.01)
            assert part.name == f"val_data_{row:05d}" and part.cloud.points.dtype == np.float32
            _check(part, shape)


def test_one_shape_per_file_with_labels_as_floats(tmp_path):
    points, normals, labels, prim = shape = _shape(4, np.float64)
    _write(tmp_path / "00012.h5", [(points, normals, labels.astype(np.float32), prim.astype(np.float64))])
    with parsenet.Shapes(tmp_path / "00012.h5") as found:
        assert len(found) == 1
        part = found.read(0, min_share=0.01)
    assert part.name == "00012" and part.cloud.points.dtype == np.float64
    _check(part, shape)


def test_segments_that_their_kind_does_not_describe_are_background(tmp_path):
    points, normals, labels, prim = _shape(5)
    prim = np.where(labels == 12, 1, prim)  # a ball that is called a plane
    labels = np.where(labels == 3, -1, labels)
    _write(tmp_path / "a.h5", [(points, normals, labels, prim)])
    with parsenet.Shapes(tmp_path / "a.h5") as found:
        part = found.read(0, min_share=0.01)
    assert [primitive.kind for primitive in part.primitives] == ["cone", "plane"]
    assert np.all(part.cloud.labels[(labels == 12) | (labels == -1)] == -1)


POINTS, NORMALS, LABELS, PRIM = _shape(6)
HOSTILE = {
    "NaN": ({"points": np.where(LABELS[:, None] == 3, np.nan, POINTS)}, "hold NaN"),
    "zero normal": ({"normals": 0 * NORMALS}, "a normal is zero"),
    "half labels": ({"labels": LABELS + 0.5}, "no whole numbers"),
    "huge labels": ({"labels": LABELS + 1e30}, "no whole numbers"),
    "texts": ({"prim": PRIM.astype("S4")}, "no whole numbers"),
    "few labels": ({"labels": LABELS[1:]}, "labels has shape"),
    "columns": ({"points": POINTS[:, :2]}, "points has shape"),
    "flat": ({"points": POINTS[:, 0]}, "points has shape"),
    "integers": ({"points": POINTS.astype(int)}, "has numbers of type int64"),
    "nothing": ({"points": POINTS[:0]}, "points has shape"),
    "no kind": ({"prim": PRIM * 0}, "no segment on a plane"),
}


@pytest.mark.parametrize(("replaced", "words"), HOSTILE.values(), ids=HOSTILE.keys())
def test_what_is_wrong_is_one_sentence(tmp_path, replaced, words):
    path = tmp_path / "a.h5"
    _write(path, [(POINTS, NORMALS, LABELS, PRIM)], **replaced)
    with pytest.raises(ValueError, match=words) as caught, parsenet.Shapes(path) as found:
        found.read(0, min_share=0.01)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
