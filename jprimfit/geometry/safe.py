"""Square roots, quotients, norms, directions and angles whose values AND derivatives are finite everywhere.

Where the mathematical function has no derivative (the root of 0, the direction of the zero vector) the value is the
limit or 0 and the derivative is 0. A single where(x > 0, sqrt(x), 0) is not enough: its derivative at 0 is 0 * inf =
nan, so the argument is replaced by 1 before the function sees it ("double where").
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# The slope of arccos is held at its value at 1 - 1e-6, about -707.
_ARCCOS_MIN_SQ_SINE = 2e-6


def sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root; 0 with derivative 0 where x <= 0 (or below the smallest normal number)."""
    positive = x > jnp.finfo(x.dtype).tiny
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def divide(numerator: Float[Array, "..."], denominator: Float[Array, "..."]) -> Float[Array, "..."]:
    """Quotient numerator / denominator, shapes broadcast; 0 with derivative 0 where |denominator| is below 1e-19."""
    # The derivative needs 1 / denominator^2, which overflows below the root of the smallest normal number.
    nonzero = jnp.abs(denominator) > jnp.finfo(denominator.dtype).tiny ** 0.5
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1), 0)


def norm(x: Float[Array, "..."], axis: int = -1, keepdims: bool = False) -> Float[Array, "..."]:
    """Euclidean length along axis; 0 with derivative 0 at the zero vector."""
    return sqrt(jnp.sum(x * x, axis=axis, keepdims=keepdims))


def unit(x: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*shape"]:
    """Direction of x along axis, of length 1; the zero vector, with derivative 0, stays the zero vector."""
    return divide(x, norm(x, axis=axis, keepdims=True))


@jax.custom_jvp
def arccos(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Arc cosine of x clamped to [-1, 1], in [0, pi]; exact values, the slope bounded by 707.

    Near 1 the result is only as good as the rounding of x allows (3e-4 rad in float32): for the angle between two
    vectors use `angle`.
    """
    return jnp.arccos(jnp.clip(x, -1, 1))


@arccos.defjvp
def _arccos_jvp(primals, tangents):
    (x,), (x_dot,) = primals, tangents
    return arccos(x), -x_dot / jnp.sqrt(jnp.maximum(1 - x * x, _ARCCOS_MIN_SQ_SINE))


def angle(a: Float[Array, "*shape 3"], b: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Angle in [0, pi] between vectors of any length, full precision at 0 and pi; 0 if one is the zero vector."""
    sine, cosine = norm(jnp.cross(a, b)), jnp.sum(a * b, axis=-1)
    return arctan2(sine, cosine)


def line_angle(a: Float[Array, "*shape 3"], b: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Angle in [0, pi/2] between the lines along a and b: `angle` without regard to sign."""
    sine, cosine = norm(jnp.cross(a, b)), jnp.sum(a * b, axis=-1)
    return arctan2(sine, jnp.abs(cosine))


def arctan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Angle of the point (x, y) in (-pi, pi]; 0 with derivative 0 at the origin."""
    nonzero = jnp.maximum(jnp.abs(x), jnp.abs(y)) > jnp.finfo(x.dtype).tiny ** 0.5
    return jnp.where(nonzero, jnp.arctan2(jnp.where(nonzero, y, 0), jnp.where(nonzero, x, 1)), 0)


def unit_or(x: Float[Array, "n d"], fallback: Float[Array, " d"]) -> Float[Array, "n d"]:
    """Direction of every row of x; the fallback, which should be a unit vector, for zero rows."""
    return jnp.where(norm(x, keepdims=True) > 0, unit(x), fallback[None, :])
