"""LAS and LAZ, the formats of airborne and terrestrial scanning, read by laspy[lazrs] where [formats] is installed.

Coordinates are scaled and shifted as the header says, in float64. Source: ASPRS, LAS Specification 1.4.
"""

import struct
from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Cloud, needs_formats


def read(path: Path) -> Cloud:
    """The cloud of a LAS or LAZ file, without normals (the format has none)."""
    try:
        import laspy
    except ImportError:
        raise needs_formats(path, "laspy") from None
    _check_header(path)
    try:
        points = np.asarray(laspy.read(path).xyz, np.float64)
    except BaseException as error:
        # lazrs, written in Rust, raises its panics beside Exception.
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise BadFile(f"{path} cannot be read as LAS or LAZ ({type(error).__name__}): export it again.") from None
        raise
    if len(points) == 0:
        raise BadFile(f"{path} holds no points: give a file with at least 4.")
    return Cloud(points, None)


def _check_header(path: Path) -> None:
    """BadFile where the header announces more than the file can hold: laspy would read on for hours."""
    with open(path, "rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise BadFile(f"{path} is not a LAS or LAZ file: export the scan again.")
    size = path.stat().st_size
    start, num_records = struct.unpack_from("<II", head, 96)
    fits = start <= size and 54 * num_records <= size
    if head[25] >= 4 and len(head) == 375:  # LAS 1.4 has extended records too
        extended_start, num_extended = struct.unpack_from("<QI", head, 235)
        fits = fits and extended_start <= size and 60 * num_extended <= size
    if not fits:
        raise BadFile(
            f"{path} is truncated or damaged: its header announces more than its {size} bytes; copy it again."
        )
