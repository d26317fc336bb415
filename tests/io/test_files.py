"""Files appear whole or not at all; columns are taken for normals only on evidence; polygons become fans."""

from pathlib import Path

import numpy as np
import pytest

from jprimfit.io.files import cloud_of_columns, fans, replacing


def test_a_block_that_ends_well_replaces_the_file(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with replacing(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_block_that_fails_leaves_no_trace(tmp_path, error):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), replacing(path) as file:
        file.write(b"half")
        raise error
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_few_missing_normals_do_not_hide_the_others():
    table = np.tile([1.0, 2, 3, 0, 0, 1], (200, 1))
    table[:3, 3:] = [[0, 0, 0], [np.nan, 0, 0], [np.inf, 1, 1]]
    assert cloud_of_columns(table, Path("a")).normals is not None
    table[:20, 3:] = 0
    assert cloud_of_columns(table, Path("a")).normals is None


def test_fans_keep_the_first_corner():
    assert fans([]).shape == (0, 3)
    assert fans([np.array([4, 5]), np.array([7])]).shape == (0, 3)
    assert fans([np.array([[0, 1, 2, 3], [4, 5, 6, 7]])]).tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert fans([np.array([0, np.nan, 2])]).tolist() == [[0, -1, 2]]
