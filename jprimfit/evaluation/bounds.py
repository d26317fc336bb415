"""Cramer-Rao bounds on the parameters of a surface from noisy points of a known patch.

Conditional: every point's foot on the surface is an unknown of its own; what is left is the distance along the normal,
sigma^2 (sum J^T J)^-1 with J the derivative of the signed distance at the foot. It is linear in sigma, and below what
any estimate reaches where the noise is not small against the patch. Full density: the feet are known to be even by
area over the patch, whose free edges are unknown, too; from the score of the density of noisy points, by quadrature
over the patch and Monte Carlo over points. It can lie below the conditional bound: the density itself tells something.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jprimfit.evaluation.patches import Patch, foot_points
from jprimfit.geometry import safe
from jprimfit.primitives.table import MODULES
from jprimfit.types import Cylinder, Primitive

NUM_FEET = 20_000
NUM_DRAWS = 4_000  # of the Monte Carlo: the bound is good to 2 %
MAX_NODES = 20_000  # of the quadrature, one per sigma in each direction: enough for sigma of 3 % and more
CHUNK = 200  # draws at a time


def conditional(patch: Patch, sigma: float, num_points: int) -> Float[np.ndarray, "p p"]:
    """Covariance of the step (`retract`) at the true surface, were its expectation the truth."""
    with jax.enable_x64(True):
        feet = jnp.asarray(patch.draw(np.random.default_rng(0), NUM_FEET))
        module, truth = MODULES[patch.truth.kind], jax.tree.map(jnp.asarray, patch.truth)
        jacobian = jax.jit(jax.jacfwd(lambda step: module.signed_distance(module.retract(truth, step), feet)))
        jacobian = np.asarray(jacobian(jnp.zeros(module.NUM_FREEDOM)))
    return sigma**2 * NUM_FEET / num_points * np.linalg.inv(jacobian.T @ jacobian)


def full_density(patch: Patch, sigma: float, num_points: int) -> Float[np.ndarray, "p p"] | None:
    """The same with the density known but for its edges; None where the noise is too small for the quadrature."""
    across, along = _extent(patch)
    shape = [max(8, math.ceil(length / sigma)) for length in (across, along)]
    if shape[0] * shape[1] > MAX_NODES:
        return None
    places = np.meshgrid(*[(np.arange(count) + 0.5) / count for count in shape], indexing="ij")
    nodes = np.stack([place.ravel() for place in places], axis=1)
    generator = np.random.default_rng(1)
    draws = patch.draw(generator, NUM_DRAWS) + sigma * generator.normal(size=(NUM_DRAWS, 3))
    num_freedom = MODULES[patch.truth.kind].NUM_FREEDOM
    with jax.enable_x64(True):

        @jax.jit
        def scores(points: Float[Array, "m 3"]) -> Float[Array, "m q"]:
            return jax.jacfwd(lambda unknown: _log_density(patch, unknown, jnp.asarray(nodes), points, sigma))(
                jnp.zeros(num_freedom + len(patch.free))
            )

        score = np.concatenate([np.asarray(scores(rows)) for rows in np.split(draws, NUM_DRAWS // CHUNK)])
    information = score.T @ score * (num_points / NUM_DRAWS)
    return np.linalg.inv(information)[:num_freedom, :num_freedom]


def mean_absolute_error(patch: Patch, covariance: Float[np.ndarray, "p p"]) -> float:
    """Expected sum of the absolute errors of the parameters in the paper's tables, were they normal."""
    module = MODULES[patch.truth.kind]

    def listed(step: Float[Array, " p"]) -> Float[Array, " f"]:
        moved = module.retract(truth, step)
        if isinstance(moved, Cylinder):
            moved = module.canonical(moved, truth.center)
        return jnp.concatenate([field.reshape(-1) for field in moved])

    with jax.enable_x64(True):
        truth = jax.tree.map(jnp.asarray, patch.truth)
        derivative = np.asarray(jax.jacfwd(listed)(jnp.zeros(module.NUM_FREEDOM)))
    spread = np.sqrt(np.maximum(np.diag(derivative @ covariance @ derivative.T), 0.0))
    return float(math.sqrt(2.0 / math.pi) * spread.sum())


def _extent(patch: Patch) -> tuple[float, float]:
    """Largest lengths of the patch in its two directions."""
    a0, a1, b0, b1 = patch.edges
    if patch.truth.kind == "plane":
        return a1 - a0, b1 - b0
    if patch.truth.kind == "sphere":
        # Nodes are even in height: near a pole their spacing along the meridian is the largest.
        return 12.0 * math.acos(a0), 6.0 * (b1 - b0)
    if patch.truth.kind == "cylinder":
        return a1 - a0, 6.0 * (b1 - b0)
    return 2.0 * a1, a1 * (b1 - b0)


def _log_density(patch: Patch, unknown, nodes, points, sigma: float) -> Float[Array, " m"]:
    num_freedom = MODULES[patch.truth.kind].NUM_FREEDOM
    moved = MODULES[patch.truth.kind].retract(jax.tree.map(jnp.asarray, patch.truth), unknown[:num_freedom])
    edges = jnp.asarray(patch.edges)
    if patch.free:
        edges = edges.at[jnp.array(patch.free)].add(unknown[num_freedom:])
    feet = foot_points(moved, edges, nodes, jnp, _frame(patch.truth, moved))
    distance = points[:, None, :] - feet[None, :, :]
    return jax.scipy.special.logsumexp(-jnp.sum(distance * distance, axis=2) / (2.0 * sigma**2), axis=1)


def _frame(truth: Primitive, moved: Primitive) -> Float[Array, "3 3"] | None:
    """The frame of the known surface, turned with the axis by the least angle."""
    if truth.kind == "sphere":
        return None
    rest = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) if truth.kind == "plane" else np.eye(3)
    axis = moved[0]
    first = safe.unit(rest[0] - axis * jnp.sum(axis * rest[0]))
    return jnp.stack([first, jnp.cross(axis, first), axis])
