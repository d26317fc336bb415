"""The command `data convert`: a line on stdout, complaints on stderr, exit code 0 if anything was converted."""

import os
import pickle
import re

import h5py
import numpy as np
import pytest

from jprimfit.apps.main import main
from jprimfit.cad import step
from jprimfit.data import native, traceparts
from jprimfit.data.records import Cloud, Mesh, Part
from jprimfit.types import Plane, Sphere


def _part(name, *, samples=512):
    """A square of two triangles, its cloud, and a sphere that only the samples know."""
    draw = np.random.default_rng(0)
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    up = np.array([0.0, 0, 1])
    points = np.concatenate([draw.uniform(-1, 1, (30, 2)), np.zeros((30, 1))], axis=1)
    rays = draw.normal(size=(samples, 3))
    rays /= np.sqrt(np.sum(rays**2, axis=1, keepdims=True))
    flat = np.concatenate([draw.uniform(-1, 1, (samples, 2)), np.zeros((samples, 1))], axis=1)
    return Part(
        name,
        (Plane(up, 0.0), Sphere(np.zeros(3), 1.0)),
        cloud=Cloud(points, np.tile(up, (30, 1)), np.zeros(30, np.int32), None, np.stack([flat, rays])),
        mesh=Mesh(square, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros(2, np.int32)),
        split="train",
    )


@pytest.fixture
def published(tmp_path):
    """A folder of two TraceParts files and their list."""
    traceparts.write_folder(tmp_path / "published", [_part("a"), _part("b")])
    return tmp_path / "published"


def test_there_and_back(tmp_path, published, capsys):
    assert main(["data", "convert", str(published), str(tmp_path / "parts.h5")]) == 0
    out, err = capsys.readouterr()
    line = r"parts\.h5: 2 parts of 2 inputs, 0 left out, \d+\.\d MB, \d+\.\d s; plane 2, sphere 2, cylinder 0, cone 0; "
    assert re.search(line + r"0\.0 % background\n$", out) and out.count("\n") == 1
    assert "2/2" in err and "input" in err
    # What is native becomes TraceParts unless another format is asked for.
    assert main(["data", "convert", str(tmp_path / "parts.h5"), str(tmp_path / "again")]) == 0
    for name in ("a.h5", "b.h5", "train_models.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (published / name).read_bytes()
    words = ["--to", "native", "--split", "val"]
    assert main(["data", "convert", str(tmp_path / "parts.h5"), str(tmp_path / "other.h5"), *words]) == 0
    with native.Dataset(tmp_path / "other.h5") as dataset:
        assert list(dataset.splits) == ["val"] and dataset.names == ["a", "b"]


def test_points_are_drawn_for_surfaces(tmp_path):
    part = _part("a")
    surface = part._replace(cloud=None, primitives=part.primitives[:1])
    native.write(tmp_path / "parts.h5", [surface])
    assert main(["data", "convert", str(tmp_path / "parts.h5"), str(tmp_path / "out"), "--points", "70"]) == 0
    assert traceparts.read(tmp_path / "out" / "a.h5").cloud.points.shape == (70, 3)


def test_step_files_of_a_folder(tmp_path, capsys):
    pytest.importorskip("OCP")
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer

    (tmp_path / "parts").mkdir()
    with step.quiet():
        writer = STEPControl_Writer()
        writer.Transfer(BRepPrimAPI_MakeBox(1.0, 2.0, 3.0).Shape(), STEPControl_StepModelType.STEPControl_AsIs)
        writer.Write(str(tmp_path / "parts" / "box.step"))
    whole = (tmp_path / "parts" / "box.step").read_bytes()
    (tmp_path / "parts" / "cut.step").write_bytes(whole[: len(whole) // 2])
    assert main(["data", "convert", str(tmp_path / "parts"), str(tmp_path / "out.h5")]) == 0
    out, err = capsys.readouterr()
    assert "1 parts of 1 inputs, 1 left out" in out and "plane 6" in out and out.count("\n") == 1
    told = [line for line in re.split(r"[\r\n]+", err) if line.startswith("jprimfit: ")]
    assert len(told) == 1 and "cut.step cannot be read" in told[0]
    (tmp_path / "parts" / "box.step").unlink()
    (tmp_path / "out.h5").unlink()
    assert main(["data", "convert", str(tmp_path / "parts"), str(tmp_path / "out.h5")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "cut.step cannot be read" in err and not (tmp_path / "out.h5").exists()


def test_without_opencascade_one_sentence_says_what_to_install(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.step").write_text("ISO-10303-21;\n")
    monkeypatch.setattr(step, "available", lambda: False)
    assert main(["data", "convert", str(tmp_path), str(tmp_path / "out.h5")]) == 2
    assert capsys.readouterr().err == f"jprimfit: data: {step.NOT_INSTALLED}\n"


class _Runs:
    def __reduce__(self):
        return os.system, ("exit 1",)


def _meta(file):
    file["a_soup_0"].attrs["meta"] = np.void(pickle.dumps({"type": _Runs()}))


def _label(file):
    file["gt_labels"][0] = -2


def _huge(file):
    del file["gt_points"]
    file.create_dataset("gt_points", (10**12, 3), "f8", chunks=(10, 3))


HOSTILE = {
    "pickle": (_meta, "its meta is no plain dict"),
    "cycle": (lambda file: file.__setitem__("a_soup_2", file["/"]), "different numbers or types"),
    "huge": (_huge, "bytes but has 0"),
    "negative": (_label, "labels run over"),
    "gap": (lambda file: file.move("a_soup_1", "a_soup_3"), "not numbered 0 to n - 1"),
}


@pytest.mark.parametrize(("edit", "words"), HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_in_one_sentence(tmp_path, published, monkeypatch, capsys, edit, words):
    with h5py.File(published / "a.h5", "r+") as file:
        edit(file)
    monkeypatch.setattr(os, "system", lambda command: pytest.fail("something ran"))
    assert main(["data", "convert", str(published / "a.h5"), str(tmp_path / "out.h5")]) == 2
    out, err = capsys.readouterr()
    told = [line for line in re.split(r"[\r\n]+", err) if line.startswith("jprimfit: ")]
    assert out == "" and len(told) == 1 and words in told[0] and not (tmp_path / "out.h5").exists()
    assert main(["data", "convert", str(published), str(tmp_path / "out.h5")]) == 0
    assert "1 parts of 1 inputs, 1 left out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent.step", "out.h5"], "absent.step does not exist"),
        (["letter.step", "out.h5"], "letter.step is neither STEP nor HDF5"),
        ([".", "out.h5", "--split", "My Split"], "the split 'My Split' is no lower-case word"),
        (["empty", "out.h5"], "empty holds no STEP file and no data set"),
    ],
)
def test_other_input_is_refused_in_one_sentence(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "letter.step").write_text("Dear Sir,\nthe part is late.\n")
    assert main(["data", "convert", *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and message in err and err.count("\n") == 1 and not (tmp_path / "out.h5").exists()


def test_help_has_examples(capsys):
    for words, parts in (
        (["data", "--help"], ("convert  ", "inspect")),
        (["data", "convert", "--help"], ("--split NAME", "ParSeNet", "examples:")),
    ):
        with pytest.raises(SystemExit) as stop:
            main(words)
        out = capsys.readouterr().out
        assert stop.value.code == 0 and all(part in out for part in parts)
