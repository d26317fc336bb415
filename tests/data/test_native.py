import os
import pickle

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jprimfit.data import native
from jprimfit.data.digest import content_hash


@pytest.fixture
def path(tmp_path):
    return tmp_path / "parts.h5"


@pytest.fixture(scope="module")
def good(make_part, tmp_path_factory):
    """The bytes of a valid file of six parts."""
    path = tmp_path_factory.mktemp("native") / "good.h5"
    native.write(path, [make_part(row) for row in (0, 1, 5, 6, 2, 3)])
    return path.read_bytes()


def _read_all(path):
    with native.Dataset(path) as dataset:
        return [dataset[row] for row in range(len(dataset))]


def test_what_is_written_is_read(path, make_part, assert_equal):
    parts = [make_part(row, points=30 + row) for row in range(7)]
    native.write(path, iter(parts), info={"config": "größe: 1", "count": 7})
    for part, found in zip(parts, _read_all(path), strict=True):
        assert_equal(part, found)
    with native.Dataset(path) as dataset:
        assert dataset.info == {"config": "größe: 1", "count": 7}
        assert dataset.names == [part.name for part in parts] and dataset.units == ["mm"] * 7
        assert {name: rows.tolist() for name, rows in dataset.splits.items()} == {
            "train": [0, 1, 5, 6],
            "val": [2],
            "test": [3, 4],
        }
        rows = slice(*dataset.starts["instance"][3:5])
        assert [p.kind for p in parts[3].primitives] == [
            ("plane", "sphere", "cylinder", "cone")[k] for k in dataset.instances.kind[rows]
        ]
        assert [part.name for part in dataset] == dataset.names  # ends by IndexError
        with pytest.raises(IndexError, match="has parts 0 to 6"):
            dataset[-1]
        copy = pickle.loads(pickle.dumps(dataset))
    assert_equal(copy[5], parts[5])
    copy.close()
    with pytest.raises(ValueError, match="damaged or no HDF5"):
        copy[5]


def test_parts_of_different_forms_share_a_file(path, make_part, assert_equal):
    parts = [
        make_part(0, forms=("mesh",)),
        make_part(1, forms=("trims",), areas=None, background_area=0.0, unit="", family="", split=""),
        make_part(2, forms=("cloud",), dtype=np.float32),
        make_part(3, forms=("cloud", "mesh")),
    ]
    parts[2] = parts[2]._replace(cloud=parts[2].cloud._replace(noisy_points=None, sample_normals=None))
    nothing = make_part(4, forms=("mesh",), primitives=(), areas=None)
    parts.append(nothing._replace(mesh=nothing.mesh._replace(labels=np.full_like(nothing.mesh.labels, -1))))
    native.write(path, parts)
    for part, found in zip(parts, _read_all(path), strict=True):
        assert_equal(part, found)


def test_arrays_span_chunks(path, make_part, assert_equal):
    parts = [make_part(row, forms=("cloud",), points=4000 + 1000 * row, dtype=np.float64) for row in range(4)]
    native.write(path, parts)
    with native.Dataset(path) as dataset:
        for row in (3, 0, 2, 1):
            assert_equal(dataset[row], parts[row])
    with h5py.File(path) as file:
        assert file["clouds/points"].chunks[0] < 4000 and file["clouds/points"].fletcher32


def test_same_parts_same_digest_and_bytes(path, tmp_path, make_part):
    def build(name, **options):
        native.write(tmp_path / name, (make_part(row, **options) for row in range(5)))
        return content_hash(tmp_path / name)

    assert build("a.h5") == build("b.h5") != build("c.h5", points=41)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    parts = _read_all(tmp_path / "a.h5")
    native.write(path, parts)
    assert content_hash(path) == content_hash(tmp_path / "a.h5")


def test_what_cannot_be_written_leaves_no_file(path, tmp_path, make_part):
    part, other = make_part(0), make_part(5)
    cases = {
        "there are no parts": [],
        "two parts have one name": [part, other._replace(name=part.name)],
        "lies in two splits": [part, other._replace(split="val")],
        "give all parts of a file the same": [part, make_part(5, dtype=np.float64)],
        "its split is not": [part, other._replace(split="a b")],
    }
    for words, parts in cases.items():
        with pytest.raises(ValueError, match=words):
            native.write(path, parts)
    assert os.listdir(tmp_path) == []


def _set(name, change):
    """Replaces an array by change(array), or by nothing."""

    def edit(file):
        values = file[name][:]
        del file[name]
        if change is not None:
            file[name] = change(values)

    return edit


def _put(values, row, value):
    values = values.copy()
    values[row] = value
    return values


