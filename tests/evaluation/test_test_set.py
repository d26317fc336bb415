"""The test set is built whole, whoever else is building it in the same folder."""

import os

from jprimfit.data.build import seeded_test_set
from jprimfit.data.native import Dataset
from jprimfit.evaluation import test_set


def test_another_build_in_the_same_folder_does_not_matter(tmp_path, monkeypatch):
    monkeypatch.setattr(test_set, "CONFIG", seeded_test_set(2))
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    path = test_set.path_in(tmp_path)
    other = path.with_name(path.name + ".parts")
    other.mkdir()
    (other / "made-by").write_text("another build")
    assert test_set.build_in(tmp_path) == path
    with Dataset(path) as dataset:
        assert len(dataset) == 2
    assert sorted(tmp_path.iterdir()) == [path, other]
