"""Timings of the default hierarchy of an 8,192-point cloud on both paths: make bench."""

import sys
import time

import jax
import numpy as np
import pytest

from jprimfit.geometry import hierarchy, host

SPEC = hierarchy.HierarchySpec()


@pytest.mark.benchmark
@pytest.mark.parametrize(
    "name,function", [("jitted", jax.jit(hierarchy.build, static_argnames="spec")), ("host", host.build_hierarchy)]
)
def test_hierarchy_of_8192_points(name, function):
    points = np.random.default_rng(0).normal(size=(8192, 3))
    points = (points / np.sqrt((points**2).sum(axis=1, keepdims=True))).astype(np.float32)
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        jax.block_until_ready(function(points, spec=SPEC))
        seconds.append(time.perf_counter() - start)
    sys.stdout.write(f"\nhierarchy, {name:17s} {1e3 * min(seconds):8.0f} ms\n")
