"""Common ground of the tests: shape checks on, warnings are errors, one compilation cache, one tolerance table."""

import gc
import importlib.util
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import pytest

ROOT = Path(__file__).resolve().parent.parent
jax.config.update("jax_compilation_cache_dir", os.environ.get("JPRIMFIT_CACHE", str(ROOT / ".cache" / "jax")))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
jax.config.update("jax_numpy_rank_promotion", "raise")

if importlib.util.find_spec("beartype"):
    from jaxtyping import install_import_hook

    install_import_hook("jprimfit", "beartype.beartype")

# The largest error that rounding alone explains, for quantities of size one: absolute, by dtype.
TOLERANCE = {"float32": 2e-5, "float64": 1e-10}


# Linux allows a process 65,530 memory maps; every compiled program holds some, and beyond the limit XLA crashes.
MAPS, MAX_MAPS = Path("/proc/self/maps"), 30_000


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Forgets the compiled programs of earlier files before there are too many."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MAX_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def tolerance():
    """Absolute tolerance by dtype name, for quantities of size one."""
    return TOLERANCE


@pytest.fixture
def x64():
    """Switches float64 on for one test."""
    with jax.enable_x64(True):
        yield
