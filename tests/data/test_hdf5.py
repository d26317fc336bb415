import os
import zlib

import h5py
import numpy as np
import pytest

from jprimfit.data import hdf5


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.h5"


def _write(path, fill):
    with h5py.File(path, "w") as file:
        fill(file)
    return path


def _refused(path, words, act):
    with pytest.raises(ValueError, match=words) as caught, hdf5.Source(path) as source:
        act(source)
    assert str(caught.value).startswith(str(path)) and str(caught.value).endswith(".") and "\n" not in str(caught.value)


def test_what_is_written_is_read(path):
    rows = np.arange(60000, dtype=np.int32).reshape(-1, 3)
    with hdf5.create(path, checksums=True) as target:
        for start in range(0, len(rows), 1234):
            target.append("group/rows", rows[start : start + 1234], packed=True)
        target.append("group/plain", rows[:7].astype(np.float32), packed=False)
        target.array("whole", rows[:5].astype(">f8"))
        for name, value in {"text": "größe", "empty": "", "number": 7, "real": 0.1, "raw": b"\x80\x00x\x00"}.items():
            target.attribute("group", name, value)
    with hdf5.Source(path) as source:
        assert source.children() == {"group": "group", "whole": "array"}
        assert source.children("group") == {"plain": "array", "rows": "array"}
        stored = source.array("group/rows", kind="i4", shape=(None, 3))
        assert stored.shape == (20000, 3) and len(stored) == 20000
        np.testing.assert_array_equal(stored.read(), rows)
        np.testing.assert_array_equal(stored.read(15999, 16001), rows[15999:16001])
        whole = source.array("whole", kind="f", shape=(5, 3)).read()
        assert whole.dtype == np.float64 and whole.dtype.isnative
        np.testing.assert_array_equal(whole, rows[:5])
        assert source.attribute_names("group") == ["empty", "number", "raw", "real", "text"]
        found = [source.attribute("group", name) for name in ("text", "empty", "number", "real", "raw")]
        assert found == ["größe", "", 7, 0.1, b"\x80\x00x\x00"]


def test_equal_content_gives_equal_bytes_and_nothing_is_left_beside(path, tmp_path):
    for name in ("a.h5", "b.h5"):
        with hdf5.create(tmp_path / name, checksums=True) as target:
            target.append("x", np.arange(9), packed=True)
            target.attribute("group", "name", "value")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "b.h5"]


def test_an_error_leaves_the_old_file(path, tmp_path):
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), hdf5.create(path, checksums=False) as target:
        target.array("x", np.arange(3))
        raise RuntimeError
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file.h5"]
    with pytest.raises(ValueError, match="is not a folder"), hdf5.create(tmp_path / "no" / "x.h5", checksums=False):
        pass


def test_append_refuses_another_type(path):
    with (
        pytest.raises(ValueError, match="give all parts of a file the same"),
        hdf5.create(path, checksums=True) as target,
    ):
        target.append("x", np.zeros((2, 3), np.float32), packed=False)
        target.append("x", np.zeros((2, 3), np.float64), packed=False)


def test_what_is_no_hdf5(path, tmp_path):
    _refused(tmp_path / "absent.h5", "is not a file", lambda source: None)
    path.write_bytes(b"no file of this kind" * 100)
    _refused(path, "is damaged or no HDF5", lambda source: None)
    path.write_bytes(
        _write(tmp_path / "good.h5", lambda file: file.create_dataset("x", data=np.arange(999))).read_bytes()[:3000]
    )
    _refused(path, "is damaged or no HDF5", lambda source: source.array("x").read())


