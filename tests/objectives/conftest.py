"""A part whose every face is known: a square, a sphere, a cylinder and a cone, some background, some padding."""

from types import SimpleNamespace

import numpy as np
import pytest

from jprimfit.types import Cone, Cylinder, Plane, Prediction, Sphere, Truth

NUM_FACE, NUM_INSTANCES, NUM_SLOTS, NUM_CHANNELS = 49, 6, 8, 5
KINDS = [0, 1, 2, 3]
PRIMITIVES = (
    Plane(np.array([0.0, 0, 1]), np.array(-0.5)),
    Sphere(np.array([0.5, 0.2, 0.3]), np.array(0.4)),
    Cylinder(np.array([1.0, 0, 0]), np.array([0, -0.5, 0.2]), np.array(0.3)),
    Cone(np.array([0, 1.0, 0]), np.array([-0.4, 0, 0.3]), np.array(0.5)),
)


def face(kind, first, second):
    """Points and normals of a face at parameters in [0, 1]."""
    turn, zero = 2 * np.pi * first, 0 * first
    if kind == 0:
        return np.stack([first - 0.5, second - 0.5, zero - 0.5], 1), np.tile([0.0, 0, 1], (len(first), 1))
    if kind == 1:
        height = 2 * second - 1
        radius = np.sqrt(1 - height**2)
        normal = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1)
        return PRIMITIVES[1].center + 0.4 * normal, normal
    if kind == 2:
        normal = np.stack([zero, np.cos(turn), np.sin(turn)], 1)
        return PRIMITIVES[2].center + 0.3 * normal + (second - 0.5)[:, None] * [1.0, 0, 0], normal
    outwards = np.stack([np.cos(turn), zero, np.sin(turn)], 1)
    height = 0.2 + 0.6 * second
    points = PRIMITIVES[3].apex + height[:, None] * (np.tan(0.5) * outwards + [0, 1.0, 0])
    return points, np.cos(0.5) * outwards - np.sin(0.5) * np.array([0, 1.0, 0])


def build(seed=0, kinds=KINDS, dtype=np.float32):
    """Points, truth and perfect predictions of both heads; 4 points of background, 8 of padding."""
    generator = np.random.default_rng(seed)
    grid = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7))
    points, normals, labels, samples = [], [], [], np.zeros((NUM_INSTANCES, 16, 3))
    for label, kind in enumerate(kinds):
        first, second = (g.ravel() for g in grid) if kind == 0 else generator.random((2, NUM_FACE))
        where = face(kind, first, second)
        points, normals, labels = [*points, where[0]], [*normals, where[1]], [*labels, *[label] * NUM_FACE]
        samples[label] = face(kind, *generator.random((2, 16)))[0]
    rest = 4 * NUM_FACE - len(labels) + 12
    points = np.concatenate([*points, generator.uniform(2, 3, (rest, 3))])
    normals = np.concatenate([*normals, np.tile([0.0, 0, 1], (rest, 1))])
    labels = np.array([*labels, *[-1] * rest], np.int32)
    mask = np.arange(len(labels)) < len(labels) - 8
    axes = np.array([[0, 0, 1.0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    padded_kinds = np.array([*kinds, *[0] * (NUM_INSTANCES - len(kinds))], np.int32)
    instance_mask = np.arange(NUM_INSTANCES) < len(kinds)
    truth = Truth(
        mask=mask,
        normals=normals.astype(dtype),
        labels=labels,
        instance_mask=instance_mask,
        kind=padded_kinds,
        axis=(axes[padded_kinds] * instance_mask[:, None]).astype(dtype),
        samples=samples.astype(dtype),
    )
    order = generator.permutation(NUM_SLOTS)  # slot of every label; background goes to its last one
    slots = np.full((len(labels), NUM_SLOTS), -30.0)
    slots[np.arange(len(labels)), order[labels]] = 30.0
    places = 10 * generator.normal(size=(NUM_INSTANCES + 1, NUM_CHANNELS))
    types = 60.0 * np.eye(4)[padded_kinds[labels]]
    signs = generator.choice([-1.0, 1.0], (len(labels), 1))
    common = ((signs * normals).astype(dtype), types.astype(dtype), np.zeros((len(labels), 3), dtype))
    return SimpleNamespace(
        points=points.astype(dtype),
        truth=truth,
        order=order,
        primitives=tuple(PRIMITIVES[kind] for kind in kinds),
        slots=Prediction(*common, membership_logits=slots.astype(dtype)),
        prototype=Prediction(*common, embedding=places[labels].astype(dtype)),
    )


def noise(part, generator, amount=1.0):
    """Arbitrary predictions of both heads for the part, of unit normals."""
    found = {}
    for head in ("slots", "prototype"):
        prediction = getattr(part, head)
        rows = {
            name: (generator.normal(size=x.shape) * amount).astype(x.dtype)
            for name, x in prediction._asdict().items()
            if x is not None
        }
        rows["normals"] /= np.linalg.norm(rows["normals"], axis=1, keepdims=True)
        found[head] = prediction._replace(**rows)
    return found


@pytest.fixture
def part():
    """The part with one face of each kind."""
    return build()


@pytest.fixture
def make_part():
    """build, noise: other parts and arbitrary predictions."""
    return SimpleNamespace(build=build, noise=noise)
