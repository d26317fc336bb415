"""The cache: where it is, and that a folder that cannot be written is no failure."""

from pathlib import Path

import jax
import pytest

from jprimfit.apps.cache import cache_folder, use_compilation_cache


@pytest.fixture
def unset(monkeypatch):
    """JAX without a compilation cache, put back afterwards."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    yield monkeypatch
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JPRIMFIT_CACHE", raising=False)
    assert cache_folder() == tmp_path / "jprimfit"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == Path.home() / ".cache" / "jprimfit"
    monkeypatch.setenv("JPRIMFIT_CACHE", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"


def test_the_cache_is_set_up_where_it_can_be_written(unset, tmp_path):
    unset.setenv("JPRIMFIT_CACHE", str(tmp_path))
    assert use_compilation_cache() == tmp_path / "xla"
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "xla") and list((tmp_path / "xla").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_left_out(unset, tmp_path):
    (tmp_path / "file").write_text("")
    unset.setenv("JPRIMFIT_CACHE", str(tmp_path / "file"))
    assert use_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_a_cache_of_the_user_stays(unset, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    assert use_compilation_cache() == tmp_path / "theirs"
    assert not (tmp_path / "theirs").exists()
