"""The digest of what an HDF5 file says, whatever its chunks, packing, byte order and unused space."""

import hashlib
import math
import os

from jprimfit.data.hdf5 import Source

_MAX_DEPTH = 4  # groups in groups; ours have one level, and a group that contains itself never ends
_BLOCK_BYTES = 8 << 20


def content_hash(path: str | os.PathLike) -> str:
    """SHA-256 in hex over names, types, shapes and values of all attributes of groups and all arrays, ordered by name.

    Equal for two files of equal content, so it shows that a build is reproducible. ValueError for a damaged file, and
    for one with links, arrays of other types than numbers and bytes, or groups deeper than four levels.
    """
    digest = hashlib.sha256()
    with Source(path) as source:
        _add_group(digest, source, "", depth=0)
    return digest.hexdigest()


def _add_group(digest: "hashlib._Hash", source: Source, group: str, *, depth: int) -> None:
    if depth > _MAX_DEPTH:
        raise ValueError(f"{source.path} cannot be used: its groups contain each other more than {_MAX_DEPTH} deep.")
    for name in source.attribute_names(group):
        digest.update(f"attribute {group}/{name} {source.attribute(group, name)!r}\n".encode())
    for name, kind in source.children(group).items():
        inner = f"{group}/{name}".lstrip("/")
        digest.update(f"{kind} {inner}\n".encode())
        if kind == "group":
            _add_group(digest, source, inner, depth=depth + 1)
        else:
            _add_array(digest, source, inner)


def _add_array(digest: "hashlib._Hash", source: Source, name: str) -> None:
    array = source.array(name)
    digest.update(f"{array.dtype.newbyteorder('<').str} {array.shape}\n".encode())
    step = max(1, _BLOCK_BYTES // max(1, array.dtype.itemsize * math.prod(array.shape[1:])))
    for start in range(0, len(array), step):
        rows = array.read(start, min(start + step, len(array)))
        digest.update(rows.astype(rows.dtype.newbyteorder("<"), copy=False).tobytes())
