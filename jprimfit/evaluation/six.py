"""The six metrics over the parts of a dataset: the clouds, the answers, and the score of each answer.

A cloud is drawn with a seed of its part, noisy as in Table 1 of the paper (uniform, 0.01 along the normal in the
normalised frame) or as asked for, and every method answers for the same clouds. Two kinds of answers: a network's own
(the argmax of its membership, one fit to each segment: as the paper), and a scene of the whole pipeline. Scores are
objectives/metrics', as rows for tables.py. Letters: n points, i instances, b clouds of a batch.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jprimfit import pipeline
from jprimfit.data.clouds import LoaderConfig, draw_example, usable_parts
from jprimfit.data.examples import Example
from jprimfit.data.native import Dataset
from jprimfit.data.noise import sigma_of_percent
from jprimfit.data.records import KINDS, MAX_INSTANCES, Part
from jprimfit.evaluation.ransac import Detected
from jprimfit.evaluation.tables import INSTANCE_METRICS
from jprimfit.geometry import host, safe
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.geometry.preparation import Prepared
from jprimfit.networks import inference
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig
from jprimfit.networks.weights import Model
from jprimfit.objectives import fits, memberships, metrics
from jprimfit.scene import Scene
from jprimfit.types import Prediction, Truth

NUM_SAMPLES = 512  # clean points on each instance, for the residual and the coverage (SPFN)
PART_METRICS = metrics.Metrics._fields[: metrics.Metrics._fields.index("iou_by_kind")]
# Enough of a hierarchy for answers that need none.
NO_HIERARCHY = HierarchySpec((1,), (1,), (0,), (1,), (1.0,), (1.0,), (1.0,))


class Case(NamedTuple):
    """One part of the test: its cloud, with what a network needs, and its truth."""

    name: str
    family: str
    example: Example  # without a batch axis; of its points and its truth, the rest is empty
    shares: Float[np.ndarray, "i"]  # of the part's area, for each of its instances
    seen: "Seen | None" = None  # what a network is given


class Seen(NamedTuple):
    """The points that a network sees, as inference.ask chooses and prepares them."""

    cloud: Prepared  # m points
    nearest: Int[np.ndarray, "n"]  # int32, the one of them that is nearest to each point of the case


def parts_of(dataset: Dataset, split: str, *, every: int = 1, most: int | None = None) -> Int[np.ndarray, "r"]:
    """Numbers of every `every`-th part of a split, at most `most`; ValueError where there is no such split."""
    config = LoaderConfig(split=split, max_instances=min(MAX_INSTANCES, np.iinfo(np.int16).max))
    return usable_parts(dataset, config)[0][::every][:most]


def cases(
    dataset: Dataset,
    numbers: Int[np.ndarray, "r"],
    *,
    network: SegmenterConfig | None,
    num_points: int,
    noise: float | None,
) -> Iterator[Case]:
    """The clouds of the parts of these numbers, prepared for a network if one is given; the same in every run.

    noise: None = Table 1; else sigma of isotropic Gaussian noise in per cent of the diagonal of the part's box.
    """
    counts = np.diff(dataset.starts["instance"])[numbers]
    config = LoaderConfig(
        file=str(dataset.path),
        num_points=num_points,
        num_query=0,
        rotate=False,
        max_instances=max(8, 1 << int(np.max(counts) - 1).bit_length()),
        num_samples=NUM_SAMPLES,
    )
    for number in map(int, numbers):
        part = dataset[number]
        chosen = config if noise is None else _gaussian(config, part, noise)
        example = draw_example(part, config=chosen, spec=NO_HIERARCHY, neighborhoods=(), number=number, workers=-1)
        case = Case(part.name, part.family, example, _shares(part, example))
        yield case if network is None else case._replace(seen=_seen(example, network))


def network_scores(model: Model, found: Iterator[Case], *, batch_size: int) -> Iterator[dict[str, Any]]:
    """The score of the network's own answer for each case, computed in batches.

    The seconds are those of the network, the fits and the scores, without what was prepared, and NaN for the first
    batch, which holds the compilation.
    """
    measured = _network(model)
    first = True
    while batch := list(itertools.islice(found, batch_size)):
        # The last batch is filled up, so that it needs no program of its own.
        filled = [(case.example, case.seen) for case in batch + batch[:1] * (batch_size - len(batch))]
        begin = time.perf_counter()
        values = jax.device_get(measured(*jax.tree.map(lambda *rows: np.stack(rows), *filled)))
        seconds = float("nan") if first else (time.perf_counter() - begin) / batch_size
        first = False
        for row, case in enumerate(batch):
            yield score_row(case, {name: value[row] for name, value in values.items()}, seconds)


def scene_scores(
    found: Iterator[Case], answer: Callable[[Float[np.ndarray, "n 3"]], Scene | Detected]
) -> Iterator[dict[str, Any]]:
    """The score of the scene that `answer` makes of each case's points; its seconds are those of the answer."""
    first = True
    for case in found:
        points = case.example.points[case.example.mask]
        begin = time.perf_counter()
        scene = answer(points)
        seconds = float("nan") if first else time.perf_counter() - begin
        first = False
        yield score_row(case, score_scene(case, scene), seconds)


def pipeline_with(model: Model | None) -> Callable[[Float[np.ndarray, "n 3"]], Scene]:
    """The function from points to the scene of the whole pipeline; None = geometry alone."""
    return lambda points: pipeline.fit(points, model=model)


