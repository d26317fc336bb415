import os
import pickle

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jprimfit.data import records, traceparts
from jprimfit.types import Cone, Cylinder, Plane, Sphere


@pytest.fixture(scope="module")
def part(make_part):
    return make_part(2, forms=("cloud",), samples=512, points=50)


@pytest.fixture(scope="module")
def good(part, tmp_path_factory):
    """The bytes of a valid file named some.h5."""
    path = tmp_path_factory.mktemp("traceparts") / "some.h5"
    traceparts.write(path, part)
    return path.read_bytes()


@pytest.fixture
def path(tmp_path, good):
    path = tmp_path / "some.h5"
    path.write_bytes(good)
    return path


def test_an_independent_reader_accepts_our_files(path, part, independent_read):
    points, noisy, normals, labels, found = independent_read(path)
    np.testing.assert_array_equal(points, part.cloud.points)
    np.testing.assert_array_equal(noisy, part.cloud.noisy_points)
    np.testing.assert_array_equal(normals, part.cloud.normals)
    np.testing.assert_array_equal(labels, part.cloud.labels)
    for number, primitive in enumerate(part.primitives):
        (kind, *values), samples = found[number]
        np.testing.assert_array_equal(samples, part.cloud.samples[number])
        assert kind == primitive.kind
        if kind == "plane":
            location, axis = values
            np.testing.assert_array_equal(axis, primitive.normal)
            assert np.dot(location, axis) == pytest.approx(primitive.offset, rel=1e-15)
        elif kind == "sphere":
            np.testing.assert_array_equal(np.concatenate(values), np.append(primitive.center, primitive.radius))
        elif kind == "cylinder":
            expected = np.concatenate([primitive.center, primitive.axis, [primitive.radius]])
            np.testing.assert_array_equal(np.concatenate(values), expected)
        else:
            expected = np.concatenate([primitive.apex, primitive.axis, [primitive.half_angle]])
            np.testing.assert_array_equal(np.concatenate(values), expected)
    with h5py.File(path) as file:  # as old HDF5 libraries and Python 3.6 need it
        group = file["some_soup_0"]
        assert list(group.attrs) == ["meta"] and group.attrs["meta"].tobytes()[:2] == b"\x80\x02"
        assert file["gt_points"].chunks is None and file.libver[0] == "earliest"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_round_trip(tmp_path, make_part, assert_equal, dtype):
    for seed in range(3):
        part = make_part(seed, forms=("cloud",), samples=512, dtype=dtype)
        traceparts.write(tmp_path / "other name.h5", part)
        found = traceparts.read(tmp_path / "other name.h5")
        assert found.name == "other name" and (found.family, found.scale, found.areas) == ("", 1.0, None)
        assert_equal(found.cloud, part.cloud)
        assert_equal(records.pack(found.primitives), records.pack(part.primitives))


def test_offsets_of_planes_come_back_exactly(tmp_path, part):
    draw = np.random.default_rng(1)
    normals = draw.normal(size=(200, 3)) * (draw.random((200, 3)) < 0.7) + np.eye(3)[np.arange(200) % 3]
    normals /= np.sqrt(np.sum(normals**2, axis=1, keepdims=True))
    normals *= np.sign(normals[np.arange(200), np.argmax(np.abs(normals), axis=1)])[:, None]
    planes = tuple(Plane(normal, offset) for normal, offset in zip(normals, draw.normal(size=200), strict=True))
    samples = np.zeros((200, 512, 3), np.float32)
    cloud = part.cloud._replace(samples=samples, sample_normals=None)
    traceparts.write(tmp_path / "planes.h5", part._replace(primitives=planes, areas=None, cloud=cloud))
    for plane, found in zip(planes, traceparts.read(tmp_path / "planes.h5").primitives, strict=True):
        np.testing.assert_array_equal(found.normal, plane.normal)
        assert found.offset == plane.offset


