"""Random parts in every form of surface that a record can hold, and their comparison."""

import numpy as np
import pytest

from jprimfit.data.records import Cloud, Mesh, Part, Trims
from jprimfit.types import Cone, Cylinder, Plane, Sphere


def _unit(values):
    return values / np.sqrt(np.sum(values * values, axis=-1, keepdims=True))


def _make_part(seed, /, *, forms=("cloud", "mesh", "trims"), points=40, samples=6, dtype=np.float32, **fields):
    draw = np.random.default_rng(seed)
    count = 4 + seed % 3
    primitives = []
    for row in range(count):
        axis, point, size = _unit(draw.normal(size=3)), draw.normal(size=3), draw.uniform(0.1, 1.2)
        upward = axis * np.sign(axis[np.argmax(np.abs(axis))])
        primitives.append(
            (Plane(upward, size), Sphere(point, size), Cylinder(upward, point, size), Cone(axis, point, size))[row % 4]
        )

    def normal(*shape):
        return draw.normal(size=shape).astype(dtype)

    def labels(size):
        return draw.integers(-1, count, size).astype(np.int32)

    patches = normal(count, samples, 3)
    for row, primitive in enumerate(primitives):
        if primitive.kind == "cone":  # samples lie in the nappe that the axis points into
            offsets = patches[row] - primitive.apex[None]
            signs = np.sign(offsets @ primitive.axis)
            patches[row] = (primitive.apex[None] + offsets * signs[:, None]).astype(dtype)
    cloud = Cloud(
        points=normal(points, 3),
        normals=_unit(normal(points, 3)),
        labels=labels(points),
        noisy_points=normal(points, 3),
        samples=patches,
        sample_normals=_unit(normal(count, samples, 3)),
    )
    mesh = Mesh(normal(11, 3), draw.integers(0, 11, (17, 3)).astype(np.int32), labels(17))
    frames = np.linalg.qr(draw.normal(size=(3, 3, 3)))[0]
    frames[0] = np.linalg.qr(np.column_stack([primitives[0].normal, draw.normal(size=(3, 2))]))[0].T[::-1]
    frames[0, 2] = primitives[0].normal
    loop_size = np.array([3, 5, 4], np.int32)
    trims = Trims(
        labels=np.array([0, 1, 1], np.int32),
        frames=frames,
        outward=np.array([1, -1, 1], np.int8),
        loop_face=np.array([0, 0, 2], np.int32),
        loop_size=loop_size,
        corners=draw.normal(size=(int(loop_size.sum()), 2)),
    )
    surfaces = {"cloud": cloud, "mesh": mesh, "trims": trims}
    settings = {
        "primitives": tuple(primitives),
        "name": f"part {seed}",
        "areas": draw.uniform(0.1, 1, count),
        "background_area": 0.25,
        "family": f"family {seed % 5}",
        "split": ("train", "train", "val", "test", "test")[seed % 5],
        "seed": seed,
        "unit": "mm",
        "center": draw.normal(size=3),
        "scale": 17.5,
    }
    return Part(**{form: surfaces[form] for form in forms}, **settings | fields)


def _assert_equal(left, right, path=""):
    assert type(left) is type(right) or np.isscalar(left) or isinstance(left, np.ndarray), path
    if isinstance(left, tuple):
        names = getattr(left, "_fields", range(len(left)))
        for name, a, b in zip(names, left, right, strict=True):
            _assert_equal(a, b, f"{path}.{name}")
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype, path
        np.testing.assert_array_equal(left, right, err_msg=path)
    else:
        assert left == right, path


@pytest.fixture(scope="session")
def make_part():
    """make_part(seed, forms=..., points=..., samples=..., dtype=..., **fields of Part) -> Part."""
    return _make_part


@pytest.fixture(scope="session")
def assert_equal():
    """Compares two records field by field, with dtypes."""
    return _assert_equal
