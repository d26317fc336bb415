"""PointNet++ (C. R. Qi et al., NeurIPS 2017) with the sizes of SPFN (L. Li et al., CVPR 2019): the second backbone.

A set abstraction takes the largest value of each channel over the neighbours of a centroid, a propagation carries
features back by interpolation and joins the skip link. Groups are the nearest points within a radius, where the
original takes the first in storage order. Two forms of the abstraction:
  grouped   as published: an MLP on the gathered (m, k, c) features, then the maximum;
  else      max_j (A f_j + V x_j) - V x_i, normalisation and ReLU after the maximum: no layer on the groups.
Letters: m centroids among n points, k neighbours, c channels.
"""

from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jprimfit.geometry.grouping import gather
from jprimfit.geometry.hierarchy import Hierarchy
from jprimfit.geometry.interpolation import InterpolationWeights, interpolate
from jprimfit.networks.layers import BatchNorm, Pointwise
from jprimfit.types import Neighbors


@dataclass(frozen=True)
class PointNet2Config:
    """Widths; entry l belongs to the step between levels l and l + 1. The defaults are SPFN's."""

    stem: tuple[int, ...] = ()  # pointwise widths at level 0
    encoder: tuple[tuple[int, ...], ...] = ((64, 64, 128), (128, 128, 256), (256, 512, 1024))
    decoder: tuple[tuple[int, ...], ...] = ((128, 128, 128), (256, 128), (256, 256))
    grouped: bool = True


class SetAbstraction(nn.Module):
    """The largest feature of each channel over every centroid's group."""

    widths: tuple[int, ...]
    grouped: bool = True
    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self,
        centroids: Float[Array, "m 3"],
        points: Float[Array, "n 3"],
        mask: Bool[Array, "n"],
        features: Float[Array, "n c"],
        groups: Neighbors,
        *,
        train: bool,
    ) -> Float[Array, "m d"]:
        """Features of the centroids; with a single centroid its group keeps absolute positions (SPFN's group-all)."""
        origin = jnp.zeros_like(centroids) if len(centroids) == 1 else centroids
        if self.grouped:
            offset = gather(points, groups.index) - origin[:, None, :]
            x = jnp.concatenate([offset, gather(features, groups.index)], axis=-1)
            x = Pointwise(self.widths, self.axis_names, name="mlp")(x, groups.mask, train=train)
            # Padding repeats the first neighbour, so it never changes a maximum.
            return jnp.max(x, axis=1)
        *before, channels = self.widths
        x = Pointwise(tuple(before), self.axis_names, name="mlp")(features, mask, train=train)
        place = nn.Dense(channels, use_bias=False, name="place")
        x = nn.Dense(channels, use_bias=False, name="edge")(x) + place(points)
        x = jnp.max(gather(x, groups.index), axis=1) - place(origin)
        return nn.relu(BatchNorm(self.axis_names, name="norm")(x, jnp.any(groups.mask, axis=1), train=train))


class PointNet2(nn.Module):
    """Set abstractions down a hierarchy and propagations back up: features of level 0 in, of its queries out."""

    config: PointNet2Config
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
        """Features at the rows `query` of level 0 (None = all); normals are not looked at."""
        widths, names = self.config, self.axis_names
        levels = [Pointwise(widths.stem, names, name="stem")(features, hierarchy.mask[0], train=train)]
        for step, channels in enumerate(widths.encoder):
            groups, valid = hierarchy.encoder_groups[step], hierarchy.mask[step + 1]
            # Centroids of padding are copies of a point, and would count it twice.
            groups = groups._replace(mask=groups.mask & valid[:, None])
            levels.append(
                SetAbstraction(channels, widths.grouped, names, name=f"encoder_{step}")(
                    hierarchy.points[step + 1],
                    hierarchy.points[step],
                    hierarchy.mask[step],
                    levels[step],
                    groups,
                    train=train,
                )
            )
        x = levels[-1]
        for step in reversed(range(len(widths.encoder))):
            weights, skip, mask = hierarchy.interpolation[step], levels[step], hierarchy.mask[step]
            if step == 0 and query is not None:
                weights = InterpolationWeights(weights.index[query], weights.weight[query])
                skip, mask = skip[query], mask[query]
            x = jnp.concatenate([interpolate(x, weights), skip], axis=-1)
            x = Pointwise(widths.decoder[step], names, name=f"decoder_{step}")(x, mask, train=train)
        return x
