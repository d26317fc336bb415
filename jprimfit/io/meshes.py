"""A mesh becomes a cloud: points drawn uniformly by area, by a fixed seed, so that a file always gives the same points.

A mesh says where the surface is, its vertices often only where the corners are (a CAD export puts none on a flat face),
so vertices serve as points only where there are no faces. Normals of facets are not passed on: on a triangulated
scan they are noisier than those estimated from neighbours. Source: Osada et al. 2002, Shape Distributions, eq. 1.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jprimfit.io.files import BadFile, Cloud, Mesh

NUM_SAMPLES = 65_536
SEED = 0


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
    return Cloud(points, None)


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
