"""All index sets, densities and interpolation weights of a cloud, built once, so that a network is matrix work only.

Level 0 is the cloud, level l + 1 a farthest-point sample of level l. An encoder layer takes features from level l to
l + 1 over groups around the sampled points, a decoder layer brings them back by interpolation, followed by a
convolution over groups of level l among itself. The default is PointConv's ScanNet table (W. Wu et al., CVPR 2019).
Index sets do not change under rotation, so a data loader may build them once per cloud (host.build_hierarchy).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer

from jprimfit.geometry.density import gaussian_density
from jprimfit.geometry.grouping import within
from jprimfit.geometry.interpolation import InterpolationWeights, from_neighbors
from jprimfit.geometry.neighbors import knn
from jprimfit.geometry.sampling import farthest_points
from jprimfit.types import Neighbors

NUM_INTERPOLATED = 3  # coarse points that a fine point interpolates from


@dataclass(frozen=True)
class HierarchySpec:
    """Sizes and radii of every step; entry l of each tuple belongs to the step between levels l and l + 1.

    Lengths are meant in the normalised frame. Hashable, hence a static argument of jit.
    """

    num_points: tuple[int, ...] = (1024, 256, 64, 36)  # of level l + 1, not increasing
    encoder_neighbors: tuple[int, ...] = (32, 32, 32, 32)  # in a group of level l around a point of level l + 1
    decoder_neighbors: tuple[int, ...] = (16, 16, 16, 16)  # in a group of level l around a point of level l; 0 = none
    density_neighbors: tuple[int, ...] = (32, 32, 32, 32)  # at most, in the mean that is the density of level l
    density_radius: tuple[float, ...] = (0.1, 0.2, 0.4, 0.8)
    density_variance: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    max_radius: tuple[float, ...] = (math.inf, math.inf, math.inf, math.inf)  # caps the adaptive radius of all groups

    def __post_init__(self) -> None:
        lengths = {field.name: len(getattr(self, field.name)) for field in fields(self)}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"a HierarchySpec needs one value per step in every entry, but the lengths are {lengths}")
        if any(coarse > fine for fine, coarse in zip(self.num_points, self.num_points[1:], strict=False)):
            raise ValueError(f"num_points must not increase from level to level, but is {self.num_points}")

    @property
    def num_steps(self) -> int:
        """Steps between levels; there is one level more."""
        return len(self.num_points)

    def own_neighbors(self, step: int) -> int:
        """How many neighbours among themselves the points of level `step` need: all groups are the first of these."""
        return max(self.encoder_neighbors[step], self.decoder_neighbors[step], self.density_neighbors[step])


class Hierarchy(NamedTuple):
    """A cloud at every level. Tuples over levels (L + 1 entries) or over the steps between levels l and l + 1 (L)."""

    points: tuple[Float[Array, "n 3"], ...]  # per level; points[l + 1] = points[l][index[l]]
    mask: tuple[Bool[Array, "n"], ...]  # per level, False = padding, a copy of the first: too few points
    index: tuple[Int[Array, "m"], ...]  # per step, int32: rows of level l that are the points of level l + 1
    encoder_groups: tuple[Neighbors, ...]  # per step: around the points of level l + 1, among those of level l
    decoder_groups: tuple[Neighbors, ...]  # per step: around the points of level l, among themselves
    density: tuple[Float[Array, "n"], ...]  # per step, of the points of level l: see geometry/density
    interpolation: tuple[InterpolationWeights, ...]  # per step: from the points of level l + 1 to those of level l


class IndexSets(NamedTuple):
    """What has to be stored of a hierarchy to have it again: everything else follows from the points.

    Rows are uint16 where every level has at most 65,536 points, int32 otherwise. A column beyond a group's count is
    padding, and repeats the first.
    """

    index: tuple[Int[Array, "m"], ...]  # per step: as Hierarchy.index
    encoder_index: tuple[Int[Array, "m k"], ...]  # per step: the index of Hierarchy.encoder_groups
    encoder_count: tuple[Int[Array, "m"], ...]  # per step: valid columns of each row, uint8 or int32
    decoder_index: tuple[Int[Array, "n k"], ...]
    decoder_count: tuple[Int[Array, "n"], ...]
    interpolation_index: tuple[Int[Array, "n 3"], ...]
    density: tuple[Float[Array, "n"], ...]  # float32, as Hierarchy.density


class Searches(NamedTuple):
    """What a hierarchy is assembled from: the answers of the searches, by whatever means they were found."""

    sample: Int[Array, "m"]  # rows of the cloud in farthest-point order, num_points[0] of them
    own: tuple[Neighbors, ...]  # per step: of the points of level l among themselves, own_neighbors(l) of them
    coarse: tuple[Neighbors, ...]  # per step: of the points of level l among those of level l + 1, three of them


def build(
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    spec: HierarchySpec,
    neighbors: Neighbors | None = None,
) -> Hierarchy:
    """The hierarchy of one cloud by jittable code; brute-force searches, so O(n^2) work in O(n) memory.

    The same as host.build_hierarchy except where squared distances tie within rounding. neighbors: those of the points
    among themselves, spec.own_neighbors(0) or more, if already known.
    """
    mask = jnp.ones(len(points), bool) if point_mask is None else point_mask
    sample = farthest_points(points, point_mask, num_samples=spec.num_points[0])
    clouds, masks, _ = levels(points, mask, sample, spec=spec)
    own, coarse = [], []
    for step in range(spec.num_steps):
        if step == 0 and neighbors is not None:
            own.append(nearest(neighbors, k=spec.own_neighbors(0)))
        else:
            own.append(knn(clouds[step], clouds[step], masks[step], k=spec.own_neighbors(step)))
        coarse.append(knn(clouds[step], clouds[step + 1], masks[step + 1], k=NUM_INTERPOLATED))
    return assemble(points, mask, Searches(sample, tuple(own), tuple(coarse)), spec=spec)


def index_sets(hierarchy: Hierarchy) -> IndexSets:
    """What to store of a hierarchy of NumPy arrays; rotation does not change it."""
    small = max(len(points) for points in hierarchy.points) <= 1 << 16

    def rows(index: Any) -> np.ndarray:
        return np.asarray(index, np.uint16 if small else np.int32)

    def counts(groups: Neighbors) -> np.ndarray:
        widest = groups.mask.shape[1]
        return np.asarray(np.sum(groups.mask, axis=1), np.uint8 if widest < 256 else np.int32)

    stored: tuple[Any, ...] = (
        tuple(rows(index) for index in hierarchy.index),
        tuple(rows(groups.index) for groups in hierarchy.encoder_groups),
        tuple(counts(groups) for groups in hierarchy.encoder_groups),
        tuple(rows(groups.index) for groups in hierarchy.decoder_groups),
        tuple(counts(groups) for groups in hierarchy.decoder_groups),
        tuple(rows(weights.index) for weights in hierarchy.interpolation),
        tuple(np.asarray(density, np.float32) for density in hierarchy.density),
    )
    return IndexSets(*stored)


def layout(num_points: int, *, spec: HierarchySpec) -> IndexSets:
    """Shapes and types of the index sets of a cloud of that many points, as jax.ShapeDtypeStructs."""
    sizes = (num_points, *spec.num_points)
    row = jnp.uint16 if max(sizes) <= 1 << 16 else jnp.int32

    def arrays(dtype: Any, *sides: Sequence[int]) -> tuple[Any, ...]:
        return tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in zip(*sides, strict=True))

    def counts(lengths: Sequence[int], widths: Sequence[int]) -> tuple[Any, ...]:
        types = (jnp.uint8 if width < 256 else jnp.int32 for width in widths)
        return tuple(jax.ShapeDtypeStruct((length,), dtype) for length, dtype in zip(lengths, types, strict=True))

    fine, coarse = sizes[:-1], sizes[1:]
    stored: tuple[Any, ...] = (
        arrays(row, coarse),
        arrays(row, coarse, spec.encoder_neighbors),
        counts(coarse, spec.encoder_neighbors),
        arrays(row, fine, spec.decoder_neighbors),
        counts(fine, spec.decoder_neighbors),
        arrays(row, fine, [NUM_INTERPOLATED] * spec.num_steps),
        arrays(jnp.float32, fine),
    )
    return IndexSets(*stored)


def from_index_sets(
    points: Float[Array, "n 3"], sets: IndexSets, point_mask: Bool[Array, "n"] | None = None
) -> Hierarchy:
    """The hierarchy of a cloud whose index sets are known: gathers and differences only, no search. Jittable.

    points may be moved rigidly since the sets were built.
    """
    clouds = [points]
    masks = [jnp.ones(len(points), bool) if point_mask is None else point_mask]
    encoder, decoder, interpolation = [], [], []
    for step, rows in enumerate(sets.index):
        rows = rows.astype(jnp.int32)
        found = masks[-1][rows] & ((jnp.arange(len(rows)) == 0) | (rows != rows[0]))
        clouds.append(clouds[-1][rows])
        masks.append(found)
        encoder.append(_groups(clouds[step + 1], clouds[step], sets.encoder_index[step], sets.encoder_count[step]))
        decoder.append(_groups(clouds[step], clouds[step], sets.decoder_index[step], sets.decoder_count[step]))
        coarse = sets.interpolation_index[step].astype(jnp.int32)
        sq_distance = jnp.sum(jnp.square(clouds[step][:, None, :] - clouds[step + 1][coarse]), axis=2)
        # A level of one or two points fills its three places with copies of the first.
        mask = masks[-1][coarse] & ((jnp.arange(coarse.shape[1])[None, :] == 0) | (coarse != coarse[:, :1]))
        interpolation.append(from_neighbors(Neighbors(coarse, sq_distance, mask, jnp.sum(mask, axis=1))))
    index = tuple(rows.astype(jnp.int32) for rows in sets.index)
    return Hierarchy(
        tuple(clouds), tuple(masks), index, tuple(encoder), tuple(decoder), sets.density, tuple(interpolation)
    )


def _groups(
    queries: Float[Array, "m 3"], points: Float[Array, "n 3"], index: Integer[Array, "m k"], count: Integer[Array, "m"]
) -> Neighbors:
    """Neighbourhoods whose rows are known."""
    index, count = index.astype(jnp.int32), count.astype(jnp.int32)
    sq_distance = jnp.sum(jnp.square(points[index] - queries[:, None, :]), axis=2)
    mask = jnp.arange(index.shape[1])[None, :] < count[:, None]
    return Neighbors(index, sq_distance, mask, count)


def levels(
    points: Float[Array, "n 3"], mask: Bool[Array, "n"], sample: Int[Array, "m"], *, spec: HierarchySpec
) -> tuple[tuple[Array, ...], tuple[Array, ...], tuple[Array, ...]]:
    """Points and masks of every level, and the rows of each level in the one before."""
    # A farthest-point sample of points that stand in farthest-point order is its beginning, so one run serves all.
    index, clouds, masks = [], [points], [mask]
    for step, num in enumerate(spec.num_points):
        rows = jnp.arange(num, dtype=jnp.int32) if step else sample
        # The sample repeats its first row once no other point is left; the very first is a point if any is.
        found = masks[-1][rows] & ((jnp.arange(num) == 0) | (rows != rows[0]))
        index.append(jnp.where(found, rows, rows[0]))
        clouds.append(clouds[-1][index[-1]])
        masks.append(found)
    return tuple(clouds), tuple(masks), tuple(index)


def assemble(
    points: Float[Array, "n 3"], point_mask: Bool[Array, "n"], searches: Searches, *, spec: HierarchySpec
) -> Hierarchy:
    """The hierarchy from the answers of its searches: groups, densities and interpolation weights.

    Points of level l + 1 are points of level l, so one search among the latter serves both kinds of groups and the
    density: each is the first columns of its rows.
    """
    clouds, masks, index = levels(points, point_mask, searches.sample, spec=spec)
    encoder, decoder, density = [], [], []
    for step, own in enumerate(searches.own):
        around = _rows(nearest(own, k=spec.encoder_neighbors[step]), index[step])
        among = nearest(own, k=spec.decoder_neighbors[step])
        encoder.append(within(around, max_radius=spec.max_radius[step]).neighbors)
        decoder.append(within(among, max_radius=spec.max_radius[step]).neighbors)
        density.append(
            gaussian_density(
                nearest(own, k=spec.density_neighbors[step]),
                variance=spec.density_variance[step],
                radius=spec.density_radius[step],
            )
        )
    weights = tuple(from_neighbors(coarse) for coarse in searches.coarse)
    return Hierarchy(clouds, masks, index, tuple(encoder), tuple(decoder), tuple(density), weights)


def nearest(neighbors: Neighbors, *, k: int) -> Neighbors:
    """The first k columns."""
    return Neighbors(neighbors.index[:, :k], neighbors.sq_distance[:, :k], neighbors.mask[:, :k], neighbors.count)


def _rows(neighbors: Neighbors, rows: Int[Array, "m"]) -> Neighbors:
    """The neighbourhoods of some of the queries."""
    return Neighbors(neighbors.index[rows], neighbors.sq_distance[rows], neighbors.mask[rows], neighbors.count[rows])
