"""A mesh becomes a cloud: points drawn uniformly by area, by a fixed seed, so that a file always gives the same points.

A mesh says where the surface is, its vertices often only where the corners are (a CAD export puts none on a flat face),
so vertices serve as points only where there are no faces. Normals of facets are not passed on: on a triangulated
scan they are noisier than those estimated from neighbours. The few flat facets that a CAD system makes of a round wall
are no planes: how far their middle lies off the wall follows from how sharply they meet. Source of the sampling: Osada
et al. 2002, Shape Distributions, eq. 1.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jprimfit.io.files import BadFile, Cloud, Mesh

NUM_SAMPLES = 65_536
SEED = 0
COARSE = 8  # samples on a facet, on average, from which on it shows as one
FLAT, SMOOTH = np.radians(0.1), np.radians(35.0)  # angles between facets of one face, and of one round wall
MOST = 0.99  # of the length of all such edges
MIN_ROUND = 1e-3  # of the area: less of a mesh is taken for exact


def cloud_of_mesh(mesh: Mesh, path: Path, *, num_samples: int = NUM_SAMPLES, seed: int = SEED) -> Cloud:
    """`num_samples` points of the surface, or the vertices with their normals where the mesh has no faces."""
    if len(mesh.faces) == 0:
        return Cloud(mesh.vertices, mesh.normals)
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise BadFile(
            f"{path} has a face with a corner that is none of its {len(mesh.vertices)} vertices: export it again."
        )
    points = sample(mesh.vertices, mesh.faces, num_samples=num_samples, seed=seed)
    if len(points) == 0:
        raise BadFile(f"{path} is a mesh whose {len(mesh.faces)} faces have no area: export it again.")
    height = chord_height(mesh.vertices, mesh.faces) if COARSE * len(mesh.faces) <= num_samples else None
    return Cloud(points, None, height)


def chord_height(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float | None:
    """How far nearly all facets of round walls lie from the walls they stand for; None where there are no such facets.

    A chord as wide as a facet, turned by an angle against the next, lies width / 2 · tan(angle / 4) off the arc. Of two
    facets the narrower counts: a flat face beside a rounding is no chord of it, nor one with a single such neighbour.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        across = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
        double_area = np.linalg.norm(across, axis=1)
        pairs, length = _neighbors(vertices, faces)
        cosine = np.sum(across[pairs[:, 0]] * across[pairs[:, 1]], axis=1) / double_area[pairs].prod(axis=1)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        width = double_area[pairs] / length[:, None]
    flat = pairs[angle <= FLAT]
    links = coo_matrix((np.ones(len(flat), bool), (flat[:, 0], flat[:, 1])), shape=(len(faces),) * 2)
    facet = connected_components(links, directed=False)[1][pairs]
    bent = (angle > FLAT) & (angle < SMOOTH) & np.isfinite(width).all(axis=1)
    meetings = np.unique(np.sort(facet[bent], axis=1), axis=0)
    num_meetings = np.bincount(meetings.ravel(), minlength=len(faces))
    narrower = np.take_along_axis(facet, width.argmin(axis=1)[:, None], axis=1)[:, 0]
    bent &= num_meetings[narrower] >= 2
    height = width[bent].min(axis=1) / 2.0 * np.tan(angle[bent] / 4.0)
    if not np.sum(width[bent].min(axis=1) * length[bent]) > MIN_ROUND * np.sum(double_area):
        return None
    order = np.argsort(height)
    share = np.cumsum(length[bent][order])
    return float(height[order][np.searchsorted(share, MOST * share[-1])])


def _neighbors(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "e 2"], Float[np.ndarray, " e"]]:
    """The two triangles at every edge that has two, and its length."""
    same = np.unique(vertices, axis=0, return_inverse=True)[1].ravel()[faces]  # STL repeats every vertex
    start, end = same.ravel(), np.roll(same, -1, axis=1).ravel()
    edge = np.unique(np.sort(np.stack([start, end], axis=1), axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(edge, kind="stable")
    begin = np.searchsorted(edge[order], np.flatnonzero(np.bincount(edge) == 2))
    first = order[begin]
    ends = vertices[faces.ravel()[first]], vertices[np.roll(faces, -1, axis=1).ravel()[first]]
    return np.stack([first, order[begin + 1]], axis=1) // 3, np.linalg.norm(ends[1] - ends[0], axis=1)


def sample(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], *, num_samples: int, seed: int
) -> Float[np.ndarray, "n 3"]:
    """Points distributed uniformly over the triangles; none if no triangle has a finite area greater than 0."""
    corner = vertices[faces[:, 0]]
    with np.errstate(over="ignore", invalid="ignore"):  # vertices may be infinite or too far apart to subtract
        first, second = vertices[faces[:, 1]] - corner, vertices[faces[:, 2]] - corner
        area = np.linalg.norm(np.cross(first, second), axis=1) / 2
        area = np.where(np.isfinite(area), area, 0.0)
        total = area.sum()
    if not 0 < total < np.inf:
        return np.zeros((0, 3))
    generator = np.random.default_rng(seed)
    face = generator.choice(len(faces), size=num_samples, p=area / total)
    u, v = np.sqrt(generator.random(num_samples)), generator.random(num_samples)
    # Two edges from a corner rather than three weighted corners: a flat face stays flat to the last bit.
    return corner[face] + (u * (1 - v))[:, None] * first[face] + (u * v)[:, None] * second[face]
