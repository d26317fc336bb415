import h5py
import numpy as np
import pytest

from jprimfit.data.digest import content_hash


def _file(path, values, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("group/x", data=values, **options)
        file["group"].attrs["unit"] = "mm"
    return path


def test_only_content_counts(tmp_path):
    values = np.arange(3000.0).reshape(-1, 3)
    plain = content_hash(_file(tmp_path / "a.h5", values))
    assert len(plain) == 64 and plain == content_hash(
        _file(tmp_path / "b.h5", values, chunks=(7, 3), compression="gzip")
    )
    assert plain == content_hash(_file(tmp_path / "c.h5", values.astype(">f8")))
    others = [values + 1e-12 * (values == 5), values.astype("f4"), values.reshape(3, -1)]
    digests = {content_hash(_file(tmp_path / f"{row}.h5", other)) for row, other in enumerate(others)}
    assert len(digests | {plain}) == 4
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["group"].attrs["unit"] = "m"
    assert content_hash(tmp_path / "a.h5") != plain


def test_a_group_in_itself_ends(tmp_path):
    path = _file(tmp_path / "a.h5", np.arange(3))
    with h5py.File(path, "a") as file:
        file["group/again"] = file["/"]
    with pytest.raises(ValueError, match="contain each other"):
        content_hash(path)
