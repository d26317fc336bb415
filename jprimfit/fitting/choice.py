"""Which of the four kinds a surface is, once it is known which points lie on it and what lies around them.

While a surface grows, a kind is rewarded for every point that it explains. A sphere that bends over the rim of a low
ring takes points of the faces above and below, and wins by them against the cylinder that the ring is. Held against
those faces it loses: a point costs what the best of its surfaces makes of it, so that only what no neighbour explains
as well speaks for a kind,

    sum_n min(d_n^2 / 2 noise^2, what the others make of n, FAR) + f / 2 log n,

with d the distances and f the degrees of freedom: Schwarz's criterion (1978). Host code around the jitted fits of
fitting/kinds; lengths in the normalised frame. n points, s surfaces.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jprimfit.fitting import kinds
from jprimfit.fitting.growing import SIGNIFICANT
from jprimfit.fitting.local import LocalSurface
from jprimfit.fitting.merging import Surface
from jprimfit.primitives.table import MODULES
from jprimfit.types import Primitive

FAR = 4.5  # nats: a point three standard deviations away; what lies farther off costs no more
LEAST = 24  # points that are asked

NUM_VOTERS = 9  # neighbours, as in assignment, through which surfaces touch


def chosen(
    points: Float[np.ndarray, "n 3"],
    described: LocalSurface,
    surfaces: list[Surface],
    labels: Int[np.ndarray, " n"],
    *,
    noise: float,
    sought: Sequence[str],
) -> list[Surface]:
    """The surfaces in the kinds that their points and their neighbours speak for."""
    cost = np.stack([_cost(surface.primitive, points, noise) for surface in surfaces]) if surfaces else np.zeros((0, 0))
    return [
        _chosen(points, described, labels, number, surface, cost, noise, sought)
        for number, surface in enumerate(surfaces)
    ]


def _chosen(points, described, labels, number: int, surface: Surface, cost, noise, sought) -> Surface:
    rows = np.flatnonzero(labels == number)
    if len(rows) < LEAST:
        return surface
    around = np.unique(labels[described.index[rows, :NUM_VOTERS]])
    around = around[(around >= 0) & (around != number)]
    others = np.minimum(cost[around][:, rows].min(axis=0), FAR) if len(around) else np.full(len(rows), FAR)
    own = surface.primitive.kind
    lengths = {own: _length(surface.primitive, points[rows], others, noise)}
    found = {own: surface.primitive}
    for kind in (own, *(kind for kind in sought if kind != own)):
        primitive = _fitted(points, described, rows, kind, others, noise)
        if primitive is not None:
            length = _length(primitive, points[rows], others, noise)
            if length < lengths.get(kind, np.inf):
                lengths[kind], found[kind] = length, primitive
    best = min(lengths, key=lambda kind: lengths[kind])
    return surface if lengths[own] - lengths[best] < SIGNIFICANT else Surface(surface.rows, found[best])


def _fitted(points, described, rows, kind: str, others: Float[np.ndarray, " r"], noise: float) -> Primitive | None:
    """Fitted to the rows that it explains better than the others do."""
    core = described.core[rows]
    found = kinds.fit(kind, points, described.normal, rows[core] if core.sum() >= LEAST else rows)
    if found is None:
        return None
    mine = rows[_cost(found.primitive, points[rows], noise) <= np.minimum(others + 0.5, FAR)]
    again = kinds.fit(kind, points, described.normal, mine, start=found.primitive) if len(mine) >= LEAST else None
    return again.primitive if again else None


def _cost(primitive: Primitive, points: Float[np.ndarray, "n 3"], noise: float) -> Float[np.ndarray, " n"]:
    return 0.5 * np.square(kinds.distances(primitive, points) / noise)


def _length(primitive: Primitive, points, others: Float[np.ndarray, " n"], noise: float) -> float:
    """The length of the description, in nats."""
    freedom = MODULES[primitive.kind].NUM_FREEDOM
    return float(np.minimum(_cost(primitive, points, noise), others).sum()) + 0.5 * freedom * np.log(len(points))
