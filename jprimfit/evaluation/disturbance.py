"""What a scanner does to the clean clouds of a benchmark: turned, thinned, noisy, with points that lie on nothing.

What is drawn hangs on the name of the cloud alone, so that every method and every run is given the same.
"""

import numpy as np

from jprimfit.data.fit4cad import BenchmarkCloud


def disturbed(
    cloud: BenchmarkCloud, *, rotate: bool = False, noise: float = 0.0, thin: float = 100.0, outliers: float = 0.0
) -> BenchmarkCloud:
    """The cloud after all that is asked for, its instances following their points.

    Args:
        cloud: of the benchmark.
        rotate: turn it at random.
        noise: sigma of every coordinate in per cent of the diagonal of the cloud's box.
        thin: per cent of the points that are kept, at random.
        outliers: points added evenly in the box, in per cent of those kept; they belong to no instance.
    """
    generator = np.random.default_rng(list(cloud.name.encode()))
    points, members = cloud.points, cloud.members
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if rotate:
        turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
        points = points @ (turn * np.sign(np.linalg.det(turn)))
    if noise > 0:
        points = points + generator.normal(size=points.shape) * diagonal * noise / 100
    if thin < 100:
        kept = np.sort(generator.permutation(len(points))[: max(1, round(len(points) * thin / 100))])
        place = np.full(len(points), -1)
        place[kept] = np.arange(len(kept))
        points, members = points[kept], tuple(place[rows][place[rows] >= 0] for rows in members)
    if outliers > 0:
        lowest, highest = points.min(axis=0), points.max(axis=0)
        count = round(len(points) * outliers / 100)
        points = np.concatenate([points, generator.uniform(lowest, highest, (count, 3))])
    return cloud._replace(points=points, members=members)
