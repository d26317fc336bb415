"""Files of every format become a data set and TraceParts files; what is broken is told and the rest goes on."""

import pickle
from contextlib import ExitStack

import h5py
import numpy as np
import pytest

from jprimfit.cad import step
from jprimfit.data import convert, native, records, traceparts
from jprimfit.data.solids import signed_distance


def run(source, target, *, split=None, **options):
    """(summary, complaints) of a conversion."""
    complaints = []
    with ExitStack() as stack:
        found = convert.inputs(source, stack, split=split)
        done = []
        summary = convert.convert(found.items, target, complain=complaints.append, progress=done.append, **options)
        assert done == [1] * len(found.items)
    assert all(words.endswith(".") and "\n" not in words for words in complaints)
    return summary, complaints


def read_all(path):
    with native.Dataset(path) as dataset:
        return list(dataset)


def step_file(path, text=None):
    """A STEP file of a cylinder."""
    pytest.importorskip("OCP")
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer

    path.parent.mkdir(parents=True, exist_ok=True)
    with step.quiet():
        writer = STEPControl_Writer()
        shape = BRepPrimAPI_MakeCylinder(3.0, 10.0).Shape()
        writer.Transfer(shape, STEPControl_StepModelType.STEPControl_AsIs)
        writer.Write(str(path))
    return path


class TestStep:
    def test_a_folder_with_a_broken_file_among_others(self, tmp_path):
        folder = tmp_path / "parts"
        good = step_file(folder / "pins" / "pin.step")
        step_file(folder / "screws" / "pin.STP")
        step_file(folder / "alone.txt")  # its content counts
        (folder / "broken.step").write_text("\n".join(good.read_text().splitlines()[:40]))
        (folder / "empty.stp").write_text("")
        (folder / "readme.txt").write_text("Dear Sir,")
        (folder / ".hidden.step").write_text("")
        summary, complaints = run(folder, tmp_path / "out.h5")
        assert (summary.num_parts, summary.num_failed) == (3, 2) and summary.kinds["cylinder"] == 3
        assert len(complaints) == 2 and "broken.step" in complaints[0] and "empty.stp" in complaints[1]
        parts = read_all(tmp_path / "out.h5")
        assert [(part.name, part.family, part.split) for part in parts] == [
            ("alone", "parts", "test"),
            ("pin", "pins", "test"),
            ("pin_2", "screws", "test"),
        ]
        for part in parts:
            assert part.cloud is None and part.unit == "mm"
            assert part.areas * part.scale**2 == pytest.approx([60 * np.pi, 9 * np.pi, 9 * np.pi], rel=1e-9)

    def test_names_of_files_may_be_anything(self, tmp_path):
        folder = tmp_path / "parts" / ("螺" * 60) / ("丝" * 60)
        first = step_file(folder / "bolt.step")
        first.rename(folder / ("a" * 40 + "螺" * 50 + "\n.step"))
        run(tmp_path / "parts", tmp_path / "out.h5")
        (part,) = read_all(tmp_path / "out.h5")
        assert part.name.endswith("螺_") and len(part.name.encode()) <= 180 and part.family == "丝" * 60

    def test_points_and_split(self, tmp_path):
        step_file(tmp_path / "pins" / "pin.step")
        run(tmp_path / "pins" / "pin.step", tmp_path / "out.h5", split="train", num_points=700)
        (part,) = read_all(tmp_path / "out.h5")
        assert (part.name, part.family, part.split) == ("pin", "pins", "train")
        assert part.mesh is not None and part.cloud.points.shape == (700, 3) and part.cloud.samples.shape == (3, 512, 3)
        check_residuals(part, 1e-6)

    def test_nothing_is_left(self, tmp_path):
        pytest.importorskip("OCP")
        folder = tmp_path / "parts"
        folder.mkdir()
        for name in ("a.step", "b.step"):
            (folder / name).write_text("ISO-10303-21;")
        with pytest.raises(ValueError, match="none of the 2 inputs could be used"):
            run(folder, tmp_path / "out.h5")
        with pytest.raises(ValueError, match=r"a\.step cannot be read: it is no whole STEP file"):
            run(folder / "a.step", tmp_path / "out.h5")
        assert [entry.name for entry in tmp_path.iterdir()] == ["parts"]

    def test_without_opencascade(self, tmp_path, monkeypatch):
        (tmp_path / "a.step").write_text("ISO-10303-21;")
        monkeypatch.setattr(step, "available", lambda: False)
        for source in (tmp_path, tmp_path / "a.step"):
            with pytest.raises(ValueError, match=r"run pip install 'jprimfit\[cad\]'\.$"):
                run(source, tmp_path / "out.h5")


