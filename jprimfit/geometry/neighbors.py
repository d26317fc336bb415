"""Neighbourhoods of fixed size: k nearest points, ball query, and both together.

Exact brute force with direct differences |q - p|², never |q|² - 2 q·p + |p|², which loses the small distances (and, in
TF32, one neighbour in seventy). Queries are handled in chunks, so memory grows as chunk × n. Every search is "the k
smallest keys, ties to the lowest index" with the key that its rule asks for. The host's kd-tree (geometry/host) gives
the same neighbours faster on a CPU; this file is for the accelerator, and for what must stay inside jit.
m queries, n points, k neighbours; points outside point_mask are never found.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jprimfit.types import Neighbors


def knn(
    queries: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    k: int,
    chunk: int | None = None,
) -> Neighbors:
    """The k nearest points of every query, ordered by (distance, index).

    points[index[i, j]] is the j-th nearest to queries[i]; a query that is itself one of the points finds itself first
    (or an earlier duplicate). count is the number of valid points; k above it leaves padding, as Neighbors says.
    chunk is the number of queries handled at once; by default as many as keep the distances in the cache of a CPU, or
    an accelerator busy. Nothing is differentiated: where a gradient is wanted, recompute the distance from index.
    """
    return _search(queries, points, point_mask, None, k=k, chunk=chunk, nearest=True)


def ball(
    queries: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    radius: float | Float[Array, ""] | Float[Array, "m"],
    k: int,
    chunk: int | None = None,
) -> Neighbors:
    """The first k points, in index order, that lie closer than radius to every query.

    points[index[i, j]] is the j-th point of the cloud with |points - queries[i]| < radius; count says how many there
    are, kept or not. radius is one length or one per query. The rule is that of PointNet++ (Qi et al., 2017), whose
    padding, the first hit repeated, is that of Neighbors too.
    """
    return _search(queries, points, point_mask, radius, k=k, chunk=chunk, nearest=False)


def ball_nearest(
    queries: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    radius: float | Float[Array, ""] | Float[Array, "m"],
    k: int,
    chunk: int | None = None,
) -> Neighbors:
    """The k nearest points that lie closer than radius to every query, ordered by (distance, index).

    As knn, with everything at radius or farther left out; count is the number of points inside, kept or not.
    """
    return _search(queries, points, point_mask, radius, k=k, chunk=chunk, nearest=True)


def sq_distances(
    x: Float[Array, "*shape"], y: Float[Array, "*shape"], z: Float[Array, "*shape"], point: Float[Array, "3"]
) -> Float[Array, "*shape"]:
    """Squared distances of point to points given by their coordinates, by direct differences.

    One expression for everything that has to agree to the last bit: under jit XLA contracts a·b + c into one rounding,
    and does so alike in programs of every shape as long as the expression is the same.
    """
    return (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2


def _search(queries, points, point_mask, radius, *, k: int, chunk: int | None, nearest: bool) -> Neighbors:
    """Neighbours inside radius (None: no limit), by distance or by index: one query at a time, vmapped over chunks."""
    if k < 1:
        raise ValueError(f"k is {k}, but a neighbourhood holds at least one point: give k >= 1.")
    (num_queries, _), (num_points, _) = queries.shape, points.shape
    queries, points = lax.stop_gradient((queries, points))
    block = _block_size(num_points, k)
    padding = max(k, -(-num_points // block) * block) - num_points
    valid = jnp.ones(num_points, bool) if point_mask is None else point_mask
    valid = jnp.pad(valid, (0, padding))
    num_valid = jnp.sum(valid, dtype=jnp.int32)
    x, y, z = jnp.pad(points, ((0, padding), (0, 0))).T
    limit = jnp.asarray(jnp.inf if radius is None else radius, points.dtype)
    sq_limit = lax.stop_gradient(jnp.broadcast_to(limit, num_queries) ** 2)

    def neighborhood(item: tuple[Array, Array]) -> Neighbors:
        query, sq_limit = item
        sq_distance = sq_distances(x, y, z, query)
        inside = valid & (sq_distance < sq_limit)
        # The barrier has the keys written once: two passes read them, and XLA would recompute the distances in each.
        key = lax.optimization_barrier(jnp.where(inside, sq_distance if nearest else 0.0, jnp.inf))
        index = _smallest(key, k=k, block=block)
        mask = key[index] < jnp.inf
        index = jnp.where(mask, index, jnp.where(mask[0], index[0], 0))
        found = key[index] if nearest else sq_distances(x[index], y[index], z[index], query)
        count = num_valid if radius is None else jnp.sum(key < jnp.inf, dtype=jnp.int32)
        return Neighbors(index, jnp.where(mask[0], found, 0.0), mask, count)

    if chunk is None:
        chunk = max(1, _chunk_elements() // max(1, num_points))
    return lax.map(neighborhood, (queries, sq_limit), batch_size=min(chunk, max(1, num_queries)))


def _smallest(key: Float[Array, "n"], *, k: int, block: int) -> Int[Array, "k"]:
    """Indices of the k smallest keys, ordered by (key, index).

    In two exact rounds, because top_k costs per element it looks at: the k blocks with the smallest minima hold the k
    smallest keys. Ties too: a key of a block that was not chosen is preceded, in (key, index), by the minima of the
    k chosen ones, for these are smaller, or equal in an earlier block.
    """
    if block == 1:
        return _first(key, k)
    blocks = key.reshape(-1, block)
    chosen = jnp.sort(_first(jnp.min(blocks, axis=1), k))  # sorted, because ties are broken by position
    slot = _first(blocks[chosen].reshape(-1), k)
    return chosen[slot // block] * block + slot % block


def _first(key: Float[Array, "n"], k: int) -> Int[Array, "k"]:
    """Indices of the k smallest keys in one round, ordered by (key, index)."""
    # The barrier keeps later slices away: XLA on a CPU finds its fast top_k only where nothing else reads the sort.
    return lax.optimization_barrier(lax.top_k(-key, k))[1]


def _block_size(num_points: int, k: int) -> int:
    """Points per block for which both rounds of _smallest see about sqrt(n k) keys; 1 where one round is as good."""
    ratio = num_points // k
    return 1 if ratio < 64 else 2 ** ((ratio.bit_length() - 1) // 2)


def _chunk_elements() -> int:
    """Distances held at once by default: 2 MB on a CPU (its cache; larger is slower), 128 MB elsewhere, in float32."""
    return 2**19 if jax.default_backend() == "cpu" else 2**25
