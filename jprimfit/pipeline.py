"""The paper's Figure 1 in one function: preprocess -> features -> segment -> fit -> refine.

The network proposes, geometry decides: the hearts of the network's segments are the patches from which surfaces are
grown first, and what they leave is grown from seeds of its own. Without a network all of it is. Between the first and
the last line everything is in the normalised frame, along axes of the scan's own; the scene is in the unit and frame of
the input.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jprimfit import checks
from jprimfit.fitting import geometric, growing, local, refinement
from jprimfit.fitting.advice import Advice, advice
from jprimfit.fitting.assignment import MIN_FACE
from jprimfit.fitting.given import fit_segments
from jprimfit.fitting.kinds import move
from jprimfit.geometry.host import Frame, normalize
from jprimfit.networks import inference, weights
from jprimfit.networks.weights import Model
from jprimfit.preprocessing.outliers import Mode
from jprimfit.preprocessing.steps import nearest_rows, preprocess
from jprimfit.primitives.table import KINDS
from jprimfit.scene import Scene

# A cloud beyond this is thinned for the segmentation; labels and parameters always come from all its points.
MAX_POINTS = 40_000
NUM_POINTS = 32_768


def fit(
    points: Any,
    normals: Any = None,
    *,
    model: str | PathLike[str] | Model | None = "default",
    seed: int = 0,
    labels: Any = None,
    kinds: Sequence[str] = KINDS,
    kind_of: Mapping[int, str] | None = None,
    tolerance: float | None = None,
    min_points: int = MIN_FACE,
    filter: Mode = "auto",
    smooth: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Scene:
    """The planes, spheres, cylinders and cones of a scan, and which of them each point lies on.

    Args:
        points: (n, 3), any unit and position. Rows that are not finite are reported and labelled -1.
        normals: (n, 3), of any length and sign, where the scanner gives them; else they are estimated.
        model: "default", the best that is shipped, another name or folder, or what load_model gave; None = no network.
        seed: of every random choice; at present none is made.
        labels: (n,) integers: segments that are known, below 0 = none. Points keep them, in their order, and only the
            primitive of each is sought; model, min_points, filter and smooth then mean nothing.
        kinds: that are looked for.
        kind_of: kinds of some of the labels, which are then not chosen.
        tolerance: how far the scan may lie from its surfaces, in its unit; three standard deviations of the noise,
            which is estimated where nothing is given.
        min_points: of a face; points of smaller ones go to what lies around them, or to none.
        filter: removes outliers: "auto" where the scan has some, "on", "off". They are labelled -1.
        smooth: smooths what the segmentation sees; parameters come from the raw points all the same.
        progress: called with (stage, steps done, steps in all).

    Returns:
        The scene in the unit and frame of the input.

    Raises:
        ValueError: one sentence, where the points can be no scan, or the model is none.

    Source: Entropy 2024, 26(9), 717, Figure 1.
    """
    begin = time.perf_counter()
    if not isinstance(smooth, bool):
        raise ValueError(f"smooth is {smooth!r}, but True or False is expected: give one of them.")
    wanted = Wanted(
        checks.chosen_kinds(kinds, KINDS),
        checks.positive(tolerance, "tolerance"),
        checks.count(min_points, "min_points"),
    )
    say = progress or _silent
    usable = checks.usable_rows(points, normals)
    num_points = len(np.asarray(points))

    # Copies of a point, and the zeros some cameras write for no return, say nothing of a surface.
    first, copy_of = _distinct(usable.points)
    distinct, given = usable.points[first], None if usable.normals is None else usable.normals[first]

    if labels is None:
        if kind_of is not None:
            raise ValueError("kind_of is given without labels: give the segments whose kinds it tells, too.")
        network = model if model is None or isinstance(model, Model) else _load(model)
        answer = _segmented(distinct, given, network, wanted, filter, smooth, say)
    else:
        network = None
        segments = checks.usable_labels(labels, num_points)
        told = checks.told_kinds(kind_of, segments, KINDS)
        answer = _refitted(distinct, segments[usable.rows][first], given, told, wanted, say)
    found, frame = answer.found, answer.frame

    def to_input(values: np.ndarray, fill: int | float) -> np.ndarray:
        return _spread(_spread(values, answer.rows, len(distinct), fill)[copy_of], usable.rows, num_points, fill)

    return Scene(
        points=np.array(points, np.float64),
        labels=to_input(found.labels, -1),
        primitives=tuple(move(one, frame.center, frame.scale, frame.axes.T) for one in found.primitives),
        surface_of=found.surface_of,
        normals=to_input(frame.vectors_to_input(found.normals), np.nan),
        distances=to_input(found.distances * frame.scale, np.nan),
        noise=found.noise * frame.scale,
        report={
            "num_points": num_points,
            "num_unusable": num_points - len(usable.points),
            "num_copies": len(usable.points) - len(distinct),
            "preprocessing": answer.report,
            "network": None if network is None else network.name,
            "settings": {
                "kinds": list(wanted.kinds),
                "tolerance": wanted.tolerance,
                "min_points": wanted.min_points,
                "filter": filter,
                "smooth": smooth,
                "seed": seed,
                "labels": labels is not None,
            },
            "seconds": round(time.perf_counter() - begin, 3),
        },
    )


class Wanted(NamedTuple):
    """What the user narrows the answer to."""

    kinds: tuple[str, ...]
    tolerance: float | None  # unit of the input
    min_points: int

    def noise(self, frame: Frame) -> float | None:
        """The standard deviation that the tolerance stands for, in the normalised frame."""
        return None if self.tolerance is None else self.tolerance / 3.0 / frame.scale


class _Answer(NamedTuple):
    """What was found, in the normalised frame, for some rows of the distinct points."""

    found: refinement.Segmentation
    rows: np.ndarray
    frame: Frame
    report: dict[str, Any]


def _segmented(
    distinct: np.ndarray,
    given: np.ndarray | None,
    network: Model | None,
    wanted: Wanted,
    filter: Mode,
    smooth: bool,
    say: Callable[[str, int, int], None],
) -> _Answer:
    """Figure 1: the segments are sought, then refined at full resolution."""
    say("preprocess", 0, 1)
    ready = preprocess(distinct, filter=filter, smooth=smooth, max_points=MAX_POINTS, num_points=NUM_POINTS)
    kept = np.setdiff1d(np.arange(len(distinct)), ready.removed)
    cloud = ready.frame.from_input(distinct[kept])
    thinned = ready.points.astype(np.float64)
    turned = None if given is None else ready.frame.vectors_from_input(given)
    of_thinned = None if turned is None else turned[ready.index]
    known = wanted.noise(ready.frame)

    advised = None if network is None else _advised(network, thinned, say)

    say("segment", 0, len(thinned))
    proposal = geometric.propose(
        thinned,
        of_thinned,
        advice=advised,
        sought=wanted.kinds,
        noise=known,
        progress=lambda done, total: say("segment", done, total),
    )

    say("refine", 0, 1)
    measured = None if turned is None else turned[kept]
    if smooth:  # the raw points are no longer as they were described
        labels = proposal.labels[nearest_rows(thinned, cloud)]
        found = refinement.refine(cloud, proposal.surfaces, labels, measured, noise=known, min_points=wanted.min_points)
    else:
        found = _refined(cloud, proposal, thinned, measured, ready.neighbors, wanted.min_points)
    return _Answer(found, kept, ready.frame, ready.report)


def _refined(
    cloud: np.ndarray,
    proposal: geometric.Proposal,
    thinned: np.ndarray,
    measured: np.ndarray | None,
    neighbors: np.ndarray | None,
    min_points: int,
) -> refinement.Segmentation:
    """The proposal on all points, of which a noisy sample need not be described again."""
    surfaces, labels, described = proposal
    if len(thinned) == len(cloud):
        return refinement.refine(cloud, surfaces, labels, described=described, min_points=min_points)
    nearest = nearest_rows(thinned, cloud)
    if growing.is_quiet(described):
        described = local.describe(cloud, normals=measured, noise=described.noise, narrow=True)
    else:
        described = local.of_all(described, nearest, cloud, normals=measured, index=neighbors)
    return refinement.refine(cloud, surfaces, labels[nearest], described=described, min_points=min_points)


def _refitted(
    distinct: np.ndarray,
    labels: np.ndarray,
    given: np.ndarray | None,
    kind_of: Mapping[int, str],
    wanted: Wanted,
    say: Callable[[str, int, int], None],
) -> _Answer:
    """The segments are known."""
    say("refit", 0, 1)
    _, frame = normalize(distinct, turned=True)
    turned = None if given is None else frame.vectors_from_input(given)
    found = fit_segments(
        frame.from_input(distinct), labels, turned, sought=wanted.kinds, kind_of=kind_of, noise=wanted.noise(frame)
    )
    return _Answer(found, np.arange(len(distinct)), frame, {})


def _advised(network: Model, points: np.ndarray, say: Callable[[str, int, int], None]) -> Advice:
    say("network", 0, 1)
    return advice(points, *inference.ask(network, points))


def _load(name: str | PathLike[str]) -> Model:
    """A model by name or folder; one that is shipped is read once, since only the others change."""
    return _shipped(name) if isinstance(name, str) and name in weights.SHIPPED else weights.load(name)


_shipped = lru_cache(weights.load)


def _distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the first of each distinct point, ascending, and for every row which of those it equals."""
    if len(np.unique(points[:, 0])) == len(points):
        return np.arange(len(points)), np.arange(len(points))
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[inverse.ravel()]


def _spread(values: np.ndarray, rows: np.ndarray, num_rows: int, fill: int | float) -> np.ndarray:
    """Values at the given rows of an array of num_rows, fill elsewhere."""
    spread = np.full((num_rows, *values.shape[1:]), fill, dtype=values.dtype)
    spread[rows] = values
    return spread


def _silent(stage: str, done: int, total: int) -> None:
    """Takes the place of a progress callback where none was given."""