@pytest.mark.parametrize("link", [h5py.SoftLink("/x"), h5py.SoftLink("/nowhere"), h5py.ExternalLink("other.h5", "/x")])
def test_links_are_not_followed(path, link):
    def fill(file):
        file["x"] = np.arange(3)
        file["y"] = link

    _write(path, fill)
    _refused(path, "a link instead of data", lambda source: source.children())
    _refused(path, "a link instead of data", lambda source: source.array("y"))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("contiguous", {"shape": (10**12, 3), "dtype": "f8"}),
        ("chunked", {"shape": (10**12, 3), "dtype": "f8", "chunks": (1000, 3), "compression": "gzip"}),
        ("many", {"shape": (2**40,), "dtype": "i1", "chunks": (1 << 20,)}),
    ],
)
def test_huge_declared_shapes_are_refused_before_allocation(path, name, options):
    _write(path, lambda file: file.create_dataset("x", **options))
    _refused(path, "bytes but has 0", lambda source: source.array("x"))


@pytest.mark.parametrize(("rows", "words"), [(1000, "larger than its"), (1 << 16, "unpacks to more")])
def test_a_chunk_that_unpacks_to_more_than_it_should_is_refused(path, rows, words):
    def fill(file):
        data = file.create_dataset("x", (rows,), "f4", chunks=(rows,), compression="gzip")
        data.id.write_direct_chunk((0,), zlib.compress(bytes(20 << 20), 9))

    _refused(_write(path, fill), words, lambda source: source.array("x"))


def test_arrays_that_lie_elsewhere_or_need_plugins_are_refused(path, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(80))
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "x", (10,))

    def fill(file):
        file.create_dataset("external", (10,), "f8", external=[(str(tmp_path / "secret"), 0, 80)])
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("lzf", data=np.arange(10), compression="lzf")

    _write(path, fill)
    _refused(path, "lies in another file", lambda source: source.array("external"))
    _refused(path, "lies in another file", lambda source: source.array("virtual"))
    _refused(path, "is packed by filters", lambda source: source.array("lzf"))


def test_types_and_shapes(path):
    def fill(file):
        file["x"] = np.zeros((4, 3))
        file["half"] = np.zeros(4, np.float16)
        file["complex"] = np.zeros(4, np.complex64)
        file["text"] = ["a", "b"]
        file["scalar"] = 3.0
        file["none"] = h5py.Empty("f8")
        file["type"] = np.dtype("f8")
        file.attrs["vector"] = np.arange(3)
        file.attrs["long"] = np.void(bytes(60000))
        file.attrs["complex"] = 1j

    _write(path, fill)
    for name in ("half", "complex", "text"):
        _refused(path, "has numbers of type", lambda source, name=name: source.array(name))
    _refused(path, "expected i", lambda source: source.array("x", kind="i"))
    _refused(path, "expected f4", lambda source: source.array("x", kind="f4"))
    _refused(path, r"has shape \(4, 3\), expected \(None, 2\)", lambda source: source.array("x", shape=(None, 2)))
    for name in ("scalar", "none"):
        _refused(path, "has shape", lambda source, name=name: source.array(name, kind="f"))
    _refused(path, "is no array", lambda source: source.array("type"))
    _refused(path, "holds a named type", lambda source: source.children())
    _refused(path, "is missing", lambda source: source.array("x/y"))
    _refused(path, "is missing", lambda source: source.array("absent"))
    _refused(path, "is no group", lambda source: source.children("x"))
    _refused(path, "is no scalar", lambda source: source.attribute("", "vector"))
    _refused(path, "neither text nor number", lambda source: source.attribute("", "complex"))
    _refused(path, "is missing", lambda source: source.attribute("", "absent"))
    with hdf5.Source(path) as source:
        assert source.attribute("", "long") == bytes(60000)


def test_a_flipped_byte_in_a_chunk_is_found(path):
    rows = np.random.default_rng(0).normal(size=(500, 3))
    with hdf5.create(path, checksums=True) as target:
        target.append("x", rows, packed=False)
    raw = bytearray(path.read_bytes())
    raw[raw.index(rows[100].tobytes())] ^= 1
    path.write_bytes(raw)
    _refused(path, "array x is damaged", lambda source: source.array("x").read())
