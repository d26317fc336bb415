"""One cloud of a training pool: drawn from a part, turned, made noisy, normalised and prepared, all from its number.

The frame is the normalised one of the noisy points: the truth moves with them. What is random comes from generators
seeded by (pool seed, number of the cloud), so a cloud does not depend on the others. Letters: n points, g sizes of
neighbourhood, i instances at most, m samples each.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from jprimfit.data import records, surfaces
from jprimfit.data.examples import Example
from jprimfit.data.native import Dataset
from jprimfit.data.noise import perturb
from jprimfit.data.records import BACKGROUND, KINDS, Cloud, Part
from jprimfit.geometry import host
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.geometry.preparation import prepare
from jprimfit.types import Truth

_SURFACE, _SETTING = 0, 1  # streams of random numbers of one cloud


@dataclass(frozen=True)
class LoaderConfig:
    """Which clouds a network sees. Lengths in the normalised frame; a pair is a range to draw from."""

    file: str = ""  # the dataset
    split: str = "train"
    num_points: int = 8192  # of a cloud, padding included
    num_query: int = 2048  # points of a cloud at which the network is asked; 0 = all
    num_clouds: int = 0  # drawn into the pool, part after part; 0 = one per part
    rotate: bool = True  # turn every cloud at random, once in the pool and once more in every batch
    noise: Literal["drawn", "stored"] = "drawn"  # stored = the noisy points of a dataset that has them
    uniform_noise: tuple[float, float] = (0.01, 0.01)  # half-width along the normal; the paper's Table 1
    gaussian_noise: tuple[float, float] = (0.0, 0.0)  # standard deviation, isotropic
    gaussian_share: float = 0.0  # of the clouds have Gaussian noise, the others uniform
    thin_share: float = 0.0  # of the clouds have fewer points: their number is log-uniform from min_points
    min_points: int = 512
    max_instances: int = 32  # parts with more are left out
    num_samples: int = 0  # clean points on each instance, for the residual loss; 0 = none
    pool_seed: int = 0  # of the clouds; trainings that differ in their own seed only share a pool
    cache: str = ""  # folder for pools; "" = the folder `pools` beside the file
    workers: int = -1  # processes that build the pool; 0 = this one, -1 = one for each core

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
        for name in ("gaussian_share", "thin_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a share from 0 to 1.")
        for name in ("uniform_noise", "gaussian_noise"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high < math.inf:
                raise ValueError(f"{name} is {[low, high]}, expected two lengths, the smaller first.")
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
    generator = np.random.default_rng([config.pool_seed, number, _SETTING])
    count = _num_valid(generator, config)
    cloud = surfaces.draw(
        part, num_points=count, seed=[config.pool_seed, number, _SURFACE], num_samples=config.num_samples
    )
    rotation = random_rotation(generator) if config.rotate else np.eye(3)
    _, clean = host.normalize(cloud.points @ rotation.T)
    noisy = _noisy(generator, part, cloud, rotation, clean, config)
    points, frame = host.normalize(noisy)
    prepared = prepare(points, spec=spec, neighborhoods=neighborhoods, num_points=config.num_points, workers=workers)
    samples = None
    if cloud.samples is not None:
        flat = clean.from_input(cloud.samples.reshape(-1, 3) @ rotation.T)
        samples = frame.from_input(flat).reshape(cloud.samples.shape)
    truth = _truth(part, cloud, samples, rotation, prepared.mask, config)
    return Example(*prepared, query=np.arange(config.num_points, dtype=np.int32), truth=truth)


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
