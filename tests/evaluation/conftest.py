"""Small parts in a data set, and a tiny network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.data import native
from jprimfit.data.records import Cloud, Part
from jprimfit.geometry.hierarchy import HierarchySpec, from_index_sets
from jprimfit.geometry.preparation import prepare
from jprimfit.networks import weights
from jprimfit.networks.pointconv import PointConvConfig
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig
from jprimfit.types import Cone, Cylinder, Plane, Sphere

UP = np.array([0.0, 0.0, 1.0])
EACH = 150  # points of every instance


def make_part(seed, *, split="test", family="", scale=1.0, shift=(0.0, 0.0, 0.0)):
    """A floor, a ball, a column and a cone that stand apart, `scale` large."""
    draw = np.random.default_rng(seed)
    shift = np.asarray(shift)
    u, v, w = draw.uniform(-1, 1, (3, EACH))
    angle = np.pi * u
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    ball = np.sqrt(1 - v[:, None] ** 2) * around + v[:, None] * UP
    height = 0.4 + 0.2 * v[:, None]  # over the apex
    half = np.arctan(0.5)
    pieces = [
        (np.stack([u, w, 0 * u], axis=1), np.tile(UP, (EACH, 1))),
        (np.array([0, 0.5, 0.5]) + 0.3 * ball, ball),
        (np.array([0.6, -0.5, 0.6]) + 0.2 * around + 0.4 * v[:, None] * UP, around),
        (np.array([-0.6, -0.5, 0.3]) + height * (UP + 0.5 * around), np.cos(half) * around - np.sin(half) * UP),
    ]
    primitives = (
        Plane(UP, np.float64(scale * shift[2])),
        Sphere(scale * (np.array([0, 0.5, 0.5]) + shift), np.float64(0.3 * scale)),
        Cylinder(UP, scale * (np.array([0.6, -0.5, 0.6]) + shift), np.float64(0.2 * scale)),
        Cone(UP, scale * (np.array([-0.6, -0.5, 0.3]) + shift), np.float64(half)),
    )
    points = scale * (np.concatenate([points for points, _ in pieces]) + shift)
    normals = np.concatenate([normals for _, normals in pieces])
    cloud = Cloud(points, normals, np.repeat(np.arange(4), EACH).astype(np.int32))
    areas = scale**2 * np.array([4.0, 1.1, 1.0, 0.2])
    return Part(f"{split} {seed}", primitives, cloud=cloud, areas=areas, split=split, family=family or split)


def make_model(head="slots", **fields):
    """An untrained network for 256 points."""
    spec = HierarchySpec((32,), (8,), (4,), (8,), (0.2,), (0.1,), (2.0,))
    narrow = PointConvConfig(encoder=((8, 8, 16),), decoder=((16, 16),), weight_channels=4)
    config = SegmenterConfig(
        hierarchy=spec, pointconv=narrow, num_points=256, head=head, num_slots=8, embedding_size=4, shared=16, **fields
    )
    ready = prepare(make_part(0).cloud.points[::2][:256].astype(np.float32), spec=spec, neighborhoods=(16,))
    ready = jax.tree.map(jnp.asarray, ready)
    hierarchy = from_index_sets(ready.points, ready.sets, ready.mask)
    inputs = (ready.points, hierarchy, ready.local_normals, ready.curvature)
    segments = jnp.eye(8)[jnp.arange(256) % 8] if config.types == "pooled" else None
    variables = jax.jit(Segmenter(config).init)(jax.random.key(0), *inputs, segments=segments)
    return weights.Model(config, jax.tree.map(np.asarray, variables), "tiny", {})


@pytest.fixture(scope="session")
def parts_file(tmp_path_factory):
    """A data set of five parts to test and one to validate."""
    path = tmp_path_factory.mktemp("data") / "parts.h5"
    tested = [make_part(seed, scale=1.0 + seed, shift=(seed, 2.0, -seed)) for seed in range(5)]
    native.write(path, [*tested, make_part(9, split="val")])
    return path


@pytest.fixture(scope="session")
def tiny_model():
    """tiny_model(head, **fields of SegmenterConfig) -> Model, each made once."""
    made = {}

    def get(head="slots", **fields):
        key = (head, *sorted(fields.items()))
        if key not in made:
            made[key] = make_model(head, **fields)
        return made[key]

    return get
