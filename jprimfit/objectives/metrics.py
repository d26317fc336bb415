"""The six metrics of one cloud: SPFN's (Li et al. 2019), with its null rule and its Hungarian matching on hard labels.

Where references differ this holds: parameters refitted with the hard membership (CPFN, Lê et al. 2021), the predicted
type in the residual, distances not squared, axes over type-matched instances that are no spheres. Lengths in the
normalised frame, angles in degrees, shares in [0, 1]. Everything here speaks of one part; means are the caller's.
n points, i true instances, p predicted segments, m samples of each true instance.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.objectives import fits, matching, memberships
from jprimfit.primitives.table import KINDS, TYPE_ID
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere, Truth

NULL_SHARE = 0.005  # of the points: a column with less weight is no segment (SPFN)
EPSILON = 0.01  # distance at which a point counts as covered; the second one is twice that
MIN_CAPACITY = 8


class Segments(NamedTuple):
    """An answer: a label for every point, and a primitive for every label. Its arrays are JAX's or NumPy's."""

    labels: Int[Any, "n"]  # int32, row of kind and surfaces; -1 = none
    mask: Bool[Any, "p"]  # False = padding, or a segment without points
    kind: Int[Any, "p"]  # int32, position in primitives/table.KINDS
    surfaces: fits.Surfaces  # p of each kind: that of the segment's kind is the answer, the others are not looked at
    normals: Float[Any, "n 3"]  # unit, of either sign; zero where unknown


class Metrics(NamedTuple):
    """The metrics of one part. NaN where there is nothing to take a mean of.

    A true instance is *paired* if it is matched to a segment that has points, whatever their overlap (SPFN).
    """

    miou: Float[Array, ""]  # mean IoU over all true instances; one that is not paired counts 0
    type_accuracy: Float[Array, ""]  # share of the paired instances whose kind is right
    normal_deg: Float[Array, ""]  # mean over all points of the angle to the true normal; 90 where the answer has none
    axis_deg: Float[Array, ""]  # mean angle to the true axis, paired instances of the right kind, no spheres
    axis_deg_spfn: Float[Array, ""]  # the same with spheres, each of which counts 0
    residual: Float[Array, ""]  # mean over paired instances of the mean distance of their samples to the primitive
    p_coverage: Float[Array, ""]  # share of the points nearer than EPSILON to any predicted primitive, background too
    p_coverage_02: Float[Array, ""]  # the same at 2 EPSILON
    s_coverage: Float[Array, ""]  # mean over true instances of the share of samples nearer than EPSILON to the match
    s_coverage_02: Float[Array, ""]  # the same at 2 EPSILON; an instance that is not paired counts 0 in both
    iou_by_kind: Float[Array, "4"]  # SUM of the IoU over the true instances of each kind
    count_by_kind: Int[Array, "4"]  # int32, number of true instances of each kind
    iou: Float[Array, "i"]  # of every true instance, 0 in padding
    num_points: Int[Array, "i"]  # int32, points of every true instance
    matched: Int[Array, "i"]  # int32, segment of every true instance, -1 = not paired
    type_right: Bool[Array, "i"]  # paired, and of the right kind


def segments_of(
    points: Float[Array, "n 3"],
    membership: Float[Array, "n s"],
    type_logits: Float[Array, "n 4"],
    normals: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    segment_type_logits: Float[Array, "s 4"] | None = None,
) -> Segments:
    """Hard segments of a soft membership, their kinds, and one primitive fitted to each with the given normals.

    A point goes to the column of its largest weight; if that column is null (its weights sum to less than NULL_SHARE
    of the points), or the row is zero, to none. The kind of a segment is the majority of its points' likeliest kinds,
    or the likeliest of segment_type_logits where the network judges whole segments (row = column of the membership).
    """
    membership = jnp.where(mask[:, None], membership, 0)
    null = jnp.sum(membership, axis=0) < NULL_SHARE * jnp.sum(mask)
    labels = jnp.argmax(membership, axis=1)
    labels = jnp.where(null[labels] | (jnp.max(membership, axis=1) <= 0), -1, labels).astype(jnp.int32)
    members = memberships.of_labels(labels, num_columns=membership.shape[1], dtype=points.dtype)
    if segment_type_logits is None:
        ballots = memberships.of_labels(jnp.argmax(type_logits, axis=1), num_columns=len(KINDS), dtype=points.dtype)
        segment_type_logits = jnp.matmul(members.T, ballots, precision=matching.HIGHEST)
    kind = jnp.argmax(segment_type_logits, axis=1).astype(jnp.int32)
    surfaces, _ = fits.fit_columns(points, members, normals)
    return Segments(labels, jnp.sum(members, axis=0) > 0, kind, surfaces, normals)


def from_primitives(
    labels: Int[np.ndarray, " n"],
    primitives: list[Primitive] | tuple[Primitive, ...],
    normals: Float[np.ndarray, "n 3"],
    *,
    capacity: int | None = None,
) -> Segments:
    """Segments, of NumPy arrays, of an answer that has its primitives already, such as a Scene; they stay as they are.

    Primitive k belongs to label k, in the frame of the points. Padded to capacity rows, by default to a power of two.
    """
    labels = np.asarray(labels, np.int32)
    count = len(primitives)
    if labels.size and not (-1 <= labels.min() and labels.max() < count):
        raise ValueError(
            f"labels from {labels.min()} to {labels.max()} for {count} primitives: -1 to {count - 1} allowed"
        )
    if capacity is None:
        capacity = max(MIN_CAPACITY, 1 << max(count - 1, 0).bit_length())
    if count > capacity:
        raise ValueError(f"{count} primitives do not fit a capacity of {capacity}: give a larger one or none")
    kind = np.zeros(capacity, np.int32)
    kind[:count] = [TYPE_ID[primitive.kind] for primitive in primitives]
    has_points = np.bincount(labels[labels >= 0], minlength=capacity) > 0
    up, zero = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    fillers = fits.Surfaces(Plane(up, zero[0]), Sphere(zero, up[2]), Cylinder(up, zero, up[2]), Cone(up, zero, up[2]))
    rows = [list(primitives) + [filler] * (capacity - count) for filler in fillers]
    stacks = []
    for filler, row in zip(fillers, rows, strict=True):
        own = [primitive if primitive.kind == filler.kind else filler for primitive in row]
        stacks.append(type(filler)(*[np.stack(values).astype(np.float32) for values in zip(*own, strict=True)]))
    return Segments(labels, has_points, kind, fits.Surfaces(*stacks), np.asarray(normals, np.float32))


def score(segments: Segments, points: Float[Array, "n 3"], truth: Truth) -> Metrics:
    """All metrics of one part; points are the noisy ones that the network saw, segments and truth lie in their frame.

    Segments that are not matched cost nothing by themselves; all of them may cover points.
    """
    labels = jnp.where(truth.mask, segments.labels, -1)
    own = memberships.of_truth(truth, dtype=points.dtype)
    members = memberships.of_labels(labels, num_columns=segments.mask.shape[0], dtype=points.dtype)
    segment_mask = segments.mask & (jnp.sum(members, axis=0) > 0)
    ious = matching.relaxed_iou(own, members)
    matched = matching.match(ious, truth.instance_mask, segment_mask)
    paired, row = matched >= 0, jnp.maximum(matched, 0)
    iou = jnp.where(paired, jnp.take_along_axis(ious, row[:, None], axis=1)[:, 0], 0)
    kind = segments.kind[row]
    surfaces = jax.tree.map(lambda x: jnp.asarray(x)[row], segments.surfaces)
    type_right = paired & (kind == truth.kind)
    axis_angle = safe.line_angle(fits.axes(surfaces, kind), truth.axis)
    axis_angle = jnp.degrees(jnp.where(truth.kind == TYPE_ID["sphere"], 0, axis_angle))
    sample_distance = fits.distances(surfaces, kind, truth.samples)
    nearest = _nearest(segments, segment_mask, points)
    of_kind = memberships.of_labels(truth.kind, num_columns=len(KINDS)) * truth.instance_mask[:, None]
    return Metrics(
        miou=_mean(iou, truth.instance_mask),
        type_accuracy=_mean(type_right, paired),
        normal_deg=_mean(_normal_angle(segments.normals, truth.normals), truth.mask),
        axis_deg=_mean(axis_angle, type_right & (truth.kind != TYPE_ID["sphere"])),
        axis_deg_spfn=_mean(axis_angle, type_right),
        residual=_mean(jnp.mean(sample_distance, axis=1), paired),
        p_coverage=_mean(nearest < EPSILON, truth.mask),
        p_coverage_02=_mean(nearest < 2 * EPSILON, truth.mask),
        s_coverage=_covered(sample_distance, paired, truth, EPSILON),
        s_coverage_02=_covered(sample_distance, paired, truth, 2 * EPSILON),
        iou_by_kind=jnp.sum(of_kind * iou[:, None], axis=0),
        count_by_kind=jnp.sum(of_kind, axis=0).astype(jnp.int32),
        iou=iou,
        num_points=jnp.sum(own, axis=0).astype(jnp.int32),
        matched=matched,
        type_right=type_right,
    )


def _nearest(segments: Segments, segment_mask: Bool[Array, " p"], points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from every point to the nearest primitive of the mask, inf if there is none.

    One primitive after another: p times n distances at once are too many for scenes of hundreds of primitives.
    """

    def step(nearest, one):
        surface, kind, is_used = jax.tree.map(lambda x: x[None], one)
        distance = fits.distances(surface, kind, points[None])[0]
        return jnp.minimum(nearest, jnp.where(is_used, distance, jnp.inf)), None

    rows = jax.tree.map(jnp.asarray, (segments.surfaces, segments.kind, segment_mask))
    return jax.lax.scan(step, jnp.full(points.shape[0], jnp.inf, points.dtype), rows)[0]


def _normal_angle(normals: Float[Array, "n 3"], true_normals: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Angle between two lines in degrees, 90 where the first is the zero vector."""
    angle = jnp.degrees(safe.line_angle(normals, true_normals))
    return jnp.where(jnp.any(normals != 0, axis=1), angle, 90)


def _covered(distance: Float[Array, "i m"], paired, truth, epsilon) -> Float[Array, ""]:
    share = jnp.mean((distance < epsilon).astype(distance.dtype), axis=1)
    return _mean(share * paired, truth.instance_mask)


def _mean(values: Array, mask: Bool[Array, " r"]) -> Float[Array, ""]:
    """Mean over the rows of the mask, NaN if there are none."""
    count = jnp.sum(mask)
    total = jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(count, 1)
    return jnp.where(count > 0, total, jnp.nan)
