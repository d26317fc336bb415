"""Answers for the clouds of a benchmark as labels of all points: of the whole pipeline, and of a network alone."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit import pipeline
from jprimfit.geometry import host
from jprimfit.networks import inference
from jprimfit.networks.weights import Model
from jprimfit.primitives.table import KINDS


class Answer(NamedTuple):
    """Segments of n points, p in number."""

    labels: Int[np.ndarray, "n"]  # -1 = none
    surface_of: Int[np.ndarray, "p"]  # segments with one number lie on one surface
    kinds: tuple[str, ...]
    radii: Float[np.ndarray, "p"]  # of cylinders and spheres, NaN for the others


def whole_pipeline(model: Model | None, points: Float[np.ndarray, "n 3"]) -> Answer:
    """What jprimfit.fit says, with a network or by geometry alone."""
    scene = pipeline.fit(points, model=model)
    radii = [float(getattr(primitive, "radius", np.nan)) for primitive in scene.primitives]
    return Answer(scene.labels, scene.surface_of, tuple(p.kind for p in scene.primitives), np.array(radii))


def network_alone(model: Model, points: Float[np.ndarray, "n 3"]) -> Answer:
    """The segments of the network: the likeliest for each point it saw, for all others that of the nearest of those.

    Their kinds are its most probable ones over their points; nothing is fitted.
    """
    said = inference.ask(model, points)
    used, segment = np.unique(np.argmax(said.membership, axis=1), return_inverse=True)
    votes = np.zeros((len(used), len(KINDS)))
    np.add.at(votes, segment, said.type_probability)
    nearest = host.knn(points, points[said.rows], k=1).index[:, 0]
    kinds = tuple(KINDS[best] for best in np.argmax(votes, axis=1))
    return Answer(segment[nearest], np.arange(len(used)), kinds, np.full(len(used), np.nan))
