"""One cloud of a training pool: drawn from a part, turned, made noisy, normalised and prepared, all from its number.

The frame is the normalised one of the noisy points: the truth moves with them. What is random comes from generators
seeded by (pool seed, number of the cloud), so a cloud does not depend on the others. Letters: n points, g sizes of
neighbourhood, i instances at most, m samples each.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from jprimfit.data import records, scanning, surfaces
from jprimfit.data.examples import Example, Scan
from jprimfit.data.native import Dataset
from jprimfit.data.noise import perturb
from jprimfit.data.records import BACKGROUND, KINDS, Cloud, Part
from jprimfit.geometry import host
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.geometry.preparation import prepare
from jprimfit.types import Truth

SCANNING = ("density_share", "density_ratio", "partial_share", "viewpoints", "outliers")  # settings of scanning.py
_SURFACE, _SETTING, _SCAN, _QUERY = 0, 1, 2, 3  # streams of random numbers of one cloud


@dataclass(frozen=True)
class LoaderConfig:
    """Which clouds a network sees. Lengths in the normalised frame; a pair is a range to draw from.

    The longest side of a cloud's box is 2 there, so that 0.02 is noise of 1 per cent of it; noise.sigma_of_percent
    turns per cent of the diagonal, as in `--noise`, into a length.
    """

    file: str = ""  # the dataset
    split: str = "train"
    num_points: int = 8192  # of a cloud, padding included
    num_query: int = 2048  # points of a cloud at which the network is asked; 0 = all
    num_clouds: int = 0  # drawn into the pool, from parts at even steps or all in turn; 0 = one per part
    rotate: bool = True  # turn every cloud at random, once in the pool and once more in every batch
    noise: Literal["drawn", "stored"] = "drawn"  # stored = the noisy points of a dataset that has them
    uniform_noise: tuple[float, float] = (0.01, 0.01)  # half-width along the normal; the paper's Table 1
    gaussian_noise: tuple[float, float] = (0.0, 0.0)  # standard deviation, isotropic
    gaussian_share: float = 0.0  # of the clouds have Gaussian noise, the others uniform
    thin_share: float = 0.0  # of the clouds have fewer points: their number is log-uniform from min_points
    min_points: int = 512
    density_share: float = 0.0  # of the clouds get thinner along a random direction, log-linearly
    density_ratio: tuple[float, float] = (2.0, 10.0)  # of the densities at the two ends, log-uniform
    partial_share: float = 0.0  # of the clouds are what is seen from some viewpoints; needs meshes
    viewpoints: tuple[int, int] = (1, 4)
    outliers: tuple[float, float] = (0.0, 0.0)  # share of a cloud's points that are astray, labelled background
    max_instances: int = 32  # parts with more are left out
    num_samples: int = 0  # clean points on each instance, for the residual loss; 0 = none
    pool_seed: int = 0  # of the clouds; trainings that differ in their own seed only share a pool
    cache: str = ""  # folder for pools; "" = the folder `pools` beside the file
    workers: int = -1  # processes that build the pool or draw fresh clouds; 0 = this one, -1 = one for each core
    feed: Literal["pool", "fresh"] = "pool"  # of a training: its clouds from the pool, or drawn for every step anew

    def __post_init__(self) -> None:
        smallest = {"num_points": 1, "num_query": 0, "num_clouds": 0, "num_samples": 0, "pool_seed": 0, "workers": -1}
        for name, low in (smallest | {"max_instances": 1, "min_points": 1}).items():
            if getattr(self, name) < low:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least {low}.")
        if max(self.num_query, self.min_points if self.thin_share else 0) > self.num_points:
            raise ValueError(
                f"num_query is {self.num_query} and min_points {self.min_points}, expected at most the "
                f"{self.num_points} of num_points."
            )
        for name in ("gaussian_share", "thin_share", "density_share", "partial_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a share from 0 to 1.")
        for name in ("uniform_noise", "gaussian_noise"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high < math.inf:
                raise ValueError(f"{name} is {[low, high]}, expected two lengths, the smaller first.")
        for name, least, most in (("density_ratio", 1, math.inf), ("viewpoints", 1, 100), ("outliers", 0, 0.9)):
            low, high = getattr(self, name)
            if not (least <= low <= high <= most and high < math.inf):
                raise ValueError(f"{name} is {[low, high]}, expected two numbers from {least} to {most}, ascending.")
        if self.max_instances > np.iinfo(np.int16).max:
            raise ValueError(f"max_instances is {self.max_instances}, expected at most {np.iinfo(np.int16).max}.")


def usable_parts(dataset: Dataset, config: LoaderConfig) -> tuple[np.ndarray, int]:
    """Numbers of the parts of the split with 1 to max_instances instances, and how many others it has.

    ValueError if the dataset has no such split, or the split no such part.
    """
    if config.split not in dataset.splits:
        found = ", ".join(sorted(dataset.splits)) or "none"
        raise ValueError(f"{dataset.path} has no split {config.split!r}; it has {found}.")
    parts = dataset.splits[config.split]
    counts = np.diff(dataset.starts.get("instance", np.zeros(len(dataset) + 1, np.int64)))[parts]
    usable = parts[(counts >= 1) & (counts <= config.max_instances)]
    if len(usable) == 0:
        raise ValueError(
            f"{dataset.path} has no part with 1 to {config.max_instances} instances in split {config.split!r}; "
            "raise max_instances."
        )
    return usable, len(parts) - len(usable)


def draw_example(
    part: Part,
    *,
    config: LoaderConfig,
    spec: HierarchySpec,
    neighborhoods: tuple[int, ...],
    number: int,
    workers: int = 1,
) -> Example:
    """Cloud `number` of a pool, drawn from this part: an Example whose queries are all of its points.

    Its random rotation, if any, is part of the frame. The same arguments give the same bytes on one machine.
    """
    scan = draw_scan(part, config=config, seed=(config.pool_seed, number))
    valid = scan.points[: np.count_nonzero(scan.mask)]
    prepared = prepare(valid, spec=spec, neighborhoods=neighborhoods, num_points=config.num_points, workers=workers)
    return Example(*prepared, query=scan.query, truth=scan.truth)


def draw_scan(part: Part, *, config: LoaderConfig, seed: tuple[int, int]) -> Scan:
    """One cloud drawn from this part, without anything that needs a search; its queries are all of its points."""
    generator = np.random.default_rng([*seed, _SETTING])
    part, cloud, astray = _seen(part, _num_valid(generator, config), config, seed)
    rotation = random_rotation(generator) if config.rotate else np.eye(3)
    _, clean = host.normalize(cloud.points @ rotation.T)
    noisy = _noisy(generator, part, cloud, rotation, clean, config)
    if astray:
        noisy, cloud = scanning.scatter(generator, noisy, cloud, share=astray)
    points, frame = host.normalize(noisy)
    mask = np.arange(config.num_points) < len(points)
    samples = None
    if cloud.samples is not None:
        flat = clean.from_input(cloud.samples.reshape(-1, 3) @ rotation.T)
        samples = frame.from_input(flat).reshape(cloud.samples.shape)
    padded = np.concatenate([points, np.repeat(points[:1], config.num_points - len(points), axis=0)])
    truth = _truth(part, cloud, samples, rotation, mask, config)
    return Scan(padded, mask, np.arange(config.num_points, dtype=np.int32), truth)


def draw_queried(part: Part, *, config: LoaderConfig, seed: tuple[int, int]) -> Scan:
    """draw_scan, asked at num_query points of the cloud."""
    scan = draw_scan(part, config=config, seed=seed)
    generator = np.random.default_rng([*seed, _QUERY])
    query = choose_queries(generator, int(np.count_nonzero(scan.mask)), config=config)
    truth = scan.truth
    asked = truth._replace(mask=truth.mask[query], normals=truth.normals[query], labels=truth.labels[query])
    return scan._replace(query=query, truth=asked)


def choose_queries(generator: np.random.Generator, num_valid: int, *, config: LoaderConfig) -> Int[np.ndarray, "q"]:
    """num_query rows without repetition, ascending; padding only where the valid points do not suffice."""
    num_points, num_query = config.num_points, config.num_query
    if num_query in (0, num_points):
        return np.arange(num_points, dtype=np.int32)
    chosen = generator.choice(num_valid, min(num_query, num_valid), replace=False, shuffle=False)
    filling = np.arange(num_valid, num_valid + num_query - len(chosen))
    return np.concatenate([np.sort(chosen), filling]).astype(np.int32)


def random_rotation(generator: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """A rotation matrix, float64, of uniform distribution: of a quaternion uniform on its sphere (Shoemake 1992)."""
    quaternion = generator.standard_normal(4)
    w, x, y, z = quaternion / math.sqrt(quaternion @ quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _num_valid(generator: np.random.Generator, config: LoaderConfig) -> int:
    thin, place = generator.random(2)
    if thin >= config.thin_share:
        return config.num_points
    return round(config.min_points * (config.num_points / config.min_points) ** place)


def _seen(part: Part, count: int, config: LoaderConfig, seed: tuple[int, int]) -> tuple[Part, Cloud, float]:
    """The part with the instances that are seen, its cloud, and the share of points that will be astray."""
    # A stream of its own: where a cloud gets no such effect, it is the same as without the settings.
    generator = np.random.default_rng([*seed, _SCAN])
    thins, partial = generator.random(2) < (config.density_share, config.partial_share)
    astray = generator.uniform(*config.outliers)
    if not (thins or partial):
        cloud = surfaces.draw(part, num_points=count, seed=[*seed, _SURFACE], num_samples=config.num_samples)
        return part, cloud, astray
    falloff, viewpoints = None, None
    if thins:
        ratio = math.exp(generator.uniform(*np.log(config.density_ratio)))
        falloff = scanning.Falloff(scanning.random_unit(generator, 1)[0], ratio)
    if partial:
        num = int(generator.integers(config.viewpoints[0], config.viewpoints[1] + 1))
        viewpoints = scanning.around(generator, part, num=num)
    cloud = scanning.scan(
        part,
        num_points=count,
        seed=[*seed, _SURFACE],
        num_samples=config.num_samples,
        falloff=falloff,
        viewpoints=viewpoints,
    )
    return *(scanning.drop_unseen(part, cloud) if partial else (part, cloud)), astray


def _noisy(
    generator: np.random.Generator,
    part: Part,
    cloud: Cloud,
    rotation: np.ndarray,
    clean: host.Frame,
    config: LoaderConfig,
) -> np.ndarray:
    """The points as scanned, in the normalised frame of the clean ones."""
    if config.noise == "stored":
        if cloud.noisy_points is None:
            raise ValueError(f"Part {part.name!r} has no noisy points; set noise to drawn.")
        return clean.from_input(cloud.noisy_points @ rotation.T)
    kind, bounds = "uniform", config.uniform_noise
    if generator.random() < config.gaussian_share:
        kind, bounds = "gaussian", config.gaussian_noise
    amount = generator.uniform(*bounds)
    points, normals = clean.from_input(cloud.points @ rotation.T), cloud.normals @ rotation.T
    return perturb(generator, points, normals, kind=kind, amount=amount)


def _truth(
    part: Part,
    cloud: Cloud,
    samples: np.ndarray | None,
    rotation: np.ndarray,
    mask: np.ndarray,
    config: LoaderConfig,
) -> Truth:
    table, count = records.pack(part.primitives), len(part.primitives)
    valid = len(cloud.points)
    normals = np.zeros((len(mask), 3), np.float32)
    normals[:valid] = cloud.normals @ rotation.T
    normals[valid:] = normals[0]
    labels = np.full(len(mask), BACKGROUND, np.int32)
    labels[:valid] = cloud.labels
    kind = np.zeros(config.max_instances, np.int32)
    kind[:count] = table.kind
    axis = np.zeros((config.max_instances, 3), np.float32)
    directed = np.flatnonzero(table.kind != KINDS.index("sphere"))
    axis[directed] = table.parameters[directed, :3] @ rotation.T
    padded = np.zeros((config.max_instances, config.num_samples, 3), np.float32)
    if samples is not None:
        padded[:count] = samples
    return Truth(mask, normals, labels, np.arange(config.max_instances) < count, kind, axis, padded)
