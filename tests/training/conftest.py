"""A toy problem: a box corner with a sphere in it, seen by a network of two levels."""

import jax
import numpy as np
import pytest

from jprimfit.data.examples import Example
from jprimfit.data.loader import Loader, ValidationBatch
from jprimfit.geometry.hierarchy import HierarchySpec, index_sets
from jprimfit.geometry.host import build_hierarchy
from jprimfit.training.sources import Sources
from jprimfit.types import Truth

NUM_POINTS = 96
TOY_SPEC = HierarchySpec(
    num_points=(24, 8),
    encoder_neighbors=(8, 8),
    decoder_neighbors=(0, 8),
    density_neighbors=(8, 8),
    density_radius=(0.4, 0.8),
    density_variance=(0.2, 0.4),
    max_radius=(float("inf"),) * 2,
)
TOY_MODEL = {
    "hierarchy": {
        "num_points": [24, 8],
        "encoder_neighbors": [8, 8],
        "decoder_neighbors": [0, 8],
        "density_neighbors": [8, 8],
        "density_radius": [0.4, 0.8],
        "density_variance": [0.2, 0.4],
        "max_radius": [float("inf"), float("inf")],
    },
    "pointconv": {"encoder": [[8, 16], [16, 16]], "decoder": [[16], [16, 16]], "weight_channels": 4, "grouped": False},
    "num_points": NUM_POINTS,
    "neighborhoods": [8],
    "features": ["xyz", "pca"],
    "num_slots": 5,
    "shared": 16,
    "dropout": 0.3,
}


def toy_example(generator):
    """One cloud: floor, wall and ball, in random proportions and at a random angle; the last rows are padding."""
    labels = np.sort(generator.integers(0, 3, NUM_POINTS))
    u, v = generator.uniform(-1, 1, (2, NUM_POINTS))
    ball = generator.normal(size=(NUM_POINTS, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    one, zero = np.ones(NUM_POINTS), np.zeros(NUM_POINTS)
    points = np.select(
        [labels[:, None] == 0, labels[:, None] == 1],
        [np.stack([u, v, -one], axis=1), np.stack([-one, u, v], axis=1)],
        0.5 * ball,
    )
    normals = np.select(
        [labels[:, None] == 0, labels[:, None] == 1],
        [np.stack([zero, zero, one], axis=1), np.stack([one, zero, zero], axis=1)],
        ball,
    )
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    points, normals = points @ turn, normals @ turn
    samples = points[generator.permutation(NUM_POINTS)][None, :16] * np.ones((4, 1, 1))
    mask = np.arange(NUM_POINTS) < NUM_POINTS - generator.integers(0, 9)
    points[~mask] = points[0]
    truth = Truth(
        mask=mask,
        normals=normals.astype(np.float32),
        labels=np.where(mask, labels, -1).astype(np.int32),
        instance_mask=np.array([True, True, True, False]),
        kind=np.array([0, 0, 1, 0], np.int32),
        axis=np.stack([turn[2], turn[0], 0 * turn[0], 0 * turn[0]]).astype(np.float32),
        samples=samples.astype(np.float32),
    )
    points = points.astype(np.float32)
    rough = normals + 0.1 * generator.normal(size=normals.shape)
    rough /= np.linalg.norm(rough, axis=1, keepdims=True)
    return Example(
        points=points,
        mask=mask,
        local_normals=rough[:, None].astype(np.float32),
        curvature=generator.uniform(0, 0.1, (NUM_POINTS, 1)).astype(np.float32),
        sets=index_sets(build_hierarchy(points, mask, spec=TOY_SPEC, workers=1)),
        query=np.arange(NUM_POINTS, dtype=np.int32),
        truth=truth,
    )


@pytest.fixture(scope="session")
def toy_batch():
    """Eight clouds."""
    generator = np.random.default_rng(0)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *[toy_example(generator) for _ in range(8)])


class ToyPool:
    """Eight clouds."""

    num_left_out = 3

    def __len__(self):
        return 8


class ToyLoader(Loader):
    """What training/sources needs of data/loader.Loader, over the toy batch: eight clouds, eight examples a step."""

    def __init__(self, batch):
        self.everything, self.pool = batch, ToyPool()
        self.asked = []  # steps
        self.change = lambda step, batch: batch

    def batch(self, step, batch_size, *, shard=(0, 1)):
        place, count = shard
        self.asked.append(step)
        first = step * batch_size + place * (batch_size // count)
        rows = np.arange(first, first + batch_size // count) % 8
        return self.change(step, jax.tree.map(lambda x: x[rows], self.everything))

    def validation(self, batch_size, *, num_clouds=None):
        for first in range(0, 8, batch_size):
            rows = np.arange(first, first + batch_size)
            example = jax.tree.map(lambda x, rows=rows: x[rows % 8], self.everything)
            yield ValidationBatch(example, rows < 8, rows % 8)


@pytest.fixture
def toy_loader(toy_batch, monkeypatch):
    """The loader that a training finds in place of any pool."""
    loader = ToyLoader(toy_batch)
    sources = Sources(loader, loader)
    monkeypatch.setattr("jprimfit.training.loop.open_sources", lambda config: sources)
    return loader


@pytest.fixture
def toy_mapping():
    """Settings of a run on it, as a YAML file would hold them; fresh in every test."""
    return {
        "seed": 1,
        "model": jax.tree.map(lambda x: x, TOY_MODEL),
        "data": {"file": "toy.h5", "num_points": NUM_POINTS, "num_query": 0, "max_instances": 4},
        "loss": {"residue": 0.0, "parameter": 0.0, "orthogonality": 0.1},
        "optimizer": {"learning_rate": "1e-2"},
        "train": {"batch_size": 8, "steps": 30, "validate_every": 10, "checkpoint_every": 5, "log_every": 5},
    }
