"""PCD, the format of the Point Cloud Library, read by pypcd4 where the [formats] extra is installed.

Fields x y z are the points; normal_x normal_y normal_z their normals. Source: pointclouds.org, The PCD file format.
"""

from pathlib import Path

import numpy as np

from jprimfit.io.files import BadFile, Cloud, needs_formats


def read(path: Path) -> Cloud:
    """The cloud of a PCD file, rows of a structured cloud without a return (NaN) included."""
    try:
        from pypcd4.pypcd4 import PointCloud
    except ImportError:
        raise needs_formats(path, "pypcd4") from None
    cloud = PointCloud.from_path(path)
    if not {"x", "y", "z"} <= set(cloud.fields):
        raise BadFile(f"{path} has the fields {', '.join(cloud.fields)[:80]}, but x y z are needed: export it again.")
    if np.size(cloud.pc_data) != cloud.points:
        raise BadFile(
            f"{path} is truncated: its header announces {cloud.points} points, {np.size(cloud.pc_data)} are there."
        )
    if cloud.points == 0:
        raise BadFile(f"{path} holds no points: give a file with at least 4.")
    points = np.stack([np.ravel(cloud.pc_data[name]) for name in ("x", "y", "z")], axis=1).astype(np.float64)
    names = ("normal_x", "normal_y", "normal_z")
    if not set(names) <= set(cloud.fields):
        return Cloud(points, None)
    return Cloud(points, np.stack([np.ravel(cloud.pc_data[name]) for name in names], axis=1).astype(np.float64))