def test_what_a_part_lacks(tmp_path, part):
    path = tmp_path / "clean.h5"
    traceparts.write(path, part._replace(cloud=part.cloud._replace(noisy_points=None, sample_normals=None)))
    found = traceparts.read(path)
    np.testing.assert_array_equal(found.cloud.noisy_points, part.cloud.points)
    assert found.cloud.sample_normals is None
    few = part.cloud._replace(samples=part.cloud.samples[:, :100], sample_normals=None)
    for bad in (part._replace(cloud=few), part._replace(cloud=part.cloud._replace(samples=None, sample_normals=None))):
        with pytest.raises(ValueError, match="512 samples of each"):
            traceparts.write(tmp_path / "bad.h5", bad)
    assert os.listdir(tmp_path) == ["clean.h5"]


def _foreign(path, metas, *, dtype="f8", label="i8", write=lambda values: np.void(pickle.dumps(values, protocol=2))):
    """A file as others write it: any prefix, any widths; instance k has its samples around (k, k, k)."""
    draw = np.random.default_rng(0)
    normals = draw.normal(size=(20, 3))
    with h5py.File(path, "w") as file:
        file["gt_points"] = draw.normal(size=(20, 3)).astype(dtype)
        file["noisy_points"] = draw.normal(size=(20, 3)).astype(dtype)
        file["gt_normals"] = (normals / np.sqrt(np.sum(normals**2, axis=1, keepdims=True))).astype(dtype)
        file["gt_labels"] = draw.integers(0, len(metas), 20).astype(label)
        file["glob_features"] = np.zeros(1024, "f4")
        for row, values in enumerate(metas):
            group = file.create_group(f"x_y_soup_{row}")
            group["gt_points"] = (row + draw.uniform(-0.1, 0.1, size=(30, 3))).astype(dtype)
            group.attrs["meta"] = write(values)


def _meta(kind, extra=(), **vectors):
    out = {"type": kind, **dict(extra)}
    for name, vector in vectors.items():
        out |= {f"{name}_{letter}": value for letter, value in zip("xyz", vector, strict=True)}
    return out


@pytest.mark.parametrize("write", [lambda v: np.void(pickle.dumps(v, protocol=2)), str], ids=["pickle", "text"])
@pytest.mark.parametrize(("dtype", "label"), [("f4", "i4"), (">f8", "u1"), ("f8", "i2"), ("f4", "u8")])
def test_files_of_others(tmp_path, dtype, label, write):
    metas = [
        _meta("plane", location=(1, 2, 3), axis=(0, 0, "-2.0")),
        _meta("sphere", {"radius": np.float64(0.5).item(), "extra": [1]}, location=("1", "2", "3.5")),
        _meta("cylinder", {"radius": "0.25"}, location=(0, 0, 1), axis=(0.0, -0.6, 0.8)),
        _meta("cone", {"semi_angle": 0.5}, apex=(0, 0, 9), axis=(0, 0, 1)),
    ]
    _foreign(tmp_path / "a.h5", metas, dtype=dtype, label=label, write=write)
    part = traceparts.read(tmp_path / "a.h5")
    assert part.cloud.points.dtype == np.dtype(dtype[-2:]) and part.cloud.labels.dtype == np.int32
    assert part.cloud.samples.shape == (4, 30, 3)
    expected = (
        Plane(np.array([0.0, 0, 1]), 3.0),
        Sphere(np.array([1, 2, 3.5]), 0.5),
        Cylinder(np.array([0, -0.6, 0.8]), np.array([0.0, 0, 1]), 0.25),
        Cone(np.array([0.0, 0, -1]), np.array([0.0, 0, 9]), 0.5),  # the samples lie below the apex
    )
    np.testing.assert_allclose(records.pack(part.primitives).parameters, records.pack(expected).parameters, rtol=1e-15)


def _set_meta(values, raw=None):
    def edit(file):
        file["some_soup_0"].attrs["meta"] = np.void(pickle.dumps(values, protocol=2)) if raw is None else raw

    return edit


