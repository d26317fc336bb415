"""Compiled programs that a later process loads as they are, where a folder for them was named.

JAX's own cache saves a new process the compiler, but not tracing and lowering, which cost more for programs as small as
those of a fit. Here the executable itself is kept, under a digest of all it depends on: the function and the code of
this package, types and shapes, JAX, the processor. What cannot be loaded is compiled again. The files are pickles of
JAX's making (jax.experimental.serialize_executable), so only those that belong to this user are opened.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import platform
import shutil
import threading
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy
import numpy as np
from jax.experimental import serialize_executable

MAX_AGE = 30 * 86_400.0  # seconds: programs of another version of the code that were not used for so long are removed

_folder: Path | None = None


def keep_in(folder: Path | None) -> bool:
    """Names the folder, which is made, for this process, or None for none; says whether programs are there already.

    OSError where it cannot be written.
    """
    global _folder
    _folder = None
    if folder is None:
        return False
    own = folder / _code()[:16]
    own.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.utime(own)
    if not os.access(own, os.W_OK):
        raise PermissionError(f"{own} cannot be written")
    for other in folder.iterdir():
        if time.time() - other.stat().st_mtime > MAX_AGE:
            shutil.rmtree(other, ignore_errors=True)
    _folder = own
    return any(own.iterdir())


def stored(function: Callable[..., Any], *, static_argnames: str | Sequence[str] = ()) -> Callable[..., Any]:
    """jax.jit(function, static_argnames=...) whose programs are kept; static arguments are given by name, arrays not.

    Static values must be told apart by their repr. Called by other code under jit, it is jit. `prepare`, of the same
    arguments or of ShapeDtypeStructs, has the program ready for a later call, which waits for it if a thread prepares.
    """
    jitted = jax.jit(function, static_argnames=static_argnames)
    names = {static_argnames} if isinstance(static_argnames, str) else set(static_argnames)
    programs: dict[Any, Any] = {}
    begun: dict[Any, threading.Lock] = defaultdict(threading.Lock)

    def program(device: Any, *arrays: Any, **static: Any) -> Any:
        leaves, tree = jax.tree.flatten(arrays)
        types = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        key = tree, types, tuple(sorted(static.items())), x64, device
        if key not in programs:
            with begun[key]:
                if key not in programs:
                    words = function.__module__, function.__qualname__, str(tree), str(types), key[2], x64
                    name = f"{function.__name__}-{_digest(*words, device.platform, device.device_kind)}"
                    file = None if _folder is None else _folder / name
                    programs[key] = _loaded(file) or _made(file, jitted.lower(*arrays, **static).compile())
        return programs[key]

    @functools.wraps(function)
    def call(*arrays: Any, **static: Any) -> Any:
        device = _device()
        if set(static) != names or not all(_is_there(leaf, device) for leaf in jax.tree.leaves(arrays)):
            return jitted(*arrays, **static)
        return program(device, *arrays, **static)(*arrays)

    def prepare(*arrays: Any, **static: Any) -> None:
        program(_device(), *arrays, **static)

    call.prepare = prepare  # pyright: ignore[reportAttributeAccessIssue]
    return call


def _device() -> Any:
    return jax.config.jax_default_device or jax.local_devices()[0]  # pyright: ignore[reportAttributeAccessIssue]


def _is_there(leaf: Any, device: Any) -> bool:
    """Whether an argument is an array of values on the host or on the device, not a number or what a trace has."""
    if isinstance(leaf, np.ndarray | np.generic):
        return True
    if not isinstance(leaf, jax.Array) or isinstance(leaf, jax.core.Tracer) or leaf.aval.weak_type:  # pyright: ignore[reportAttributeAccessIssue]
        return False
    return leaf.devices() == {device}


def _loaded(file: Path | None) -> Any:
    """The program in a file; None where there is none, or none that this user wrote whole and JAX can load."""
    if file is None:
        return None
    with contextlib.suppress(Exception):  # whatever JAX and pickle raise
        if hasattr(os, "getuid") and file.stat().st_uid != os.getuid():
            return None
        data = file.read_bytes()
        if hashlib.sha256(data[32:]).digest() == data[:32]:
            _prepare_lapack()
            return serialize_executable.deserialize_and_load(*pickle.loads(data[32:]))
    return None


@functools.cache
def _prepare_lapack() -> None:
    """JAX looks up LAPACK's functions when it lowers a call of one; a loaded program that calls one would crash."""
    jax.jit(jax.numpy.linalg.eigh).lower(np.eye(2, dtype=np.float32))


def _made(file: Path | None, program: Any) -> Any:
    """The program, which is kept in the file where that is possible."""
    if file is None:
        return program
    with contextlib.suppress(Exception):  # not every backend can serialise
        data = pickle.dumps(serialize_executable.serialize(program))
        partial = file.with_name(f".{uuid.uuid4().hex}")
        try:
            partial.write_bytes(hashlib.sha256(data).digest() + data)
            os.replace(partial, file)
        finally:
            partial.unlink(missing_ok=True)
    return program


def _digest(*words: Any) -> str:
    return hashlib.sha256(repr((*words, _machine())).encode()).hexdigest()[:32]


@functools.cache
def _machine() -> tuple[str, ...]:
    """What a program is compiled for and by."""
    flags = ""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    versions = jax.__version__, metadata.version("jaxlib"), platform.python_version()
    return *versions, platform.machine(), flags, os.environ.get("XLA_FLAGS", ""), str(os.cpu_count())


@functools.cache
def _code() -> str:
    """A digest of the code of this package."""
    home, digest = Path(__file__).parent, hashlib.sha256()
    for file in sorted(home.rglob("*.py")):
        digest.update(str(file.relative_to(home)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()