HOSTILE = {
    "newer version": (lambda f: f.attrs.modify("version", 2), "reads up to 1; update jprimfit"),
    "version 0": (lambda f: f.attrs.modify("version", 0), "its version is 0"),
    "foreign": (lambda f: f.attrs.modify("format", "other"), "no jprimfit dataset"),
    "no format": (lambda f: f.attrs.__delitem__("format"), "no jprimfit dataset"),
    "kinds": (lambda f: f.attrs.modify("kinds", "plane torus"), "it names the kinds"),
    "too few kinds": (lambda f: f.attrs.modify("kinds", "plane"), "unknown kind"),
    "stranger": (lambda f: f.create_dataset("clouds/colors", data=np.zeros(3)), "clouds/colors, which version 1"),
    "stranger group": (lambda f: f.create_group("colors"), "expected some of"),
    "root array": (lambda f: f.create_dataset("colors", data=np.zeros(3)), "expected some of"),
    "cycle": (lambda f: f["clouds"].__setitem__("again", f["/"]), "clouds/again, which version 1"),
    "soft link": (lambda f: f["clouds"].__setitem__("colors", h5py.SoftLink("/clouds/points")), "a link instead"),
    "external link": (lambda f: f.__setitem__("info", h5py.ExternalLink("x.h5", "/")), "a link instead"),
    "no names": (_set("parts/name", None), "array parts/name is missing"),
    "no points": (_set("clouds/points", None), "array clouds/points is missing"),
    "points for nobody": (_set("parts/point_start", None), "no offsets of point"),
    "offsets fall": (_set("parts/point_start", lambda s: _put(s, 1, s[2] + 1)), "offsets of point do not ascend"),
    "offsets begin late": (_set("parts/point_start", lambda s: _put(s, 0, 1)), "offsets of point do not ascend"),
    "offsets end late": (_set("parts/point_start", lambda s: _put(s, -1, s[-1] + 1)), "clouds/.* has shape"),
    "offsets negative": (_set("parts/face_start", lambda s: _put(s, 1, -5)), "offsets of face do not ascend"),
    "offsets overflow": (_set("parts/face_start", lambda s: _put(s, 1, -(2**63))), "offsets of face do not ascend"),
    "too few offsets": (_set("parts/point_start", lambda s: s[:-1]), "parts/point_start has shape"),
    "narrow offsets": (_set("parts/point_start", lambda s: s.astype(np.int32)), "expected i8"),
    "label high": (_set("clouds/labels", lambda v: _put(v, 0, 4)), "part 0 cannot be used: labels run over"),
    "label low": (_set("clouds/labels", lambda v: _put(v, 0, -2)), "part 0 cannot be used: labels run over"),
    "NaN point": (_set("clouds/points", lambda v: _put(v, 0, np.nan)), "points hold NaN"),
    "infinite sample": (_set("clouds/samples", lambda v: _put(v, 0, np.inf)), "samples hold NaN or infinity"),
    "face": (_set("meshes/faces", lambda v: _put(v, 0, 11)), "faces run over"),
    "wrong columns": (_set("clouds/points", lambda v: v[:, :2]), "clouds/points has shape"),
    "wrong rows": (_set("clouds/normals", lambda v: v[1:]), "clouds/normals has shape"),
    "wrong type": (_set("clouds/labels", lambda v: v.astype(float)), "clouds/labels has numbers of type"),
    "kind": (_set("instances/kind", lambda v: _put(v, 0, -1)), "unknown kind"),
    "parameters": (_set("instances/parameters", lambda v: _put(v, 0, 0.0)), "not a unit vector"),
    "NaN area": (_set("instances/area", lambda v: _put(v, 0, np.nan)), "negative area"),
    "two names": (_set("parts/name", lambda v: _put(v, 0, v[1])), "two parts have one name"),
    "no UTF-8": (_set("parts/name", lambda v: _put(v, 0, b"\xff\xfe")), "is not UTF-8 text"),
    "split": (_set("parts/split", lambda v: _put(v, 0, b"test")), "lies in two splits"),
    "scale": (_set("parts/scale", lambda v: _put(v, 0, 0.0)), "its scale is not positive"),
    "loops": (_set("trims/loop_size", lambda v: _put(v, 0, 2**31 - 1)), "loop sizes run over"),
    "huge": (
        lambda f: (f.__delitem__("clouds/points"), f.create_dataset("clouds/points", (240, 3), "f4")),
        "bytes but has 0",
    ),
}


@pytest.mark.parametrize(("edit", "words"), HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_in_one_sentence(path, good, edit, words):
    path.write_bytes(good)
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(ValueError, match=words) as caught:
        _read_all(path)
    assert str(caught.value).startswith(str(path)) and str(caught.value).endswith(".") and "\n" not in str(caught.value)


@settings(max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(place=st.floats(0, 1, exclude_max=True), bytes_=st.binary(min_size=1, max_size=16), cut=st.booleans())
def test_damage_anywhere_gives_a_sentence_or_a_valid_part(path, good, place, bytes_, cut):
    start = int(place * len(good))
    path.write_bytes(good[:start] if cut else good[:start] + bytes_ + good[start + len(bytes_) :])
    try:
        _read_all(path)
    except ValueError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)


def test_the_documented_layout_with_h5py_alone(path, make_part):
    parts = [make_part(row, points=20 + row) for row in range(4)]
    native.write(path, parts)
    with h5py.File(path) as file:
        assert (file.attrs["format"].decode(), file.attrs["version"]) == ("jprimfit-dataset", 1)
        kinds = file.attrs["kinds"].decode().split()
        for row, part in enumerate(parts):

            def rows(axis, name, row=row, file=file):
                return file[name][slice(*file[f"parts/{axis}_start"][row : row + 2])]

            assert file["parts/name"][row].decode() == part.name and file["parts/split"][row].decode() == part.split
            assert [kinds[kind] for kind in rows("instance", "instances/kind")] == [p.kind for p in part.primitives]
            cone = rows("instance", "instances/parameters")[3]
            np.testing.assert_array_equal(cone, np.concatenate([np.ravel(field) for field in part.primitives[3]]))
            np.testing.assert_array_equal(rows("point", "clouds/points"), part.cloud.points)
            np.testing.assert_array_equal(rows("sample", "clouds/samples"), part.cloud.samples)
            np.testing.assert_array_equal(rows("face", "meshes/faces"), part.mesh.faces)
            sizes = rows("loop", "trims/loop_size")
            corners = np.split(rows("corner", "trims/corners"), np.cumsum(sizes)[:-1])
            assert [len(loop) for loop in corners] == part.trims.loop_size.tolist()
