"""Where jprimfit keeps what it may lose: compiled programs, later data sets built on demand.

The folder is $JPRIMFIT_CACHE, else jprimfit in the user's cache folder (XDG base directory specification).
"""

import contextlib
import os
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """The user's cache folder of jprimfit; it need not exist."""
    given = os.environ.get("JPRIMFIT_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    # The specification wants relative paths ignored.
    return (Path(base) if base and Path(base).is_absolute() else Path("~/.cache").expanduser()) / "jprimfit"


def use_programs() -> bool:
    """Lets the programs of a fit be kept in `cache_folder()/programs`; True where it has those of this version.

    Where they cannot, and where the user set up a cache for JAX, that of `use_compilation_cache` serves instead: JAX
    cannot hand on whole what it took from its own cache.
    """
    import jax

    from jprimfit import programs

    if not jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        with contextlib.suppress(OSError, RuntimeError):
            return programs.keep_in(cache_folder() / "programs")
    use_compilation_cache()
    return True


def use_compilation_cache() -> Path | None:
    """Lets JAX keep compiled programs in `cache_folder()/xla`, so that a second run starts fast; returns that folder.

    None, and no error, where the folder cannot be written. A cache that the user set up for JAX stays as it is.
    """
    import jax

    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if given:
        return Path(given)
    with contextlib.suppress(OSError, RuntimeError):  # RuntimeError: no home folder
        folder = cache_folder() / "xla"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # The default leaves out what compiles in under a second, and that is most of what fit needs.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        return folder
    return None
