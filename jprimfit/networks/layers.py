"""The layers that every network here is made of: dense, batch normalisation, ReLU.

Modules see ONE cloud. Statistics of a batch come from sums over the named axes of the vmap around them (and of the
devices), so that padding is ignored and a batch split over devices has the statistics of the whole. Letters: n points,
c channels; a leading "..." may be (n) or (m, k).
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

MOMENTUM = 0.95  # of the running statistics that evaluation uses
EPSILON = 1e-3  # as SPFN's


class BatchNorm(nn.Module):
    """Each channel to mean 0 and variance 1 over all valid rows of the batch, then a learned scale and shift.

    Outside training the running statistics are used. The axes named must be those of the surrounding vmap, pmap or
    shard_map (S. Ioffe, C. Szegedy, 2015).
    """

    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self, x: Float[Array, "*rows c"], mask: Bool[Array, "*rows"], *, train: bool
    ) -> Float[Array, "*rows c"]:
        """The normalised rows; masked ones count in no sum."""
        channels = x.shape[-1]
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (channels,), x.dtype)
        running_variance = self.variable("batch_stats", "variance", jnp.ones, (channels,), x.dtype)
        scale = self.param("scale", nn.initializers.ones, (channels,), x.dtype)
        shift = self.param("shift", nn.initializers.zeros, (channels,), x.dtype)
        if train:
            mean, variance = self._statistics(x, mask)
            if not self.is_initializing():
                running_mean.value = MOMENTUM * running_mean.value + (1 - MOMENTUM) * mean
                running_variance.value = MOMENTUM * running_variance.value + (1 - MOMENTUM) * variance
        else:
            mean, variance = running_mean.value, running_variance.value
        factor = scale * lax.rsqrt(variance + EPSILON)
        broadcast = (1,) * (x.ndim - 1) + (channels,)
        return x * factor.reshape(broadcast) + (shift - mean * factor).reshape(broadcast)

    def _statistics(self, x: Array, mask: Array) -> tuple[Array, Array]:
        """Mean and variance over the valid rows of the whole batch.

        In two passes: E[x²] - E[x]² loses the digits that the mean and the deviation differ by, and its gradient more.
        """
        axes = tuple(range(x.ndim - 1))
        valid = mask[..., None].astype(x.dtype)
        total, count = self._over_batch((jnp.sum(valid * x, axes), jnp.sum(valid)))
        count = jnp.maximum(count, 1)
        mean = total / count
        centred = x - mean.reshape((1,) * (x.ndim - 1) + mean.shape)
        return mean, self._over_batch(jnp.sum(valid * jnp.square(centred), axes)) / count

    def _over_batch(self, sums: Any) -> Any:
        """The sums of this cloud, added up in the order of the batch, which is the same on any number of devices."""
        if not self.axis_names or self.is_initializing():
            return sums

        def total(x: Array) -> Array:
            clouds = x
            for name in self.axis_names:
                clouds = lax.all_gather(clouds, name)
            return jnp.sum(clouds.reshape(-1, *x.shape), axis=0)

        return jax.tree.map(total, sums)


class Pointwise(nn.Module):
    """Dense, batch normalisation and ReLU for every width, on each row by itself."""

    widths: tuple[int, ...]
    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self, x: Float[Array, "*rows c"], mask: Bool[Array, "*rows"], *, train: bool
    ) -> Float[Array, "*rows d"]:
        """The rows after the last layer; without widths, as they came."""
        for width in self.widths:
            x = nn.Dense(width, use_bias=False)(x)
            x = nn.relu(BatchNorm(self.axis_names)(x, mask, train=train))
        return x
