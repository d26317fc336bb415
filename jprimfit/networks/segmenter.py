"""The network: features of each point by a backbone, and heads for instances, types and normals.

Instances come from one of two heads. "slots" is the paper's and SPFN's: a softmax over a fixed number of columns.
"prototype" places every point in a space where the points of one instance lie close together (cross-entropy over
-2 |e - mean|^2, objectives/prototypes.py): no limit on the number, and a membership matrix all the same. Types are
told point by point, or ("pooled", the paper's classifier) from the largest features within each segment.
Letters: n points, q queries, g neighbourhood sizes, s segments, c channels.
"""

from dataclasses import dataclass, field
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.hierarchy import Hierarchy, HierarchySpec
from jprimfit.networks.inputs import point_features
from jprimfit.networks.layers import Pointwise
from jprimfit.networks.pointconv import PointConvConfig, PointConvNet
from jprimfit.networks.pointnet2 import PointNet2, PointNet2Config
from jprimfit.types import Prediction

NUM_TYPES = 4


@dataclass(frozen=True)
class SegmenterConfig:
    """Everything that fixes the network's shape, and what it has to be given."""

    backbone: Literal["pointconv", "pointnet2"] = "pointconv"
    hierarchy: HierarchySpec = field(default_factory=HierarchySpec)
    pointconv: PointConvConfig = field(default_factory=PointConvConfig)
    pointnet2: PointNet2Config = field(default_factory=PointNet2Config)
    num_points: int = 8192  # of the cloud it works on; more are thinned, fewer are padded
    features: tuple[str, ...] = ("xyz",)  # some of "xyz", "pca"
    neighborhoods: tuple[int, ...] = (16,)  # neighbours in each PCA, ascending; 0 = geometry/filtering of the others
    head: Literal["slots", "prototype"] = "slots"
    num_slots: int = 28
    embedding_size: int = 32
    shared: int = 128  # channels of the layer before the heads
    dropout: float = 0.0  # share of its outputs that training drops
    types: Literal["point", "pooled"] = "point"
    normals: Literal["free", "pca", "neighbors"] = "free"  # a vector, or those given, turned

    def __post_init__(self) -> None:
        if self.normals == "neighbors" and self.hierarchy.decoder_neighbors[0] == 0:
            raise ValueError('normals "neighbors" needs hierarchy.decoder_neighbors of at least 1 at the finest level.')


