"""Stored programs: the answers of jit, kept for other processes, and nothing else wherever they cannot be."""

import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit import programs

ROOT = Path(__file__).resolve().parent.parent


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


@pytest.fixture
def folder(tmp_path):
    """A named folder, and no cache of JAX's: what comes out of that cannot be handed on."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    jax._src.compilation_cache.reset_cache()
    assert not programs.keep_in(tmp_path)
    yield tmp_path
    programs.keep_in(None)
    jax.config.update("jax_compilation_cache_dir", before)
    jax._src.compilation_cache.reset_cache()


def counted():
    """A function of a pair and a power, and how often it was traced."""
    traces = []

    def power(pair, *, exponent):
        traces.append(exponent)
        return Pair(pair.first**exponent, jnp.linalg.eigh(pair.second)[0])

    return traces, power


def pair(size, dtype=np.float32):
    return Pair(np.arange(1.0, size + 1, dtype=dtype), np.eye(size, dtype=dtype) + 0.5)


def files(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_a_kept_program_gives_the_answers_of_jit_without_being_traced_again(folder):
    traces, power = counted()
    expected = jax.jit(power, static_argnames="exponent")(pair(3), exponent=2)
    stored = partial(programs.stored, static_argnames="exponent")
    jax.tree.map(np.testing.assert_array_equal, stored(power)(pair(3), exponent=2), expected)
    assert programs.keep_in(folder) and len(files(folder)) == 1
    traces.clear()
    again = stored(power)  # as in a new process
    for _ in range(2):
        found = again(pair(3), exponent=2)
        assert isinstance(found, Pair)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert traces == [] and len(files(folder)) == 1


def test_every_shape_type_and_static_value_has_a_program(folder):
    _, power = counted()
    stored = programs.stored(power, static_argnames=("exponent",))
    assert stored(pair(3), exponent=2).first[2] == 9
    assert stored(pair(3), exponent=3).first[2] == 27
    assert stored(pair(4), exponent=2).first[3] == 16
    with jax.enable_x64(True):
        assert stored(pair(3, np.float64), exponent=2).first.dtype == np.float64
    assert stored(pair(3, np.float64), exponent=2).first.dtype == np.float32
    assert stored(jax.tree.map(jnp.asarray, pair(3)), exponent=2).first[2] == 9
    assert len(files(folder)) == 5


def test_what_cannot_be_kept_is_left_to_jit(folder):
    _, power = counted()
    stored = programs.stored(power, static_argnames="exponent")
    inside = jax.jit(lambda given: stored(given, exponent=2).first + 1)(pair(3))
    np.testing.assert_array_equal(inside, [2, 5, 10])
    assert stored(Pair(2.0, pair(3).second), exponent=2).first == 4  # a number has no type of its own
    assert jax.grad(lambda x: stored(Pair(x, pair(3).second), exponent=2).first)(3.0) == 6
    assert files(folder) == []
    programs.keep_in(None)
    stored(pair(3), exponent=2)
    assert files(folder) == []


def test_a_file_that_is_damaged_or_foreign_is_made_again(folder, monkeypatch):
    _, power = counted()
    stored = partial(programs.stored, power, static_argnames="exponent")
    expected = stored()(pair(3), exponent=2)
    [file] = files(folder)
    whole = file.read_bytes()
    for data in (b"", whole[:100], whole[:-1], whole[:500] + b"\1" + whole[501:], pickle.dumps("no program")):
        file.write_bytes(data)
        jax.tree.map(np.testing.assert_array_equal, stored()(pair(3), exponent=2), expected)
        assert files(folder) == [file] and programs._loaded(file) is not None  # written anew
    monkeypatch.setattr(os, "getuid", lambda: file.stat().st_uid + 1)
    assert programs._loaded(file) is None


def test_programs_of_another_code_are_removed_when_they_have_become_old(folder):
    old, young = folder / "old", folder / "young"
    for other in (old, young):
        other.mkdir()
        (other / "program").touch()
    os.utime(old, (0, 0))
    programs.keep_in(folder)
    assert not old.exists() and young.exists()


def test_a_new_process_loads_what_another_kept(tmp_path):
    code = (
        "import sys; from pathlib import Path; import numpy as np\n"
        "import jprimfit; from jprimfit import programs\n"
        "known = programs.keep_in(Path(sys.argv[1]))\n"
        "rng = np.random.default_rng(0); normals = rng.normal(size=(200, 3))\n"
        "normals /= np.linalg.norm(normals, axis=1, keepdims=True)\n"
        "found, _ = jprimfit.fit_primitive('sphere', 2.0 * normals + 1.0)\n"
        "print(known, found.radius.round(4), len(list(Path(sys.argv[1]).rglob('search-*'))))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    for known in (False, True):
        run = subprocess.run(
            [sys.executable, "-c", code, tmp_path], env=environment, capture_output=True, text=True, check=True
        )
        assert run.stdout.split() == [str(known), "2.0", "1"]


@pytest.mark.parametrize("kept", [False, True])
def test_what_is_prepared_is_not_traced_again(folder, kept):
    programs.keep_in(folder if kept else None)
    traces, power = counted()
    function = programs.stored(power, static_argnames="exponent")
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), pair(3))
    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            pool.submit(function.prepare, shapes, exponent=2)
        found = function(pair(3), exponent=2)
    assert traces == [2] and len(files(folder)) == kept
    np.testing.assert_allclose(found.first, pair(3).first ** 2)
