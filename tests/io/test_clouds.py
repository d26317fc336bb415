"""The dispatch by suffix, and its promise: any bytes under any suffix give a cloud or one sentence."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jprimfit.io import clouds, text
from jprimfit.io.clouds import read_cloud

NATIVE = (".ply", ".xyz", ".csv", ".npy", ".npz", ".obj", ".stl")


def _seeds(folder):
    """A small whole file of every native format, as bytes."""
    points = (np.arange(12.0) % 5).reshape(4, 3)
    files = {}
    np.save(folder / "a.npy", points)
    np.savez(folder / "a.npz", points=points)
    text.write(folder / "a.xyz", points)
    for suffix in (".npy", ".npz", ".xyz"):
        files[suffix] = (folder / f"a{suffix}").read_bytes()
    files[".csv"] = b"x,y,z\n" + files[".xyz"].replace(b" ", b",")
    files[".obj"] = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    files[".stl"] = b"\0" * 80 + b"\1\0\0\0" + (np.arange(12) % 5).astype("<f4").tobytes() + b"\0\0"
    vertex = b"element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    face = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    body = points.astype("<f4").tobytes() + b"\3" + np.arange(3, dtype="<i4").tobytes()
    files[".ply"] = b"ply\nformat binary_little_endian 1.0\n" + vertex + face + body
    return files


@st.composite
def _damaged(draw, files):
    """A suffix and the bytes of a file of that suffix after a few cuts, insertions and overwritten bytes."""
    suffix = draw(st.sampled_from(NATIVE))
    data = bytearray(files[suffix] if draw(st.booleans()) else b"")
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, len(data)))
        piece = draw(
            st.one_of(st.binary(max_size=12), st.sampled_from([b"nan", b"-1", b"99999999999", b"\n", b"1e400 "]))
        )
        data[place : place + draw(st.integers(0, 12))] = piece
    return suffix, bytes(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data)


def _gives_a_cloud_or_a_sentence(path, data):
    path.write_bytes(data)
    try:
        cloud = read_cloud(path)
    except ValueError as error:
        message = str(error)
        assert message.startswith(str(path)) and message.endswith("."), message
        assert "\n" not in message and len(message) < 400 + len(str(path)), message
        return
    assert cloud.points.dtype == np.float64 and cloud.points.ndim == 2 and cloud.points.shape[1] == 3
    assert len(cloud.points) > 0
    assert cloud.normals is None or cloud.normals.shape == cloud.points.shape


@pytest.mark.parametrize("examples", [60, pytest.param(10_000, marks=pytest.mark.slow)])
def test_any_bytes_give_a_cloud_or_one_sentence(tmp_path, monkeypatch, examples):
    files = _seeds(tmp_path)
    monkeypatch.setattr(clouds.cloud_of_mesh, "__kwdefaults__", {"num_samples": 8, "seed": 0}, raising=True)

    @settings(max_examples=examples, deadline=None, database=None, derandomize=True)
    @given(_damaged(files))
    def check(case):
        suffix, data = case
        _gives_a_cloud_or_a_sentence(tmp_path / f"case{suffix}", data)

    check()


def test_whole_seeds_are_read(tmp_path):
    for suffix, data in _seeds(tmp_path).items():
        (tmp_path / f"whole{suffix}").write_bytes(data)
        assert len(read_cloud(tmp_path / f"whole{suffix}").points) >= 4


def test_what_is_no_file_is_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="absent.ply does not exist: check the name."):
        read_cloud(tmp_path / "absent.ply")
    with pytest.raises(ValueError, match="is a folder: give the scan files in it."):
        read_cloud(tmp_path)
    (tmp_path / "scan.doc").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"the suffix '.doc', which is none of .ply, .xyz"):
        read_cloud(tmp_path / "scan.doc")
    (tmp_path / "scan.stl").write_bytes(b"")
    with pytest.raises(ValueError, match="scan.stl is empty"):
        read_cloud(str(tmp_path / "scan.stl"))


def test_a_file_that_may_not_be_read_is_one_sentence(tmp_path, monkeypatch):
    def denied(path):
        raise PermissionError(13, "Permission denied", str(path))

    (tmp_path / "a.ply").write_bytes(b"ply")
    monkeypatch.setitem(clouds.READERS, ".ply", denied)
    with pytest.raises(ValueError, match=r"a.ply cannot be read \(Permission denied\)"):
        read_cloud(tmp_path / "a.ply")
