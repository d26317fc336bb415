"""E57, the exchange format of laser scanners, read by pye57 where the [formats] extra is installed.

All scans of a file are taken together, each moved by its pose into the common frame. Source: ASTM E2807.
"""

from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Cloud, needs_formats


def read(path: Path) -> Cloud:
    """The points of all scans of an E57 file, those marked invalid left out, without normals."""
    try:
        import pye57
    except ImportError:
        raise needs_formats(path, "pye57") from None
    with pye57.E57(str(path)) as file:
        scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
    axes = ("cartesianX", "cartesianY", "cartesianZ")
    points = [np.stack([np.asarray(scan[axis], np.float64) for axis in axes], axis=1) for scan in scans]
    if sum(len(scan) for scan in points) == 0:
        raise BadFile(f"{path} holds no points: give a file with at least 4.")
    return Cloud(np.concatenate(points), None)
