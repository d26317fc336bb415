"""What a network is told of each point: its position, and the shape of its neighbourhood free of any sign.

A PCA normal n has no sign, so it enters as the six entries of n nᵀ, which do not depend on it. The curvature (surface
variation) is near 0 almost everywhere; its square root spreads the small values. Letters: n points, g neighbourhood
sizes, c channels.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.geometry import safe

FEATURES = ("xyz", "pca")
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def point_features(
    points: Float[Array, "n 3"],
    local_normals: Float[Array, "n g 3"],
    curvature: Float[Array, "n g"],
    *,
    features: tuple[str, ...],
) -> Float[Array, "n c"]:
    """The features named, side by side: "xyz" 3 channels, "pca" 7 for each neighbourhood size.

    Args:
        points: in the normalised frame.
        local_normals: unit, of either sign.
        curvature: of the same neighbourhoods, in [0, 1/3].
        features: some of FEATURES.
    """
    columns = []
    if "xyz" in features:
        columns.append(points)
    if "pca" in features:
        products = jnp.stack([local_normals[..., i] * local_normals[..., j] for i, j in _UPPER], axis=-1)
        shape = jnp.concatenate([products, 2 * safe.sqrt(curvature)[..., None]], axis=-1)
        columns.append(shape.reshape(len(points), -1))
    return jnp.concatenate(columns, axis=-1)