def score_scene(case: Case, scene: Scene | Detected) -> dict[str, Any]:
    """The values of `measure` for a scene of the case's points."""
    example = case.example
    labels = np.full(len(example.points), -1, np.int32)
    normals = np.zeros((len(example.points), 3), np.float32)
    labels[example.mask], normals[example.mask] = scene.labels, np.nan_to_num(scene.normals)
    segments = metrics.from_primitives(labels, scene.primitives, normals)
    return jax.device_get(_measure(segments, example.points, example.truth))


def measure(segments: metrics.Segments, points: Float[Array, "n 3"], truth: Truth) -> dict[str, Array]:
    """All metrics of one answer, and of every true instance its IoU, whether its kind is right, and its errors.

    Of an instance, axis_deg is NaN unless it is paired with a segment of its kind that has an axis, residual and
    type_right are NaN unless it is paired, normal_deg is NaN where it has no points.
    """
    found = metrics.score(segments, points, truth)
    paired, row = found.matched >= 0, jnp.maximum(found.matched, 0)
    kind = segments.kind[row]
    surfaces = jax.tree.map(lambda x: jnp.asarray(x)[row], segments.surfaces)
    axis = jnp.degrees(safe.line_angle(fits.axes(surfaces, kind), truth.axis))
    directed = found.type_right & (truth.kind != KINDS.index("sphere"))
    distance = jnp.mean(fits.distances(surfaces, kind, truth.samples), axis=1)
    own = memberships.of_truth(truth, dtype=points.dtype)
    turned = jnp.degrees(safe.line_angle(segments.normals, truth.normals))
    turned = jnp.where(jnp.any(segments.normals != 0, axis=1), turned, 90)
    by_instance = {
        "iou": found.iou,
        "type_right": jnp.where(paired, found.type_right.astype(jnp.float32), jnp.nan),
        "normal_deg": jnp.where(found.num_points > 0, safe.divide(turned @ own, jnp.sum(own, axis=0)), jnp.nan),
        "axis_deg": jnp.where(directed, axis, jnp.nan),
        "residual": jnp.where(paired, distance, jnp.nan),
        "num_points": found.num_points,
    }
    return {
        **{name: getattr(found, name) for name in PART_METRICS},
        **{f"instance_{name}": values for name, values in by_instance.items()},
        "instance_kind": truth.kind,
        "segments": jnp.sum(segments.mask),
        "unassigned": jnp.sum((segments.labels < 0) & truth.mask) / jnp.sum(truth.mask),
    }


def score_row(case: Case, values: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """The values of `measure` as a row for tables.py and for JSON."""
    instances = [
        {
            "kind": KINDS[int(values["instance_kind"][i])],
            "share": float(share),
            "points": int(values["instance_num_points"][i]),
            **{name: float(values[f"instance_{name}"][i]) for name in INSTANCE_METRICS},
        }
        for i, share in enumerate(case.shares)
    ]
    return {
        "name": case.name,
        "family": case.family,
        "points": int(np.sum(case.example.mask)),
        "num_instances": len(instances),
        "num_segments": int(values["segments"]),
        "seconds": seconds,
        **{name: float(values[name]) for name in PART_METRICS},
        "unassigned": float(values["unassigned"]),
        "instances": instances,
    }


_measure = jax.jit(measure)


def _network(model: Model) -> Callable[[Example, Seen], dict[str, Array]]:
    """The function from a batch of examples, and what is seen of them, to the values of `measure` with an axis b."""
    segmenter = Segmenter(model.config)

    def predict(variables: Any, seen: Seen) -> tuple[Prediction, Array]:
        said, membership = inference.segment(segmenter, variables, seen.cloud, pooled=model.config.types == "pooled")
        rows = seen.nearest
        return said._replace(normals=said.normals[rows], type_logits=said.type_logits[rows]), membership[rows]

    def judged(one: tuple[Example, Prediction, Array]) -> dict[str, Array]:
        example, said, membership = one
        logits = (said.type_logits, said.normals, example.mask, said.segment_type_logits)
        segments = metrics.segments_of(example.points, membership, *logits)
        return measure(segments, example.points, example.truth)

    @jax.jit
    def measured(variables: Any, examples: Example, seen: Seen) -> dict[str, Array]:
        predictions, found = jax.vmap(predict, in_axes=(None, 0))(variables, seen)
        # One cloud at a time: four kinds fitted to every column of all clouds would fill the memory.
        return jax.lax.map(judged, (examples, predictions, found))

    return lambda examples, seen: measured(model.variables, examples, seen)


def _seen(example: Example, network: SegmenterConfig) -> Seen:
    points = example.points[example.mask]
    rows, cloud = inference.sample(network, points)
    return Seen(cloud, host.knn(example.points, points[rows], k=1).index[:, 0])


def _gaussian(config: LoaderConfig, part: Part, percent: float) -> LoaderConfig:
    surface = part.mesh.vertices if part.mesh is not None else part.cloud.points if part.cloud is not None else None
    if surface is None:
        return config  # draw_example says that such parts cannot be drawn
    sigma = sigma_of_percent(surface, percent) / (float(np.ptp(surface, axis=0).max()) / 2)
    return replace(config, gaussian_noise=(sigma, sigma), gaussian_share=1.0)


def _shares(part: Part, example: Example) -> np.ndarray:
    """Share of the area of each instance; of the points where areas are not known."""
    if part.areas is not None:
        return part.areas / (np.sum(part.areas) + part.background_area)
    labels = example.truth.labels
    counts = np.bincount(labels[labels >= 0], minlength=len(part.primitives))
    return counts / np.sum(example.mask)
