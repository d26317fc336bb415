"""One segment: time of fit_primitive, error and time beside other libraries, and the fits of a loss: make bench."""

import importlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.evaluation import patches
from jprimfit.fitting.single import fit_primitive
from jprimfit.primitives.estimation import estimate
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cylinder, Plane, Sphere

NOISE = 0.05  # of the unit of the patch
NUM_DATASETS = 5
WHOLE = dict(zip(KINDS, patches.WHOLE, strict=True))
each_kind = pytest.mark.parametrize("kind", KINDS)


def drawn(kind, num_points, seed):
    """Noisy points of a whole surface, and the exact normals of their feet."""
    patch, rng = WHOLE[kind], np.random.default_rng(seed)
    clean = patch.draw(rng, num_points)
    with jax.enable_x64(True):
        normals = MODULES[kind].normal(jax.tree.map(jnp.asarray, patch.truth), jnp.asarray(clean))
    return clean + NOISE * patch.unit * rng.normal(size=clean.shape), np.asarray(normals)


def error(kind, found):
    """Sum of the absolute errors of all parameters, with the truth's sign of a normal or axis."""
    truth = WHOLE[kind].truth
    with jax.enable_x64(True):
        found = MODULES[kind].canonical(jax.tree.map(jnp.asarray, found), jnp.zeros(3))
    found = type(truth)(*map(np.asarray, found))
    return float(np.abs(patches.fields(found, truth) - patches.fields(truth, truth)).sum())


def timed(function, *arguments):
    start = time.perf_counter()
    answer = jax.block_until_ready(function(*arguments))
    return answer, 1e3 * (time.perf_counter() - start)


@pytest.mark.benchmark
@each_kind
@pytest.mark.parametrize("method", ["unbiased", "best"])
def test_a_segment_of_60000_points(kind, method):
    milliseconds = []
    for seed in range(NUM_DATASETS + 2):
        points, normals = drawn(kind, 60_000, seed)
        (_, info), spent = timed(lambda: fit_primitive(kind, points, normals=normals, method=method))  # noqa: B023
        milliseconds.append(spent)
    warm = milliseconds[2:]
    sys.stdout.write(
        f"\n{kind:9s} {info.method:10s} 60,000 points with normals {min(warm):7.1f} ms, median {np.median(warm):7.1f}\n"
    )


def scikit_spatial(kind, points):
    """Least squares of scikit-spatial: plane and cylinder by singular values, sphere by the algebraic fit."""
    objects = importlib.import_module("skspatial.objects")
    found = {"plane": objects.Plane, "sphere": objects.Sphere, "cylinder": objects.Cylinder}[kind].best_fit(points)
    if kind == "plane":
        normal = np.asarray(found.normal, float)
        return Plane(normal, np.float64(normal @ np.asarray(found.point, float)))
    if kind == "sphere":
        return Sphere(np.asarray(found.point, float), np.float64(found.radius))
    axis = np.asarray(found.vector, float)
    return Cylinder(axis / np.linalg.norm(axis), np.asarray(found.point, float), np.float64(found.radius))


def pyransac3d(kind, points):
    """RANSAC with a threshold of two standard deviations of the noise and the library's numbers of iterations."""
    library = importlib.import_module("pyransac3d")
    threshold = 2.0 * NOISE * WHOLE[kind].unit
    if kind == "plane":
        equation, _ = library.Plane().fit(points, thresh=threshold)
        length = np.linalg.norm(equation[:3])
        return Plane(np.asarray(equation[:3]) / length, np.float64(-equation[3] / length))
    if kind == "sphere":
        center, radius, _ = library.Sphere().fit(points, thresh=threshold)
        return Sphere(np.asarray(center), np.float64(radius))
    center, axis, radius, _ = library.Cylinder().fit(points, thresh=threshold)
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return Cylinder(axis, np.asarray(center), np.float64(radius))


def jprimfit(kind, points):
    return fit_primitive(kind, points)[0]


@pytest.mark.benchmark
@pytest.mark.parametrize("kind", KINDS[:3])
@pytest.mark.parametrize(
    "library,function", [("jprimfit", jprimfit), ("skspatial", scikit_spatial), ("pyransac3d", pyransac3d)]
)
def test_2000_points_beside_other_libraries(kind, library, function):
    pytest.importorskip(library)
    if library == "jprimfit":
        function(kind, drawn(kind, 2_000, 99)[0])  # compiles
    results = [timed(function, kind, drawn(kind, 2_000, seed)[0]) for seed in range(NUM_DATASETS)]
    errors, milliseconds = [error(kind, found) for found, _ in results], [spent for _, spent in results]
    sys.stdout.write(
        f"\n{kind:9s} {library:11s} 2,000 points: error {np.mean(errors):.4f} ± {np.std(errors):.4f}, "
        f"{np.median(milliseconds):8.1f} ms\n"
    )


def one_shot(kind, points, weights, normals):
    return MODULES[kind].fit(points, weights, normals).primitive


def full(kind, points, weights, normals):
    return estimate(one_shot(kind, points, weights, normals), points, weights).primitive


@pytest.mark.benchmark
@pytest.mark.parametrize("name,fitter", [("one-shot", one_shot), ("unbiased", full)])
def test_slots_of_a_loss(name, fitter):
    num_slots, rng = 24, np.random.default_rng(0)
    centers = rng.uniform(-1, 1, (num_slots, 3))
    points = rng.uniform(-1, 1, (8_192, 3))
    owner = np.square(points[:, None] - centers).sum(axis=2).argmin(axis=1)
    offset = points - centers[owner]
    points = centers[owner] + 0.2 * offset / np.linalg.norm(offset, axis=1, keepdims=True)
    points = jnp.asarray(points, jnp.float32)
    normals = jnp.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True), jnp.float32)
    logits = jnp.asarray(6.0 * np.eye(num_slots)[owner].T + rng.normal(size=(num_slots, len(owner))), jnp.float32)

    def loss(logits, normals):
        total = 0.0
        for kind in KINDS:

            def residual(weights, kind=kind):
                primitive = fitter(kind, points, weights, normals)
                return jnp.sum(weights * MODULES[kind].distance(primitive, points)) / jnp.sum(weights)

            total += jnp.sum(jax.vmap(residual)(jax.nn.softmax(logits, axis=0)))
        return total

    for what, function in (("forward", jax.jit(loss)), ("forward + backward", jax.jit(jax.grad(loss, argnums=(0, 1))))):
        _, first = timed(function, logits, normals)
        milliseconds = [timed(function, logits, normals)[1] for _ in range(5)]
        sys.stdout.write(
            f"\n24 slots x 4 kinds on 8,192 points, {name}: {what} {min(milliseconds):.0f} ms "
            f"(first call {first / 1e3:.0f} s)\n"
        )
