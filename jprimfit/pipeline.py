"""The paper's Figure 1 in one function: preprocess -> features -> segment -> fit -> refine.

No network is shipped yet, so the middle is the geometric segmentation of fitting/geometric, which finds faces and
fits them in one; `model=None` asks for it by name. Everything between the first and the last line happens in the
normalised frame; the scene is in the unit and frame of the input.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jprimfit import checks
from jprimfit.fitting import geometric, kinds
from jprimfit.geometry import host
from jprimfit.scene import Scene

Progress = Callable[[str, int, int], None]


def fit(
    points: Any,
    normals: Any = None,
    *,
    model: str | None = "default",
    seed: int = 0,
    filter: str = "auto",
    smooth: bool = False,
    progress: Progress | None = None,
) -> Scene:
    """The primitives of a scan: points (n, 3), any unit, any position."""
    usable = checks.usable_rows(points, normals)
    begin = time.perf_counter()
    frame_points, frame = host.normalize(usable.points)
    found = geometric.segment(frame_points.astype(np.float64), seed=seed)
    primitives = tuple(kinds.move(p, frame.center, frame.scale) for p in found.primitives)
    num = len(np.asarray(points))
    labels = np.full(num, -1, np.int32)
    labels[usable.rows] = found.labels
    all_normals = np.full((num, 3), np.nan)
    all_normals[usable.rows] = found.normals
    distances = np.full(num, np.nan)
    return Scene(
        np.asarray(points, float),
        labels,
        primitives,
        found.surface_of,
        all_normals,
        distances,
        noise=found.noise * frame.scale,
        report={"seconds": time.perf_counter() - begin},
    )