def _label(value):
    def edit(file):
        file["gt_labels"][0] = value

    return edit


def _replace(name, values):
    def edit(file):
        del file[name]
        file[name] = values

    return edit


class _Runs:
    def __reduce__(self):
        return os.system, ("exit 1",)


_PLANE = _meta("plane", location=(1, 2, 3), axis=(0, 0, 1))
HOSTILE = {
    "gap": (lambda f: f.move("some_soup_2", "some_soup_17"), "not numbered 0 to n - 1"),
    "twice": (lambda f: f.copy("some_soup_2", "some_soup_02"), "number comes twice"),
    "no instance": (lambda f: [f.pop(name) for name in list(f) if "soup" in name], "not numbered 0 to n - 1"),
    "array as instance": (lambda f: f.create_dataset("x_soup_6", data=np.zeros(3)), "is no group"),
    "soft link": (lambda f: f.__setitem__("some_soup_6", h5py.SoftLink("/some_soup_0")), "a link instead"),
    "external link": (lambda f: f.__setitem__("x", h5py.ExternalLink("y.h5", "/")), "a link instead"),
    "cycle": (lambda f: f.__setitem__("some_soup_6", f["/"]), "different numbers or types of gt_points"),
    "label high": (_label(6), "labels run over"),
    "label low": (_label(-2), "labels run over"),
    "label wide": (_replace("gt_labels", np.full(50, 2**64 - 1, np.uint64)), "labels run over"),
    "float labels": (_replace("gt_labels", np.zeros(50)), "gt_labels has numbers of type float64"),
    "few labels": (_replace("gt_labels", np.zeros(49, int)), "gt_labels has shape"),
    "no points": (lambda f: f.pop("gt_points"), "gt_points is missing"),
    "zero points": (
        lambda f: [
            _replace(name, np.zeros((0, 3)[: 1 + (name != "gt_labels")], "i4" if name == "gt_labels" else "f4"))(f)
            for name in ("gt_points", "gt_normals", "gt_labels", "noisy_points")
        ],
        "none or too many",
    ),
    "half normals": (_replace("gt_normals", np.ones((50, 3))), "normals are not of length 1"),
    "NaN": (_replace("noisy_points", np.full((50, 3), np.nan)), "noisy points hold NaN"),
    "samples": (_replace("some_soup_1/gt_points", np.zeros((511, 3), "f4")), "different numbers or types of gt_points"),
    "no meta": (lambda f: f["some_soup_0"].attrs.__delitem__("meta"), "meta of /some_soup_0 is missing"),
    "number as meta": (_set_meta(None, raw=3.0), "its meta is a number"),
    "vector as meta": (_set_meta(None, raw=np.arange(3)), "is no scalar"),
    "running meta": (_set_meta({"type": _Runs()}), "its meta is no plain dict"),
    "running text": (_set_meta(None, raw="__import__('os').system('exit 1')"), "its meta is no plain dict"),
    "type": (_set_meta(_PLANE | {"type": "torus"}), "its type is 'torus'"),
    "no type": (_set_meta({}), "its type is 'None'"),
    "no axis": (_set_meta({k: v for k, v in _PLANE.items() if k != "axis_z"}), "axis_z = 'None', expected a number"),
    "zero axis": (_set_meta(_PLANE | {"axis_z": 0.0}), "its axis is zero"),
    "NaN axis": (_set_meta(_PLANE | {"axis_z": "nan"}), "axis_z = 'nan', expected a number"),
    "huge location": (_set_meta(_PLANE | {"location_x": "1e300"}), "expected a number"),
    "words": (_set_meta(_PLANE | {"axis_z": "one"}), "axis_z = 'one', expected a number"),
    "radius": (_set_meta(_meta("sphere", {"radius": -1}, location=(0, 0, 0))), "radius that is not positive"),
    "degrees": (_set_meta(_meta("cone", {"semi_angle": 45}, apex=(0, 0, 0), axis=(0, 0, 1))), "half-angle outside"),
    "huge": (
        lambda f: (f.pop("gt_points"), f.create_dataset("gt_points", (10**12, 3), "f8", chunks=(10, 3))),
        "bytes but has 0",
    ),
    "shared": (
        lambda f: (
            [f.pop(name) for name in list(f) if "soup" in name],
            f.create_dataset("big", data=np.zeros((1 << 18, 3), "f4")),
            [f.__setitem__(f"a_soup_{row}/gt_points", f["big"]) for row in range(65)],
        ),
        "or huge",
    ),
}


