"""Answers for the clouds of a benchmark as labels of all points: the whole pipeline's, a network's own, RANSAC's."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit import pipeline
from jprimfit.evaluation.ransac import Detected, Detector, Settings
from jprimfit.geometry import host
from jprimfit.networks import inference
from jprimfit.networks.weights import Model
from jprimfit.primitives.table import KINDS
from jprimfit.scene import Scene


class Answer(NamedTuple):
    """Segments of n points, p in number."""

    labels: Int[np.ndarray, "n"]  # -1 = none
    surface_of: Int[np.ndarray, "p"]  # segments with one number lie on one surface
    kinds: tuple[str, ...]
    radii: Float[np.ndarray, "p"]  # of cylinders and spheres, NaN for the others


def of_scene(scene: Scene | Detected) -> Answer:
    """What a scene says of its points."""
    primitives = scene.primitives
    radii = np.array([float(getattr(primitive, "radius", np.nan)) for primitive in primitives])
    surface_of = scene.surface_of if isinstance(scene, Scene) else np.arange(len(primitives))
    return Answer(scene.labels, surface_of, tuple(primitive.kind for primitive in primitives), radii)


def whole_pipeline(model: Model | None, points: Float[np.ndarray, "n 3"]) -> Answer:
    """What jprimfit.fit says, with a network or by geometry alone."""
    return of_scene(pipeline.fit(points, model=model))


def efficient_ransac(detect: Detector, settings: Settings, points: Float[np.ndarray, "n 3"], *, refit: bool) -> Answer:
    """What CGAL's RANSAC says."""
    return of_scene(ransac_scene(detect, settings, points, refit=refit))


def ransac_scene(
    detect: Detector, settings: Settings, points: Float[np.ndarray, "n 3"], *, refit: bool
) -> Scene | Detected:
    """The same with its primitives; with refit, those are fitted again to its segments, of its kinds, by ours."""
    found = detect(points, settings)
    if not (refit and found.primitives):
        return found
    kinds = {label: primitive.kind for label, primitive in enumerate(found.primitives)}
    return pipeline.fit(points, labels=found.labels, kind_of=kinds)


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