def check_residuals(part, limit):
    """Points and samples lie on their primitives with their normals, within limit of the diagonal."""
    diagonal = np.sqrt(np.sum(np.ptp(part.cloud.points, axis=0) ** 2))
    for label, primitive in enumerate(part.primitives):
        mine = part.cloud.labels == label
        points = np.concatenate([part.cloud.points[mine], part.cloud.samples[label]]).astype(np.float64)
        normals = np.concatenate([part.cloud.normals[mine], part.cloud.sample_normals[label]]).astype(np.float64)
        distance, gradient = signed_distance(primitive, points)
        assert np.abs(distance).max() < limit * diagonal
        across = np.sqrt(np.sum(np.cross(gradient, normals) ** 2, axis=1))
        assert across.max() < np.radians(0.01)


class TestTraceParts:
    def test_there_and_back_is_equal(self, tmp_path, make_part, assert_equal):
        parts = [make_part(row, forms=("cloud",), samples=512, points=50, name=f"p{row}") for row in (0, 1, 2, 3)]
        parts = [part._replace(areas=None, background_area=0.0) for part in parts]
        traceparts.write_folder(tmp_path / "first", parts)
        run(tmp_path / "first", tmp_path / "middle.h5")
        summary, _ = run(tmp_path / "middle.h5", tmp_path / "second", to="traceparts")
        assert summary.num_parts == 4 and summary.num_failed == 0
        names = sorted(path.name for path in (tmp_path / "first").iterdir())
        assert names == sorted(path.name for path in (tmp_path / "second").iterdir())
        for name in names:
            left, right = tmp_path / "first" / name, tmp_path / "second" / name
            assert left.read_bytes() == right.read_bytes()
        for part, found in zip(
            sorted(parts, key=lambda p: p.name),
            sorted(read_all(tmp_path / "middle.h5"), key=lambda p: p.name),
            strict=True,
        ):
            assert_equal(found.cloud, part.cloud)
            assert_equal(records.pack(found.primitives), records.pack(part.primitives))
            assert found.split == part.split

    def test_surfaces_get_points_and_an_independent_reader_accepts_them(
        self, tmp_path, drilled_block, independent_read
    ):
        native.write(tmp_path / "a.h5", [drilled_block(name="a/b", split="val"), drilled_block(name="c", split="val")])
        run(tmp_path / "a.h5", tmp_path / "out", to="traceparts", num_points=300)
        assert (tmp_path / "out" / "val_models.csv").read_text() == "a_b.h5\nc.h5\n"
        for name in ("a_b.h5", "c.h5"):
            points, noisy, _, labels, found = independent_read(tmp_path / "out" / name)
            assert points.shape == (300, 3) and set(labels.tolist()) <= set(range(7)) and len(found) == 7
            np.testing.assert_array_equal(points, noisy)
            check_residuals(traceparts.read(tmp_path / "out" / name), 1e-6)
        run(tmp_path / "a.h5", tmp_path / "many", to="traceparts")
        assert len(traceparts.read(tmp_path / "many" / "c.h5").cloud.points) == convert.NUM_POINTS

    def test_samples_are_drawn_where_a_cloud_has_none(self, tmp_path, make_part):
        part = make_part(0, forms=("cloud",), samples=6, points=80)
        native.write(tmp_path / "a.h5", [part])
        run(tmp_path / "a.h5", tmp_path / "out", to="traceparts")
        found = traceparts.read(tmp_path / "out" / "part 0.h5").cloud
        np.testing.assert_array_equal(found.points, part.cloud.points)
        stored = {tuple(row) for row in part.cloud.samples.reshape(-1, 3).tolist()}
        assert found.samples.shape == (4, 512, 3)
        assert {tuple(row) for row in found.samples.reshape(-1, 3).tolist()} == stored

    def test_lists_give_splits_and_one_file_needs_none(self, tmp_path, make_part):
        parts = [make_part(row, forms=("cloud",), samples=512, points=9, name=f"p{row}") for row in (0, 1, 2)]
        traceparts.write_folder(tmp_path / "set", parts)
        (tmp_path / "set" / "test_models.csv").write_text("p1.h5\np2.h5\n")  # in two lists: the first counts
        run(tmp_path / "set", tmp_path / "a.h5")
        assert {part.name: part.split for part in read_all(tmp_path / "a.h5")} == {
            "p0": "train",
            "p1": "test",
            "p2": "test",
        }
        run(tmp_path / "set", tmp_path / "b.h5", split="val")
        assert {part.split for part in read_all(tmp_path / "b.h5")} == {"val"}
        run(tmp_path / "set" / "p0.h5", tmp_path / "c.h5")
        assert [part.split for part in read_all(tmp_path / "c.h5")] == ["test"]

    def test_a_wider_part_does_not_join_a_narrower_one(self, tmp_path, make_part):
        for name, dtype in (("a", np.float32), ("b", np.float64), ("c", np.float32)):
            part = make_part(0, forms=("cloud",), samples=512, points=9, dtype=dtype)
            traceparts.write(tmp_path / f"{name}.h5", part)
        summary, complaints = run(tmp_path, tmp_path / "out.h5")
        assert summary.num_parts == 2 and "convert it on its own" in complaints[0]
        (tmp_path / "a.h5").unlink()
        (tmp_path / "out.h5").unlink()
        assert run(tmp_path, tmp_path / "out.h5")[0].num_parts == 2
        assert {part.cloud.points.dtype for part in read_all(tmp_path / "out.h5")} == {np.dtype(np.float64)}


