"""Kernel density of a cloud at its points, as PointConv weighs its convolutions (W. Wu et al., CVPR 2019).

    rho_i = mean over the neighbours j of point i closer than the radius of  N(p_j - p_i; 0, variance * I)

where N is the isotropic Gaussian density in three dimensions, in 1 / length^3. The mean runs over the neighbours in
the ball and not over the cloud, so rho compares points; it does not integrate to one. `variance` is what PointConv's
code calls sigma. Work and memory are n x k: no pair of points is looked at that is not in the neighbourhoods.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.geometry import safe
from jprimfit.geometry.grouping import gather
from jprimfit.types import Neighbors


def gaussian_density(neighbors: Neighbors, *, variance: float, radius: float = math.inf) -> Float[Array, "m"]:
    """Mean of the Gaussian density over each query's neighbours closer than radius; 0 where there is none.

    Args:
        neighbors: of each query, itself included if it is a point of the cloud. They stand for all points in the
            ball as long as k reaches that far (count and mask tell); beyond, the mean is that of the k nearest.
        variance: squared standard deviation of the kernel, in squared units of the cloud.
        radius: of the ball, in the cloud's unit.
    """
    inside = neighbors.mask & (neighbors.sq_distance < radius**2)
    kernel = jnp.exp(neighbors.sq_distance / (-2 * variance)) / (2 * math.pi * variance) ** 1.5
    total = jnp.sum(jnp.where(inside, kernel, 0), axis=1)
    return safe.divide(total, jnp.sum(inside, axis=1).astype(total.dtype))


def inverse_density(density: Float[Array, "n"]) -> Float[Array, "n"]:
    """1 / density, the volume that a point stands for; 0 where the density is 0."""
    return safe.divide(jnp.ones_like(density), density)


def relative_inverse_density(density: Float[Array, "n"], neighbors: Neighbors) -> Float[Array, "m k"]:
    """Inverse density of each neighbour over the largest in its neighbourhood: in (0, 1], 0 in padding.

    The scale that PointConv's density network takes. A constant factor in the density, as that of the kernel's
    normalisation, does not matter here.
    """
    inverse = jnp.where(neighbors.mask, gather(inverse_density(density), neighbors.index), 0)
    return safe.divide(inverse, jnp.max(inverse, axis=1, keepdims=True))