class Segmenter(nn.Module):
    """The whole network for one cloud; batches are vmapped with the axis names that its statistics run over."""

    config: SegmenterConfig
    axis_names: tuple[str, ...] = ("cloud",)

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n 3"],
        hierarchy: Hierarchy,
        local_normals: Float[Array, "n g 3"],
        curvature: Float[Array, "n g"],
        query: Int[Array, "q"] | None = None,
        *,
        train: bool = False,
        segments: Float[Array, "q s"] | None = None,
    ) -> Prediction:
        """What the network says of the queries.

        Args:
            points: in the normalised frame; the hierarchy is theirs.
            hierarchy: of spec config.hierarchy.
            local_normals: at config.neighborhoods, of either sign.
            curvature: of the same neighbourhoods.
            query: rows of points that are asked for; None = all.
            train: dropout and the statistics of the batch, or neither.
            segments: membership of the queries whose types are asked for, with types "pooled".
        """
        config = self.config
        features = point_features(points, local_normals, curvature, features=config.features)
        if config.backbone == "pointconv":
            backbone: nn.Module = PointConvNet(config.pointconv, self.axis_names, name="backbone")
        else:
            backbone = PointNet2(config.pointnet2, self.axis_names, name="backbone")
        x = backbone(hierarchy, features, local_normals[:, 0], query, train=train)
        if query is None:
            mask, normals = hierarchy.mask[0], local_normals
        else:
            mask, normals = hierarchy.mask[0][query], local_normals[query]
        x = Pointwise((config.shared,), self.axis_names, name="shared")(x, mask, train=train)
        x = nn.Dropout(config.dropout, deterministic=not train)(x)
        slots = config.head == "slots"
        instance = nn.Dense(config.num_slots if slots else config.embedding_size, name="instance")(x)
        pooled = None
        if config.types == "pooled" and segments is not None:
            pooled = SegmentTypes(name="segment_types")(x, segments)
        return Prediction(
            normals=self._normals(x, normals, self._around(x, points, hierarchy, local_normals, curvature, query)),
            type_logits=nn.Dense(NUM_TYPES, name="types")(x),
            features=x,
            membership_logits=instance if slots else None,
            embedding=None if slots else instance,
            segment_type_logits=pooled,
        )

    def _around(self, x, points, hierarchy, local_normals, curvature, query) -> Float[Array, "q 3 3"] | None:
        """sum_j a_ij n_j n_jᵀ over the neighbours j of each query, None unless they have a say in its normal.

        a is a softmax over the neighbours of what the features of i make of how j lies: the heights of each over the
        other's tangent plane in units of the group's radius, the angle of their normals, and the curvature at both.
        """
        if self.config.normals != "neighbors":
            return None
        groups, own, bend = hierarchy.decoder_groups[0], local_normals[:, 0], safe.sqrt(curvature)
        around = groups.index if query is None else groups.index[query]
        mask = groups.mask if query is None else groups.mask[query]
        rows = jnp.arange(len(points)) if query is None else query
        others = own[around]
        offset = points[around] - points[rows][:, None, :]
        sq_distance = jnp.sum(offset * offset, axis=-1)
        radius = safe.sqrt(jnp.max(jnp.where(mask, sq_distance, 0), axis=1))[:, None]
        seen = [
            safe.divide(jnp.sum(offset * own[rows][:, None, :], axis=-1), radius),
            safe.divide(jnp.sum(offset * others, axis=-1), radius),
            jnp.sum(others * own[rows][:, None, :], axis=-1),
            safe.divide(safe.sqrt(sq_distance), radius),
        ]
        bends = [bend[around], bend[rows][:, None, :] - bend[around]]
        lies = jnp.concatenate([jnp.abs(jnp.stack(seen, axis=-1)), *bends], axis=-1)
        keys = nn.relu(nn.Dense(16, name="neighbor_keys")(lies))
        logits = jnp.einsum("qkh,qh->qk", keys, nn.Dense(16, name="neighbor_query")(x))
        share = nn.softmax(jnp.where(mask, logits, jnp.finfo(x.dtype).min / 2), axis=-1)
        return jnp.einsum("qk,qki,qkj->qij", share, others, others)

    def _normals(
        self, x: Float[Array, "q c"], local: Float[Array, "q g 3"], around: Float[Array, "q 3 3"] | None
    ) -> Float[Array, "q 3"]:
        """Unit normals, of either sign.

        With "pca" the vector is M n for n the first of the local normals, M = sum_g a_g n_g n_gᵀ + S and a, S
        (symmetric) from the network; with "neighbors" M has the term of _around, too. As n enters twice in each term
        or once in front, the answer turns its sign with n and with nothing else; at the start S = 0 and it is a mean
        of the local normals.
        """
        if self.config.normals == "free":
            return safe.unit(nn.Dense(3, name="normal")(x))
        near_zero = nn.initializers.normal(1e-3)
        weight = nn.softmax(nn.Dense(local.shape[1], name="normal_weight", kernel_init=near_zero)(x), axis=-1)
        entries = nn.Dense(6, name="normal_turn", kernel_init=near_zero)(x)
        first = local[:, 0]
        cosine = jnp.sum(local * first[:, None, :], axis=-1)
        vector = jnp.sum((weight * cosine)[..., None] * local, axis=1)
        if around is not None:
            vector = vector + jnp.einsum("qij,qj->qi", around, first)
        rows = (entries[:, (0, 1, 2)], entries[:, (1, 3, 4)], entries[:, (2, 4, 5)])
        turned = jnp.stack([jnp.sum(row * first, axis=-1) for row in rows], axis=-1)
        return safe.unit(vector + turned)


class SegmentTypes(nn.Module):
    """The paper's classifier: the largest feature of each channel within a segment, then an MLP (paper.md, 6.3)."""

    @nn.compact
    def __call__(self, features: Float[Array, "q c"], membership: Float[Array, "q s"]) -> Float[Array, "s 4"]:
        """Type logits of each segment; a point counts with its membership. Features must not be negative (ReLU)."""
        # One segment at a time: the product of all would hold q · s · c numbers.
        pooled = lax.map(lambda column: jnp.max(features * column[:, None], axis=0), membership.T)
        x = nn.relu(nn.Dense(features.shape[1], name="hidden")(pooled))
        return nn.Dense(NUM_TYPES, name="types")(x)