class _Runs:
    def __reduce__(self):
        return pytest.fail, ("something ran",)


def _set_meta(file):
    file["a_soup_0"].attrs["meta"] = np.void(pickle.dumps({"type": _Runs()}))


def _label(file):
    file["gt_labels"][0] = -7


def _huge(file):
    del file["gt_points"]
    file.create_dataset("gt_points", (10**12, 3), "f8", chunks=(10, 3))


HOSTILE = {
    "pickle": (_set_meta, "its meta is no plain dict"),
    "cycle": (lambda file: file.__setitem__("a_soup_4", file["/"]), "different numbers or types of gt_points"),
    "huge": (_huge, "bytes but has 0"),
    "negative": (_label, "labels run over"),
    "gap": (lambda file: file.move("a_soup_2", "a_soup_9"), "not numbered 0 to n - 1"),
    "link": (lambda file: file.__setitem__("x", h5py.ExternalLink("y.h5", "/")), "a link instead"),
    "layout": (lambda file: [file.pop(name) for name in list(file)], "of another layout"),
}


@pytest.mark.parametrize(("edit", "words"), HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_and_the_rest_goes_on(tmp_path, make_part, edit, words):
    (tmp_path / "set").mkdir()
    for name in ("a", "b"):
        part = make_part(0, forms=("cloud",), samples=512, points=9)
        traceparts.write(tmp_path / "set" / f"{name}.h5", part)
    with h5py.File(tmp_path / "set" / "a.h5", "r+") as file:
        edit(file)
    with pytest.raises(ValueError, match=words):
        run(tmp_path / "set" / "a.h5", tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()
    summary, (complaint,) = run(tmp_path / "set", tmp_path / "out.h5")
    assert summary.num_parts == 1 and words in complaint and "a.h5" in complaint
    assert [part.name for part in read_all(tmp_path / "out.h5")] == ["b"]


def test_parsenet_files_keep_their_split(tmp_path):
    draw = np.random.default_rng(0)
    flat = np.concatenate([draw.uniform(-1, 1, (3, 200, 2)), np.zeros((3, 200, 1))], axis=2)
    with h5py.File(tmp_path / "train_data.h5", "w") as file:
        file["points"], file["normals"] = flat, np.tile([0.0, 0, 1], (3, 200, 1))
        file["labels"] = np.repeat([[0] * 100 + [4] * 100], 3, axis=0)
        file["prim"] = np.array([[1] * 100 + [9] * 100, [1] * 200, [7] * 200])
    summary, complaints = run(tmp_path / "train_data.h5", tmp_path / "out.h5")
    assert (summary.num_parts, summary.num_failed) == (2, 1) and "shape 2" in complaints[0]
    assert summary.background == pytest.approx(0.25)
    parts = read_all(tmp_path / "out.h5")
    assert [(part.name, part.split, len(part.primitives)) for part in parts] == [
        ("train_data_00000", "train", 1),
        ("train_data_00001", "train", 2),
    ]


def test_the_target_must_not_be_in_the_way(tmp_path, blocks):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    cases = {
        "is there already": (tmp_path / "full", "traceparts"),
        "is a file per part": (tmp_path / "out.h5", "traceparts"),
        "is a folder; give a file": (tmp_path / "full", "native"),
        "is not a folder": (tmp_path / "no" / "out.h5", "native"),
        "unknown format": (tmp_path / "out.h5", "ply"),
    }
    for words, (target, to) in cases.items():
        with pytest.raises(ValueError, match=words):
            run(blocks, target, to=to)
    for count in (0, 1 << 30):
        with pytest.raises(ValueError, match="points cannot be drawn"):
            run(blocks, tmp_path / "out.h5", num_points=count)
    with pytest.raises(ValueError, match="no lower-case word"):
        run(blocks, tmp_path / "out.h5", split="Test 1")
    assert [entry.name for entry in tmp_path.iterdir()] == ["full"]


def test_the_same_input_gives_the_same_bytes(tmp_path, blocks):
    for name in ("a.h5", "b.h5"):
        run(blocks, tmp_path / name, num_points=100)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert [part.split for part in read_all(tmp_path / "a.h5")] == ["train"] * 5 + ["val"] * 2
