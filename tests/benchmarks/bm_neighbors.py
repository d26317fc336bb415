"""Exact neighbour search beside scipy's kd-tree: python tests/benchmarks/bm_neighbors.py, or make bench.

Seconds of wall time, the fastest of several runs, compilation left out; the kd-tree with its construction, on all
cores, through geometry/host.
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host, neighbors

CASES = ((8192, 8192), (131072, 1024), (131072, 131072))
NUM_NEIGHBORS = 32


def seconds(function, *arguments, repeats):
    """Of the fastest run."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


@pytest.mark.benchmark
def test_report():
    searches = {
        "knn": partial(neighbors.knn, k=NUM_NEIGHBORS),
        "ball": partial(neighbors.ball, k=NUM_NEIGHBORS, radius=0.05),
    }
    sys.stdout.write(
        "\n" + "".join(f"{title:>10}" for title in ("points", "queries", "k", "host", *searches)) + "   (s)\n"
    )
    for num_points, num_queries in CASES:
        cloud = np.random.default_rng(0).random((num_points, 3)).astype(np.float32)
        queries, points = jnp.asarray(cloud[:num_queries]), jnp.asarray(cloud)
        repeats = 5 if num_points * num_queries < 1e9 else 1
        cells = [seconds(partial(host.knn, k=NUM_NEIGHBORS), cloud[:num_queries], cloud, repeats=repeats)]
        for search in searches.values():
            compiled = jax.jit(search).lower(queries, points).compile()
            cells.append(seconds(compiled, queries, points, repeats=repeats))
        numbers = (num_points, num_queries, NUM_NEIGHBORS, *(f"{cell:.3f}" for cell in cells))
        sys.stdout.write("".join(f"{number:>10}" for number in numbers) + "\n")


if __name__ == "__main__":
    test_report()
