"""Farthest-point sampling beside fpsample's kd-line: python tests/benchmarks/bm_sampling.py, or make bench.

Milliseconds of wall time, the fastest of several runs, compilation left out. h: fpsample's tree has 2^h buckets.
"""

import importlib.util
import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import sampling

CASES = ((8192, 512), (131072, 8192))
HEIGHTS = (3, 5, 7, 8, 9) if importlib.util.find_spec("fpsample") else ()


def milliseconds(function, *arguments, repeats=9):
    """Of the fastest run, after one that is not counted."""
    times = []
    for _ in range(1 + repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return min(times[1:])


def clouds(num_points):
    """The volume of a cube, which is the hardest case, and its surface, which is like a part."""
    random = np.random.default_rng(0)
    volume = random.random((num_points, 3)).astype(np.float32)
    surface = volume.copy()
    surface[np.arange(num_points), random.integers(0, 3, num_points)] = random.integers(0, 2, num_points)
    return {"volume": volume, "surface": surface}


def row(num_samples, cloud):
    """The cells of one cloud."""
    points = jnp.asarray(cloud)
    plain = jax.jit(partial(sampling.farthest_points, num_samples=num_samples))
    bucketed = jax.jit(partial(sampling.optimised_farthest_points, num_samples=num_samples))
    yield f"{milliseconds(plain, points, repeats=9 if len(cloud) < 1e5 else 1):.1f}"
    yield f"{milliseconds(bucketed, points):.1f}"
    yield "yes" if bool(jnp.all(plain(points) == bucketed(points))) else "NO"
    for height in HEIGHTS:
        from fpsample import bucket_fps_kdline_sampling

        yield f"{milliseconds(bucket_fps_kdline_sampling, cloud, num_samples, height, 0):.1f}"


@pytest.mark.benchmark
def test_report():
    titles = ["points", "samples", "cloud", "plain", "bucketed", "same", *(f"kdline {h}" for h in HEIGHTS)]
    sys.stdout.write("\n" + "".join(f"{title:>10}" for title in titles) + "   (ms)\n")
    for num_points, num_samples in CASES:
        for name, cloud in clouds(num_points).items():
            cells = [num_points, num_samples, name, *row(num_samples, cloud)]
            sys.stdout.write("".join(f"{cell:>10}" for cell in cells) + "\n")


if __name__ == "__main__":
    test_report()
