"""LAS and LAZ, the formats of airborne and terrestrial scanning, read by laspy[lazrs] where [formats] is installed.

Coordinates are scaled and shifted as the header says, in float64. Source: ASPRS, LAS Specification 1.4.
"""

from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Cloud, needs_formats


def read(path: Path) -> Cloud:
    """The cloud of a LAS or LAZ file, without normals (the format has none)."""
    try:
        import laspy
    except ImportError:
        raise needs_formats(path, "laspy") from None
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
