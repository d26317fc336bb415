"""Random parts in every form of surface that a record can hold, and their comparison."""

import os
import pickle

import h5py
import numpy as np
import pytest

from jprimfit.data import native
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


def _drilled_block(radius=0.4, height=0.5, /, *, facets=48, background=False, **fields):
    """Planes 0 to 5 (top, bottom, +x, +y, -x, -y) and cylinder 6, its axis z; half of +x may be background."""
    turn = 2 * np.pi * np.arange(facets) / facets
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    square = ring / np.abs(ring).max(axis=1, keepdims=True)
    loops = [np.column_stack([loop, np.full(facets, z)]) for loop in (radius * ring, square) for z in (-height, height)]
    low_hole, high_hole, low_side, high_side = (number * facets + np.arange(facets) for number in range(4))
    side = 2 + np.floor((turn + np.pi / 4 + np.pi / facets) / (np.pi / 2)).astype(int) % 4
    faces, labels = [], []

    def strip(first, second, label):  # quads between two rings
        following = np.roll(first, -1), np.roll(second, -1)
        for corners in ((first, following[0], following[1]), (first, following[1], second)):
            faces.append(np.stack(corners, axis=1))
            labels.append(np.broadcast_to(label, (facets,)))

    strip(high_side, high_hole, 0)
    strip(low_hole, low_side, 1)
    strip(low_side, high_side, np.where((side == 2) & (turn < np.pi) & background, -1, side))
    strip(high_hole, low_hole, 6)
    x, y, z = np.eye(3)
    planes = [Plane(z, height), Plane(z, -height), *(Plane(axis, sign) for sign in (1.0, -1.0) for axis in (x, y))]
    mesh = Mesh(np.concatenate(loops), np.concatenate(faces).astype(np.int32), np.concatenate(labels).astype(np.int32))
    primitives = (*planes, Cylinder(z, np.zeros(3), radius))
    return Part(**{"name": f"block {radius} {height}", "primitives": primitives, "mesh": mesh} | fields)


@pytest.fixture(scope="session")
def drilled_block():
    """drilled_block(radius, half height, facets=..., background=..., **fields of Part) -> Part with a mesh."""
    return _drilled_block


@pytest.fixture(scope="session")
def blocks(tmp_path_factory):
    """A dataset of drilled blocks: five to train on, the second with background, and two to validate with."""
    path = tmp_path_factory.mktemp("blocks") / "blocks.h5"
    sizes = [(0.2 + 0.1 * number, 0.3 + 0.1 * number) for number in range(7)]
    splits = ["train"] * 5 + ["val"] * 2
    native.write(
        path,
        [
            _drilled_block(*size, facets=16, background=number == 1, split=split)
            for number, (size, split) in enumerate(zip(sizes, splits, strict=True))
        ],
    )
    return path


@pytest.fixture(scope="session")
def make_part():
    """make_part(seed, forms=..., points=..., samples=..., dtype=..., **fields of Part) -> Part."""
    return _make_part


def _independent_read(path, most=24):
    """A second reader, after the description of the format alone: what SPFN and CPFN do with a file, and assertions."""
    parameters = {
        "plane": ["location", "axis"],
        "sphere": ["location", "radius"],
        "cylinder": ["location", "axis", "radius"],
        "cone": ["apex", "axis", "semi_angle"],
    }
    with h5py.File(path, "r") as file:
        points, noisy, normals = (file[name][()] for name in ("gt_points", "noisy_points", "gt_normals"))
        labels = file["gt_labels"][()]
        assert points.shape == noisy.shape == normals.shape == (len(labels), 3) and labels.dtype.kind == "i"
        found = {}
        for name in file:
            if "_soup_" in name:
                stem, number = name.rsplit("_soup_", 1)
                assert (
                    stem == os.path.splitext(os.path.basename(path))[0]
                    and number.isdigit()
                    and int(number) not in found
                )
                group = file[name]
                assert group["gt_points"].shape == group["gt_normals"].shape == (512, 3)
                raw = group.attrs["meta"]
                assert isinstance(raw, np.void)
                values = pickle.loads(raw.tobytes())
                assert all(isinstance(key, str) and isinstance(value, str) for key, value in values.items())
                row = [values["type"]]
                for key in parameters[values["type"]]:
                    letters = [""] if key in ("radius", "semi_angle") else ["_x", "_y", "_z"]
                    row.append([float(values[key + letter]) for letter in letters])
                found[int(number)] = (row, group["gt_points"][()])
        assert sorted(found) == list(range(len(found))) and 0 < len(found) <= most and labels.max() < len(found)
    return points, noisy, normals, labels, found


@pytest.fixture(scope="session")
def independent_read():
    """independent_read(path) -> points, noisy points, normals, labels, {number: ([kind, *fields], samples)}."""
    return _independent_read


@pytest.fixture(scope="session")
def assert_equal():
    """Compares two records field by field, with dtypes."""
    return _assert_equal