@pytest.mark.parametrize(("edit", "words"), HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_in_one_sentence(monkeypatch, path, edit, words):
    with h5py.File(path, "r+") as file:
        edit(file)
    monkeypatch.setattr(os, "system", lambda command: pytest.fail("something ran"))
    with pytest.raises(ValueError, match=words) as caught:
        traceparts.read(path)
    assert str(caught.value).startswith(str(path)) and str(caught.value).endswith(".") and "\n" not in str(caught.value)


@settings(max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(place=st.floats(0, 1, exclude_max=True), bytes_=st.binary(min_size=1, max_size=16), cut=st.booleans())
def test_damage_anywhere_gives_a_sentence_or_a_valid_part(path, good, place, bytes_, cut):
    start = int(place**3 * len(good))  # more often in the tables, which come first
    path.write_bytes(good[:start] if cut else good[:start] + bytes_ + good[start + len(bytes_) :])
    try:
        records.check(traceparts.read(path), source="FILE")
    except ValueError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)


def test_folders_and_lists(tmp_path, make_part):
    parts = [make_part(row, forms=("cloud",), samples=512, points=9, name=f"p{row}") for row in (3, 0, 1, 2)]
    traceparts.write_folder(tmp_path / "set", parts)
    assert (tmp_path / "set" / "train_models.csv").read_bytes() == b"p0.h5\np1.h5\n"
    found = traceparts.read_folder(tmp_path / "set")
    assert {split: [path.stem for path in paths] for split, paths in found.items()} == {
        "test": ["p3"],
        "train": ["p0", "p1"],
        "val": ["p2"],
    }
    assert traceparts.read(found["val"][0]).name == "p2"
    for path in (tmp_path / "set").glob("*.csv"):
        path.unlink()
    assert [path.name for path in traceparts.read_folder(tmp_path / "set")[""]] == ["p0.h5", "p1.h5", "p2.h5", "p3.h5"]
    elsewhere = tmp_path / "list.csv"
    elsewhere.write_bytes(b"\xef\xbb\xbfp1.h5\r\np0.h5\r\n\r\n")
    assert [path.stem for path in traceparts.read_list(elsewhere, folder=tmp_path / "set")] == ["p1", "p0"]
    for taken in (tmp_path / "set", tmp_path / "list.csv"):
        with pytest.raises(OSError):
            traceparts.write_folder(taken, parts)
    with pytest.raises(ValueError, match="its name is no file name"):
        traceparts.write_folder(tmp_path / "bad", [parts[1], parts[0]._replace(name="../p")])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["list.csv", "set"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"absent.h5\n", "which is not in"),
        (b"../some.h5\n", "not as a file"),
        (b"/elsewhere/some.h5\n", "not as a file"),
        (b"some.h5\nsome.h5\n", "twice"),
        (b"some.txt\n", "not as a file"),
        (b"\xff\xfe\x00", "is not text"),
    ],
)
def test_lists_are_refused_in_one_sentence(path, tmp_path, text, words):
    (tmp_path / "train_models.csv").write_bytes(text)
    with pytest.raises(ValueError, match=words):
        traceparts.read_folder(tmp_path)


def test_absent_folders_and_lists(tmp_path):
    with pytest.raises(ValueError, match="is not a folder"):
        traceparts.read_folder(tmp_path / "no")
    with pytest.raises(ValueError, match="is not a list of files"):
        traceparts.read_list(tmp_path / "no.csv")
