"""The metrics against loops over their definitions, and in cases whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jprimfit.objectives import metrics
from jprimfit.objectives.metrics import from_primitives, score, segments_of
from jprimfit.primitives.table import KINDS, MODULES

SEGMENTS, SCORE = jax.jit(segments_of), jax.jit(score)


def hard(part, labels, num_columns=8):
    """Membership of given labels, zero rows for -1."""
    return np.concatenate([np.eye(num_columns), np.zeros((1, num_columns))])[labels].astype(np.float32)


def perfect(part):
    types, mask = part.slots.type_logits, part.truth.mask
    return SEGMENTS(part.points, hard(part, part.truth.labels), types, part.slots.normals, mask)


def surface_distance(segments, row, points):
    kind = int(segments.kind[row])
    primitive = jax.tree.map(lambda x: jnp.asarray(x)[row], segments.surfaces[kind])
    return np.asarray(MODULES[KINDS[kind]].distance(primitive, jnp.asarray(points)))


def degrees(a, b):
    return np.degrees(np.arccos(min(1.0, abs(float(np.dot(a, b))))))


def loops(segments, points, truth):
    """The metrics by their definitions."""
    labels, instances = np.where(truth.mask, segments.labels, -1), np.flatnonzero(truth.instance_mask)
    used = [j for j in range(len(segments.mask)) if segments.mask[j] and (labels == j).any()]
    iou = np.zeros((len(instances), len(used)))
    for row, k in enumerate(instances):
        own = truth.mask & (truth.labels == k)
        for column, j in enumerate(used):
            iou[row, column] = np.sum(own & (labels == j)) / max(np.sum(own | (labels == j)), 1)
    pairs = {instances[r]: (used[c], iou[r, c]) for r, c in zip(*linear_sum_assignment(-iou), strict=True)}
    right = {k: segments.kind[j] == truth.kind[k] for k, (j, _) in pairs.items()}
    axis = []
    for k in (k for k in pairs if right[k]):
        fitted = segments.surfaces[truth.kind[k]][0][pairs[k][0]]
        axis.append(0.0 if truth.kind[k] == 1 else degrees(fitted, truth.axis[k]))
    no_sphere = [a for a, k in zip(axis, [k for k in pairs if right[k]], strict=True) if truth.kind[k] != 1]
    samples = {k: surface_distance(segments, j, truth.samples[k]) for k, (j, _) in pairs.items()}
    nearest = np.min([surface_distance(segments, j, points) for j in used], axis=0)[truth.mask]
    return {
        "miou": sum(value for _, value in pairs.values()) / len(instances),
        "type_accuracy": np.mean(list(right.values())),
        "normal_deg": np.mean([degrees(segments.normals[n], truth.normals[n]) for n in np.flatnonzero(truth.mask)]),
        "axis_deg": np.mean(no_sphere) if no_sphere else np.nan,
        "axis_deg_spfn": np.mean(axis),
        "residual": np.mean([distance.mean() for distance in samples.values()]),
        "p_coverage": np.mean(nearest < 0.01),
        "p_coverage_02": np.mean(nearest < 0.02),
        "s_coverage": sum(np.mean(distance < 0.01) for distance in samples.values()) / len(instances),
        "s_coverage_02": sum(np.mean(distance < 0.02) for distance in samples.values()) / len(instances),
    }


def check(found, expected, tolerance):
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(found, name), value, atol=tolerance, err_msg=name)


def test_a_perfect_answer_scores_one_and_zero(part):
    scene = from_primitives(part.truth.labels, part.primitives, part.truth.normals)
    for segments in (perfect(part), scene):
        found = SCORE(segments, part.points, part.truth)
        ones = dict.fromkeys(("miou", "type_accuracy", "s_coverage", "s_coverage_02"), 1)
        zeros = dict.fromkeys(("normal_deg", "axis_deg", "axis_deg_spfn", "residual"), 0)
        background = {"p_coverage": 196 / 200, "p_coverage_02": 196 / 200}
        check(found, ones | background, 1e-6)
        check(found, zeros, 2e-2)
        assert found.residual < 1e-4
        np.testing.assert_array_equal(found.num_points, [49, 49, 49, 49, 0, 0])
        np.testing.assert_array_equal(found.matched, [0, 1, 2, 3, -1, -1])
        np.testing.assert_array_equal(found.count_by_kind, [1, 1, 1, 1])
        np.testing.assert_allclose(found.iou_by_kind, 1)


@pytest.mark.parametrize("seed", range(4))
def test_every_metric_is_its_definition(make_part, seed):
    generator = np.random.default_rng(seed)
    part = make_part.build(seed, kinds=[[0, 1, 2, 3], [2, 3, 2], [0, 0, 3, 1], [1, 1]][seed])
    noisy = make_part.noise(part, generator)["slots"]
    labels = np.where(generator.random(208) < 0.7, part.truth.labels, generator.integers(-1, 8, 208))
    labels = np.where(labels == 1, 5, labels)  # the numbers of segments say nothing
    types = noisy.type_logits + 0.05 * part.slots.type_logits
    normals = part.truth.normals + np.float32(0.3) * noisy.normals
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = part.points + (0.005 * generator.normal(size=part.points.shape)).astype(np.float32)
    membership = hard(part, labels)
    segments = jax.tree.map(np.asarray, SEGMENTS(points, membership, types, normals, part.truth.mask))
    found = SCORE(segments, points, part.truth)
    check(found, loops(segments, points, part.truth), 2e-3)
    members = part.truth.mask & (part.truth.labels[None, :] == np.arange(6)[:, None])
    np.testing.assert_array_equal(found.num_points, members.sum(axis=1))
    for kind in range(4):
        chosen = part.truth.instance_mask & (part.truth.kind == kind)
        np.testing.assert_allclose(found.iou_by_kind[kind], np.asarray(found.iou)[chosen].sum(), atol=1e-6)
        assert found.count_by_kind[kind] == chosen.sum()


def test_a_case_by_hand(part):
    # The sphere's points are given to the square's segment, half the cylinder's to a segment of their own.
    labels = part.truth.labels.copy()
    labels[labels == 1] = 0
    cylinder = np.flatnonzero(labels == 2)
    labels[cylinder[:20]] = 7
    labels[part.truth.labels == -1] = 3  # background counts in the cone's segment; padding does not
    mask = part.truth.mask
    types = part.slots.type_logits.copy()
    types[labels == 3] = [9, 0, 0, 0]  # the cone is taken for a plane
    normals = np.zeros_like(part.truth.normals)
    segments = SEGMENTS(part.points, hard(part, labels), types, normals, mask)
    found = SCORE(segments, part.points, part.truth)
    # The square or the sphere, 49 of 98 each, gets the segment they share, the other one the unrelated segment 7.
    np.testing.assert_allclose(found.miou, (0.5 + 0 + 29 / 49 + 49 / 53) / 4, atol=1e-6)
    assert sorted(np.asarray(found.matched)[:2]) == [0, 7]
    np.testing.assert_array_equal(np.asarray(found.matched)[2:4], [2, 3])
    np.testing.assert_array_equal(np.asarray(found.type_right)[2:], [True, False, False, False])
    np.testing.assert_allclose(found.normal_deg, 90)


def test_a_weak_column_is_no_segment_and_its_points_go_to_none(part):
    # Half a per cent of 200 points is 1: a column of one full point is a segment, of one point at 0.9 it is not.
    membership = hard(part, np.where(part.truth.labels < 0, 7, part.truth.labels))
    membership[0], membership[60] = np.eye(8)[5], 0.9 * np.eye(8)[6] + 0.1 * np.eye(8)[1]
    types = part.slots.type_logits
    segments = SEGMENTS(part.points, membership, types, part.truth.normals, part.truth.mask)
    assert segments.labels[0] == 5
    assert segments.labels[60] == -1
    np.testing.assert_array_equal(np.asarray(segments.mask), [1, 1, 1, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(np.asarray(segments.labels)[~part.truth.mask], -1)


def test_kinds_are_voted_by_points_or_given_for_whole_segments(part):
    types = np.zeros((208, 4), np.float32)
    types[:, 2] = 1
    types[:20, 3] = 100  # twenty loud points of 49 are no majority
    arguments = part.points, hard(part, part.truth.labels), types, part.truth.normals, part.truth.mask
    np.testing.assert_array_equal(np.asarray(SEGMENTS(*arguments).kind)[:4], 2)
    pooled = np.eye(4, dtype=np.float32)[[3, 1, 0, 2, 0, 0, 0, 0]]
    np.testing.assert_array_equal(SEGMENTS(*arguments, pooled).kind, pooled.argmax(axis=1))


def test_order_of_segments_and_points_and_padding_do_not_matter(part, make_part):
    generator = np.random.default_rng(5)
    labels = np.where(generator.random(208) < 0.8, part.truth.labels, generator.integers(-1, 8, 208))
    membership, mask = hard(part, labels), part.truth.mask
    normals = make_part.noise(part, generator)["slots"].normals
    once = SEGMENTS(part.points, membership, part.slots.type_logits, normals, mask)
    found = SCORE(once, part.points, part.truth)
    order, columns = generator.permutation(208), generator.permutation(8)
    rows = {name: getattr(part.truth, name)[order] for name in ("mask", "normals", "labels")}
    rows["normals"] = np.where(mask[order][:, None], rows["normals"], np.float32(np.nan))
    points = np.where(mask[:, None], part.points, np.float32(5))[order]
    moved = membership[order][:, columns], part.slots.type_logits[order], normals[order], mask[order]
    again = SCORE(SEGMENTS(points, *moved), points, part.truth._replace(**rows))
    for name in ("miou", "type_accuracy", "normal_deg", "axis_deg", "residual", "p_coverage", "s_coverage"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), atol=1e-3, err_msg=name)


def test_nothing_to_average_is_nan_and_nothing_found_is_zero(part):
    found = SCORE(perfect(part), part.points, part.truth._replace(instance_mask=np.zeros(6, bool)))
    for name in ("miou", "type_accuracy", "axis_deg", "axis_deg_spfn", "residual", "s_coverage"):
        assert np.isnan(getattr(found, name)), name
    nobody = hard(part, np.full(208, -1))
    empty = SEGMENTS(part.points, nobody, part.slots.type_logits, part.truth.normals, part.truth.mask)
    found = SCORE(empty, part.points, part.truth)
    assert found.miou == found.p_coverage == found.s_coverage == 0
    assert np.isnan(found.type_accuracy)
    assert np.isnan(found.residual)
    assert not np.asarray(empty.mask).any()


def test_instances_beyond_the_segments_count_as_missed(part):
    labels = np.where(part.truth.labels >= 2, 0, part.truth.labels)
    scene = from_primitives(labels, part.primitives[:2], part.truth.normals, capacity=2)
    found = SCORE(scene, part.points, part.truth)
    assert sorted(np.asarray(found.matched)[:4]) == [-1, -1, 0, 1]
    np.testing.assert_allclose(found.miou, (1 / 3 + 1) / 4, atol=1e-6)


def test_ready_primitives_stay_as_they_are_and_wrong_ones_are_refused(part):
    scene = from_primitives(part.truth.labels, part.primitives, part.truth.normals)
    assert scene.mask.shape == (metrics.MIN_CAPACITY,)
    np.testing.assert_array_equal(scene.surfaces.cone.apex[3], np.float32(part.primitives[3].apex))
    np.testing.assert_array_equal(scene.kind[:4], [0, 1, 2, 3])
    many = from_primitives(part.truth.labels, part.primitives * 5, part.truth.normals)
    assert many.mask.shape == (32,)
    assert many.mask.sum() == 4
    with pytest.raises(ValueError, match="for 2 primitives"):
        from_primitives(part.truth.labels, part.primitives[:2], part.truth.normals)
    with pytest.raises(ValueError, match="capacity of 3"):
        from_primitives(part.truth.labels, part.primitives, part.truth.normals, capacity=3)
    nothing = from_primitives(np.full(208, -1), (), part.truth.normals)
    assert SCORE(nothing, part.points, part.truth).miou == 0
