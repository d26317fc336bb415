"""Chunks cover what is wanted once, and the folder of a build belongs to its settings and its code."""

import contextlib
from collections import Counter

import pytest

from jprimfit.data import build, resume

WHOLE = {"train": 40, "val": 3, "test": 0}


def test_chunks_cover_the_first_parts_of_every_split_and_do_not_depend_on_how_many_are_wanted():
    whole, few = resume.chunks(WHOLE, WHOLE), resume.chunks({"train": 17, "val": 1, "test": 0}, WHOLE)
    assert whole == [("train", 0, 16), ("train", 16, 32), ("train", 32, 40), ("val", 0, 3)]
    assert few == [("train", 0, 16), ("train", 16, 32), ("val", 0, 3)]


def interrupt(path, mark):
    """Leaves a folder behind as a killed build does, with something in it."""
    with contextlib.suppress(KeyboardInterrupt), resume.entered(path, mark) as folder:
        (folder / "part").touch()
        raise KeyboardInterrupt


def refused(path, mark, words):
    with pytest.raises(ValueError, match=words), resume.entered(path, mark):
        pass


def test_parts_come_back_as_they_were_and_only_as_many_as_wanted(tmp_path):
    config = build.BuildConfig(seed=9)
    parts = [build.make(config, "val", index)[0] for index in range(3)]
    chunk = resume.Chunk("val", 0, 3)
    with resume.entered(tmp_path / "a.h5", "mark") as folder:
        assert folder == tmp_path / "a.h5.parts" and not resume.is_saved(folder, chunk)
        resume.save(folder, chunk, parts, Counter(clevis=2))
        assert resume.is_saved(folder, chunk) and resume.redrawn(folder, [chunk]) == Counter(clevis=2)
        assert not resume.is_saved(folder, resume.Chunk("val", 0, 2))
        loaded = list(resume.load(folder, [chunk], {"val": 2}))
        assert [part.name for part in loaded] == ["val_000000", "val_000001"]
        assert loaded[1].mesh.vertices.tobytes() == parts[1].mesh.vertices.tobytes()
        assert loaded[1].areas.tobytes() == parts[1].areas.tobytes() and loaded[1].scale == parts[1].scale


def test_a_folder_of_another_mark_is_refused_and_left_alone(tmp_path):
    interrupt(tmp_path / "a.h5", "one")
    with resume.entered(tmp_path / "a.h5", "one") as folder:
        assert (folder / "part").is_file()
    assert not folder.exists()
    interrupt(tmp_path / "a.h5", "one")
    refused(tmp_path / "a.h5", "two", "a.h5.parts holds parts of other settings")
    assert (folder / "part").is_file()
    (tmp_path / "b.h5.parts").mkdir()
    (tmp_path / "b.h5.parts" / "letter").touch()  # of somebody else
    refused(tmp_path / "b.h5", "one", "b.h5.parts holds parts of other settings")
    refused(tmp_path / "absent" / "a.h5", "one", "is not a folder; make it first")
    assert resume.mark_of({"seed": 1}) == resume.mark_of({"seed": 1}) != resume.mark_of({"seed": 2})


def test_only_one_build_works_at_a_goal_and_a_failed_one_leaves_nothing(tmp_path):
    with resume.entered(tmp_path / "a.h5", "mark") as folder:
        refused(tmp_path / "a.h5", "mark", "Another process is building .*a.h5: wait for it, or change --out.")
        assert folder.is_dir()
    with pytest.raises(ValueError, match="no such part"), resume.entered(tmp_path / "a.h5", "mark"):
        raise ValueError("no such part")
    assert not folder.exists()
    folder.mkdir()  # killed before it could mark it
    (folder / "made-by").touch()
    with resume.entered(tmp_path / "a.h5", "mark"):
        pass
