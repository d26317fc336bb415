"""PointConv (W. Wu, Z. Qi, L. Fuxin, CVPR 2019): a convolution whose kernel is a function of relative position.

    F'(x_i) = sum_j  S(1/rho_j) W(x_j - x_i) F(x_j)         over the neighbours j of centroid i

with W a small weight net and S a small density net on the inverse density, relative to the largest in the
neighbourhood. W is never formed: its last layer H is linear, W(d) = sum_v M_v(d) H_v, so the sum over neighbours is a
(v, k)·(k, c) product for every centroid, and H a dense layer on what comes out (field.md, 2.3). Two forms:
  grouped   as published: dense layers and normalisation on the gathered (m, k, c) features;
  else      features are transformed before they are gathered and nothing on the groups is normalised, which learns as
            well and costs a small part. The weight net may then see how the neighbours' normals stand, too.
Letters: m centroids among n points, k neighbours, c channels, v channels of the weight net.
"""

from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe
from jprimfit.geometry.density import relative_inverse_density
from jprimfit.geometry.grouping import gather, relative_positions
from jprimfit.geometry.hierarchy import Hierarchy
from jprimfit.geometry.interpolation import InterpolationWeights, interpolate
from jprimfit.networks.layers import BatchNorm, Pointwise
from jprimfit.types import Neighbors

DENSITY_CHANNELS = 16  # of the density net's hidden layer


@dataclass(frozen=True)
class PointConvConfig:
    """Widths of the network; entry l of encoder and decoder belongs to the step between levels l and l + 1.

    encoder[l]: pointwise widths, then the channels after the convolution to level l + 1. decoder[l]: the channels of
    the features joined at level l, those after the convolution there, then pointwise widths; where a level has no
    decoder groups all widths are pointwise. The defaults are PointConv's ScanNet table.
    """

    stem: tuple[int, ...] = ()  # pointwise widths at level 0
    encoder: tuple[tuple[int, ...], ...] = ((32, 32, 64), (64, 64, 128), (128, 128, 256), (256, 256, 512))
    decoder: tuple[tuple[int, ...], ...] = ((128, 128, 128), (256, 128), (256, 256), (512, 512))
    weight_channels: int = 32
    grouped: bool = True
    density: bool = True  # False: S = 1
    kernel: Literal["position", "position+normals"] = "position"  # what the weight net sees
    order: Literal["paper", "pointconv"] = "paper"  # of the decoder: join, dense, convolve; or convolve, join, dense


class PointConv(nn.Module):
    """One convolution; `mlp` are the widths before the product, `channels` those after it."""

    channels: int
    config: PointConvConfig
    mlp: tuple[int, ...] = ()
    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self,
        centroids: Float[Array, "m 3"],
        centroid_normals: Float[Array, "m 3"],
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        mask: Bool[Array, "n"],
        features: Float[Array, "n c"],
        density: Float[Array, "n"],
        groups: Neighbors,
        *,
        train: bool,
    ) -> Float[Array, "m d"]:
        """Features of the centroids from those of the points in their groups, which are rows of points."""
        offset = relative_positions(centroids, points, groups.index)
        if self.config.grouped:
            grouped = jnp.concatenate([offset, gather(features, groups.index)], axis=-1)
            grouped = Pointwise(self.mlp, self.axis_names, name="mlp")(grouped, groups.mask, train=train)
            weights = Pointwise((self.config.weight_channels,), self.axis_names, name="weight_net")(
                offset, groups.mask, train=train
            )
        else:
            features = Pointwise(self.mlp, self.axis_names, name="mlp")(features, mask, train=train)
            grouped = gather(features, groups.index)
            kernel = self._kernel_inputs(offset, centroid_normals, gather(normals, groups.index), groups)
            weights = nn.relu(nn.Dense(self.config.weight_channels, name="weight_net")(kernel))
        if self.config.density:
            weights = weights * self._density_scale(density, groups, train)
        weights = jnp.where(groups.mask[..., None], weights, 0)
        if not self.config.grouped:  # a mean, so that padded groups and all sizes k have one scale
            weights = weights / jnp.maximum(jnp.sum(groups.mask, axis=1), 1).astype(weights.dtype)[:, None, None]
        x = weighted_sum(weights, grouped)
        x = nn.Dense(self.channels, use_bias=False, name="kernel")(x.reshape(len(x), -1))
        # A centroid without any neighbour is padding, and must not count in the statistics.
        return nn.relu(BatchNorm(self.axis_names, name="norm")(x, jnp.any(groups.mask, axis=1), train=train))

    def _density_scale(self, density: Array, groups: Neighbors, train: bool) -> Float[Array, "m k 1"]:
        x = relative_inverse_density(density, groups)[..., None]
        if self.config.grouped:
            x = Pointwise((DENSITY_CHANNELS,), self.axis_names, name="density_net")(x, groups.mask, train=train)
        else:
            x = nn.relu(nn.Dense(DENSITY_CHANNELS, name="density_net")(x))
        return nn.sigmoid(nn.Dense(1, name="density_scale")(x))

    def _kernel_inputs(self, offset: Array, own: Array, others: Array, groups: Neighbors) -> Float[Array, "m k v"]:
        """Relative positions in units of the group's radius, and angles between normals and offset free of signs."""
        radius = safe.sqrt(jnp.max(groups.sq_distance, axis=1))[:, None, None]
        offset = safe.divide(offset, jnp.broadcast_to(radius, offset.shape))
        if self.config.kernel == "position":
            return offset
        along = jnp.abs(jnp.sum(offset * own[:, None, :], axis=-1, keepdims=True))
        along_other = jnp.abs(jnp.sum(offset * others, axis=-1, keepdims=True))
        cosine = jnp.abs(jnp.sum(others * own[:, None, :], axis=-1, keepdims=True))
        return jnp.concatenate([offset, along, along_other, cosine], axis=-1)


