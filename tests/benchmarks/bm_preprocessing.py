"""Timings of what runs once per scan, at 131,072 points, beside scipy's bare search: make bench."""

import sys
import time

import numpy as np
import pytest
from scipy.spatial import KDTree

from jprimfit.geometry import host
from jprimfit.preprocessing.outliers import find_outliers, statistical_filter
from jprimfit.preprocessing.smoothing import gaussian_smooth
from jprimfit.preprocessing.steps import preprocess

NUM_POINTS = 131_072


def noisy_sphere(num_points):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(num_points, 3))
    points /= np.sqrt((points**2).sum(axis=1, keepdims=True))
    return points + 0.003 * rng.normal(size=points.shape)


@pytest.mark.benchmark
@pytest.mark.parametrize(
    "name,function",
    [
        ("scipy KDTree, k = 16", lambda points: KDTree(points).query(points, k=16, workers=-1)),
        ("host.knn, k = 16", lambda points: host.knn(points, points, k=16)),
        ("host.pca_normals, k = 16", lambda points: host.pca_normals(points, k=16)),
        ("outlier filter on", statistical_filter),
        ("outlier filter auto", find_outliers),
        ("smoothing", gaussian_smooth),
        ("preprocess, all steps", lambda points: preprocess(points, smooth=True)),
    ],
)
def test_at_131072_points(name, function):
    points, seconds = noisy_sphere(NUM_POINTS), []
    for _ in range(4):
        start = time.perf_counter()
        function(points)
        seconds.append(time.perf_counter() - start)
    sys.stdout.write(f"\n{name:28s} {1e3 * min(seconds):8.0f} ms\n")
