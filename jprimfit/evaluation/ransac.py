"""Efficient RANSAC (Schnabel, Wahl, Klein 2007) as CGAL has it, the classical baseline, with PCA normals of our own.

The library takes no seed, so its answers differ from run to run; it moves the points about (labels are read from its
map by number), gives parameters of six digits from minimal samples, and has been seen to crash: it runs in a process of
its own. Settings are parts of the box's diagonal and of the number of points. Needs pip install 'jprimfit[baselines]'.
"""

import importlib.util
import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit.geometry import host
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

NOT_INSTALLED = "Efficient RANSAC needs CGAL, which is not installed: run pip install 'jprimfit[baselines]'."
PROBABILITY = 0.05  # of overlooking the largest candidate, CGAL's default
MIN_POINTS = 3
_NUMBER = r"-?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|nan|inf)"


class Settings(NamedTuple):
    """What is tuned. Lengths in diagonals of the box, least number of points in parts of all."""

    epsilon: float  # farthest distance of a point from its surface
    cluster: float  # widest gap within a surface
    min_share: float
    normal_threshold: float  # least cosine between the normals of point and surface
    neighbors: int  # k of the PCA normals


# The library's own habits, and the best found on clean and on noisy CAD clouds (30 training clouds of Fit4CAD).
SETTINGS = {
    "default": Settings(0.01, 0.01, 0.01, 0.9, 16),
    "tuned": Settings(0.001, 0.03, 0.002, 0.7, 12),
    "noise-0.5": Settings(0.0075, 0.02, 0.001, 0.8, 40),
    "noise-1": Settings(0.01, 0.02, 0.002, 0.7, 64),
}


class Detected(NamedTuple):
    """The answer for n points."""

    labels: Int[np.ndarray, "n"]  # int32 index into primitives, -1 = none
    primitives: tuple[Primitive, ...]  # as the library has them, not refitted
    normals: Float[np.ndarray, "n 3"]  # unit, PCA
    seconds: float  # of the normals and the detection, without handing the points over one by one


class Detector:
    """RANSAC in a process of its own, which lives as long as the block: `with Detector() as detect: detect(points)`."""

    def __init__(self, complain: Callable[[str], None] = lambda _: None):
        if importlib.util.find_spec("CGAL") is None:
            raise ValueError(NOT_INSTALLED)
        self._complain = complain
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Detector":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def __call__(self, points: Float[np.ndarray, "n 3"], settings: Settings = SETTINGS["tuned"]) -> Detected:
        """The surfaces of n points; none at all, and a complaint, where the library crashes."""
        points = np.asarray(points, np.float64)
        begin = time.perf_counter()
        normals = host.pca_normals(points, k=min(settings.neighbors, len(points))).normal
        seconds = time.perf_counter() - begin
        if self._pool is None:
            self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        try:
            labels, words, spent = self._pool.submit(_detect, points, normals, settings).result()
        except BrokenProcessPool:
            self._pool = None
            self._complain(f"CGAL crashed on a cloud of {len(points)} points, which counts as no answer.")
            return Detected(np.full(len(points), -1, np.int32), (), normals, seconds)
        return Detected(labels, tuple(map(parse, words)), normals, seconds + spent)


def parse(words: str) -> Primitive:
    """The primitive of a line such as "Type: cylinder center: (0, 0, 1) axis: (0, 0, 1) radius:0.5 #Pts: 3000"."""
    kind = words.split()[1]
    told = words.split("#")[0].split(kind, 1)[1]
    numbers = np.array([float(number) for number in re.findall(_NUMBER, told)])
    if kind == "plane":  # "(a, b, c)x - d= 0" stands for a x + b y + c z + d = 0, whatever the sign before d
        length = np.linalg.norm(numbers[:3])
        return Plane(numbers[:3] / length, np.float64(-numbers[3] / length))
    if kind == "sphere":
        return Sphere(numbers[:3], np.float64(numbers[3]))
    axis = numbers[3:6] / np.linalg.norm(numbers[3:6])
    if kind == "cylinder":
        return Cylinder(axis, numbers[:3], np.float64(numbers[6]))
    if kind == "cone":
        return Cone(axis, numbers[:3], np.float64(numbers[6]))
    raise ValueError(f"CGAL answered with {words!r}, which is none of the four kinds.")


def _detect(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], settings: Settings
) -> tuple[Int[np.ndarray, "n"], Sequence[str], float]:
    """Labels, the library's words for every shape, and its seconds; in a process of its own."""
    from CGAL.CGAL_Kernel import Point_3, Vector_3
    from CGAL.CGAL_Point_set_3 import Point_set_3
    from CGAL.CGAL_Shape_detection import efficient_RANSAC

    cloud = Point_set_3()
    cloud.add_normal_map()
    for point, normal in zip(points.tolist(), normals.tolist(), strict=True):
        cloud.insert(Point_3(*point), Vector_3(*normal))
    shape = cloud.add_int_map("shape")
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    least = max(MIN_POINTS, round(settings.min_share * len(points)))
    kinds = {"planes": True, "cones": True, "cylinders": True, "spheres": True, "tori": False}
    begin = time.perf_counter()
    words = efficient_RANSAC(
        cloud,
        shape,
        least,
        settings.epsilon * diagonal,
        settings.cluster * diagonal,
        settings.normal_threshold,
        PROBABILITY,
        *kinds.values(),
    )
    seconds = time.perf_counter() - begin
    return np.array([shape.get(row) for row in range(len(points))], np.int32), list(words), seconds