def weighted_sum(weights: Float[Array, "m k v"], grouped: Float[Array, "m k c"]) -> Float[Array, "m v c"]:
    """The reordered product: for each centroid the sum over neighbours of weight times feature."""
    return jnp.einsum("mkv,mkc->mvc", weights, grouped)


def _of_points(groups: Neighbors, mask: Bool[Array, "m"]) -> Neighbors:
    """The groups, empty around centroids of padding: those are copies of a point, and would count it twice."""
    return groups._replace(mask=groups.mask & mask[:, None])


class PointConvNet(nn.Module):
    """Encoder and decoder of PointConv layers over a hierarchy: features of level 0 in, features of its queries out."""

    config: PointConvConfig
    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self,
        hierarchy: Hierarchy,
        features: Float[Array, "n c"],
        normals: Float[Array, "n 3"],
        query: Array | None = None,
        *,
        train: bool,
    ) -> Float[Array, "q d"]:
        """Features at the rows `query` of level 0 (None = all).

        Args:
            hierarchy: of the cloud.
            features: what is known of each point.
            normals: unit, of either sign, estimated from the cloud.
            query: int32 rows.
            train: whether normalisation takes the statistics of this batch.
        """
        widths, names = self.config, self.axis_names
        features = Pointwise(widths.stem, names, name="stem")(features, hierarchy.mask[0], train=train)
        levels, level_normals = [features], [normals]
        for step, (*mlp, channels) in enumerate(widths.encoder):
            level_normals.append(level_normals[-1][hierarchy.index[step]])
            convolution = PointConv(channels, self.config, tuple(mlp), names, name=f"encoder_{step}")
            levels.append(
                convolution(
                    hierarchy.points[step + 1],
                    level_normals[step + 1],
                    hierarchy.points[step],
                    level_normals[step],
                    hierarchy.mask[step],
                    levels[step],
                    hierarchy.density[step],
                    _of_points(hierarchy.encoder_groups[step], hierarchy.mask[step + 1]),
                    train=train,
                )
            )
        x = levels[-1]
        for step in reversed(range(len(widths.encoder))):
            rows = query if step == 0 else None
            x = self._decode(hierarchy, step, x, levels[step], level_normals[step], rows, train)
        return x

    def _decode(self, hierarchy: Hierarchy, step: int, coarse, skip, normals, query, train: bool) -> Array:
        """Features of level `step` (at the queries only, if given) from those of level step + 1 and the encoder's."""
        points, mask = hierarchy.points[step], hierarchy.mask[step]
        groups = _of_points(hierarchy.decoder_groups[step], mask)
        weights, name = hierarchy.interpolation[step], f"decoder_{step}"
        if groups.index.shape[1] == 0:
            if query is not None:
                weights = InterpolationWeights(weights.index[query], weights.weight[query])
                skip, mask = skip[query], mask[query]
            joined = jnp.concatenate([interpolate(coarse, weights), skip], axis=-1)
            return Pointwise(self.config.decoder[step], self.axis_names, name=name)(joined, mask, train=train)
        x = interpolate(coarse, weights)
        if self.config.order == "paper":
            first, channels, *rest = self.config.decoder[step]
            x = jnp.concatenate([x, skip], axis=-1)
            x = Pointwise((first,), self.axis_names, name=f"{name}_join")(x, mask, train=train)
        else:
            channels, *rest = self.config.decoder[step]
        centroids, own = points, normals
        if query is not None:
            groups = Neighbors(*(field[query] for field in groups))
            centroids, own, skip = points[query], normals[query], skip[query]
        convolution = PointConv(channels, self.config, (), self.axis_names, name=name)
        x = convolution(centroids, own, points, normals, mask, x, hierarchy.density[step], groups, train=train)
        if self.config.order == "pointconv":
            x = jnp.concatenate([x, skip], axis=-1)
        valid = mask if query is None else mask[query]
        return Pointwise(tuple(rest), self.axis_names, name=f"{name}_mlp")(x, valid, train=train)
