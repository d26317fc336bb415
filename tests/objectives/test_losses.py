"""Every term against loops over its definition, on perfect, arbitrary and degenerate predictions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.objectives import losses as objective
from jprimfit.objectives.losses import LossConfig, losses
from jprimfit.primitives.table import KINDS, MODULES

ALL = LossConfig(orthogonality=0.1)
HEADS = ("slots", "prototype")


@functools.partial(jax.jit, static_argnums=3)
def evaluate(prediction, truth, points, config):
    """All terms, and the gradient of the total with respect to the prediction."""

    def total(p):
        terms = losses(p, truth, points, config)
        return terms["total"], terms

    gradient, terms = jax.grad(total, has_aux=True)(prediction)
    return terms, gradient


def softmax(logits):
    weight = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return weight / weight.sum(axis=-1, keepdims=True)


def matched_columns(prediction, truth):
    """The soft column of every true instance, by loops: matched slots, or the prototypes' softmax."""
    from scipy.optimize import linear_sum_assignment

    members = [truth.mask & (truth.labels == k) for k in np.flatnonzero(truth.instance_mask)]
    if prediction.embedding is not None:
        centers = np.array([prediction.embedding[m].mean(axis=0) for m in members])
        soft = softmax(-2 * np.sum((prediction.embedding[:, None] - centers[None]) ** 2, axis=2))
        return soft * np.any(members, axis=0)[:, None]
    soft = softmax(prediction.membership_logits) * truth.mask[:, None]
    iou = np.array([[iou_of(m, soft[:, j]) for j in range(soft.shape[1])] for m in members])
    return soft[:, linear_sum_assignment(-iou)[1]]


def iou_of(own, column):
    shared = np.sum(own * column)
    return shared / (np.sum(own) + np.sum(column) - shared)


def loops(prediction, truth, points):
    """The terms by their definitions."""
    columns = matched_columns(prediction, truth)
    instances = range(columns.shape[1])
    cosines = np.abs(np.sum(prediction.normals * truth.normals, axis=1))
    types = softmax(prediction.type_logits)
    rows = [n for n in range(len(points)) if truth.mask[n] and truth.labels[n] >= 0]
    parameter, residue = [], []
    for k in instances:
        module = MODULES[KINDS[truth.kind[k]]]
        primitive, ok = module.fit(*[jnp.float32(x) for x in (points, columns[:, k], prediction.normals)])
        distance = np.asarray(module.distance(primitive, jnp.float32(truth.samples[k])))
        worst = np.mean(np.sum((truth.samples[k] - truth.samples[k].mean(axis=0)) ** 2, axis=1))
        residue.append(np.mean(distance**2) if ok else worst)
        cosine = np.abs(np.dot(primitive[0], truth.axis[k])) if ok else 0.0
        parameter.append(0.0 if truth.kind[k] == 1 else 1 - cosine)
    return {
        "miou": np.mean([1 - iou_of(truth.mask & (truth.labels == k), columns[:, k]) for k in instances]),
        "normal": np.mean(1 - cosines[truth.mask]),
        "type": np.mean([-np.log(types[n, truth.kind[truth.labels[n]]]) for n in rows]),
        "parameter": np.mean(parameter),
        "residue": np.mean(residue),
    }


def informed(part, make_part, head, seed=0):
    """A prediction between the perfect and an arbitrary one, so that its fits succeed."""
    arbitrary = make_part.noise(part, np.random.default_rng(seed))[head]
    perfect = getattr(part, head)
    normals = perfect.normals + 0.1 * arbitrary.normals
    return jax.tree.map(lambda a, b: (0.2 * a + b).astype(a.dtype), perfect, arbitrary)._replace(
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True)
    )


@pytest.mark.parametrize("head", HEADS)
def test_a_perfect_prediction_costs_nothing(part, head, tolerance):
    terms, _ = evaluate(getattr(part, head), part.truth, part.points, ALL)
    names = {"miou", "normal", "type", "parameter", "residue", "orthogonality", "total"}
    assert set(terms) == names | ({"prototype", "spread"} if head == "prototype" else set())
    for name, value in terms.items():
        np.testing.assert_allclose(value, 0, atol=10 * tolerance["float32"], err_msg=name)


@pytest.mark.parametrize("head", HEADS)
def test_every_term_is_its_definition(part, make_part, head, tolerance):
    for prediction in (informed(part, make_part, head), make_part.noise(part, np.random.default_rng(1))[head]):
        terms, _ = evaluate(prediction, part.truth, part.points, ALL)
        for name, expected in loops(prediction, part.truth, part.points).items():
            np.testing.assert_allclose(terms[name], expected, atol=20 * tolerance["float32"], err_msg=name)
        total = sum(getattr(ALL, name) * value for name, value in terms.items() if name != "total")
        np.testing.assert_allclose(terms["total"], total, rtol=1e-6)


def test_orthogonality_is_the_mean_squared_cosine_between_columns(part, make_part, tolerance):
    membership = np.random.default_rng(0).random((20, 4))
    membership[:, 2] = 0
    directions = [membership[:, j] / max(np.linalg.norm(membership[:, j]), 1e-9) for j in range(4)]
    expected = np.mean([np.dot(directions[a], directions[b]) ** 2 for a in range(4) for b in range(4) if a != b])
    loss = jax.jit(objective.orthogonality_loss)
    np.testing.assert_allclose(loss(np.float32(membership)), expected, atol=tolerance["float32"])
    np.testing.assert_allclose(loss(np.eye(20, 4, dtype=np.float32)), 0, atol=tolerance["float32"])
    np.testing.assert_allclose(loss(np.ones((20, 4), np.float32)), 1, atol=tolerance["float32"])
    np.testing.assert_allclose(loss(np.ones((20, 1), np.float32)), 0)


@pytest.mark.parametrize("head", HEADS)
def test_order_of_points_and_slots_and_padding_do_not_matter(part, make_part, head, tolerance):
    prediction = make_part.noise(part, np.random.default_rng(2))[head]
    terms, _ = evaluate(prediction, part.truth, part.points, ALL)
    order = np.random.default_rng(3).permutation(len(part.points))
    truth = part.truth._replace(**{name: getattr(part.truth, name)[order] for name in ("mask", "normals", "labels")})
    shuffled = jax.tree.map(lambda x: x[order], prediction)
    if head == "slots":
        shuffled = shuffled._replace(membership_logits=shuffled.membership_logits[:, ::-1])
    again, _ = evaluate(shuffled, truth, part.points[order], ALL)
    hidden = ~part.truth.mask[:, None]
    garbage = jax.tree.map(lambda x: np.where(hidden, np.float32(7), x), prediction)
    padded, gradient = evaluate(garbage, part.truth, np.where(hidden, np.float32(-9), part.points), ALL)
    for name, value in terms.items():
        np.testing.assert_allclose(again[name], value, atol=20 * tolerance["float32"], err_msg=name)
        np.testing.assert_allclose(padded[name], value, atol=20 * tolerance["float32"], err_msg=name)
    for x in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(np.asarray(x)[hidden[:, 0]], 0)


def test_instances_beyond_the_slots_count_as_missed(part):
    labels = np.arange(208, dtype=np.int32) % 6
    everything = np.ones(6, bool)
    truth = part.truth._replace(labels=labels, instance_mask=everything, mask=np.ones(208, bool))
    logits = np.where(np.arange(4)[None, :] == labels[:, None], 30, -30).astype(np.float32)
    terms, gradient = evaluate(
        part.slots._replace(membership_logits=logits), truth, part.points, LossConfig(parameter=0.0, residue=0.0)
    )
    # Two of six instances have no slot; their 34 or 35 points are shared out among the four.
    members, shared = np.bincount(labels), np.bincount(labels)[4:].sum() / 4
    expected = (sum(1 - members[k] / (members[k] + shared) for k in range(4)) + 2) / 6
    np.testing.assert_allclose(terms["miou"], expected, atol=1e-5)
    assert np.isfinite(gradient.membership_logits).all()


@pytest.mark.parametrize("head", HEADS)
def test_gradients_are_finite_for_whatever_comes(part, make_part, head):
    arbitrary = make_part.noise(part, np.random.default_rng(4))[head]
    perfect = getattr(part, head)
    zero = jax.tree.map(np.zeros_like, perfect)
    squares = make_part.build(kinds=[0, 0, 0])
    nothing = part.truth._replace(labels=np.full(208, -1, np.int32), instance_mask=np.zeros(6, bool))
    hidden = nothing._replace(mask=np.zeros(208, bool))
    missing = part.truth._replace(instance_mask=np.ones(6, bool))
    for prediction, truth, points in [
        (arbitrary, part.truth, part.points),
        (jax.tree.map(lambda x: 1e3 * x, arbitrary), part.truth, part.points),
        (perfect, part.truth, part.points),
        (getattr(squares, head), squares.truth, squares.points),
        (zero, part.truth, part.points),
        (perfect, nothing, part.points),
        (perfect, hidden, part.points),
        (arbitrary, missing, part.points),
        (arbitrary, part.truth, 0 * part.points),
    ]:
        terms, gradient = evaluate(prediction, truth, points, ALL)
        assert all(np.isfinite(value) for value in terms.values())
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))
    terms, _ = evaluate(perfect, hidden, part.points, ALL)
    assert all(value == 0 for name, value in terms.items() if name not in ("orthogonality", "total"))


def test_fits_to_fewer_points_see_every_face_and_reach_membership_and_normals(part, make_part, tolerance):
    config = LossConfig(miou=0.0, normal=0.0, type=0.0, fit_points=100)
    terms, _ = evaluate(part.slots, part.truth, part.points, config)
    np.testing.assert_allclose([terms["parameter"], terms["residue"]], 0, atol=10 * tolerance["float32"])
    _, gradient = evaluate(informed(part, make_part, "slots"), part.truth, part.points, config)
    for x in (gradient.membership_logits, gradient.normals):
        assert 0 < np.count_nonzero(np.abs(x).max(axis=1) > 1e-9) <= 100
    assert not np.asarray(gradient.type_logits).any()


def test_a_batch_is_its_members(part, make_part, tolerance):
    parts = [part, make_part.build(1, kinds=[2, 3, 2])]
    config = LossConfig(parameter=0.0, residue=0.0)
    both = [(informed(p, make_part, "slots", seed), p.truth, p.points) for seed, p in enumerate(parts)]
    together = jax.tree.map(lambda a, b: np.stack([a, b]), *both)
    found = jax.jit(jax.vmap(functools.partial(losses, config=config)))(*together)
    for row, arguments in enumerate(both):
        for name, value in evaluate(*arguments, config)[0].items():
            np.testing.assert_allclose(found[name][row], value, atol=tolerance["float32"], err_msg=name)


def test_gradients_agree_with_finite_differences(make_part, x64):
    part = make_part.build(dtype=np.float64)
    prediction = informed(part, make_part, "slots")
    direction = make_part.noise(part, np.random.default_rng(5))["slots"]
    config = LossConfig(type=0.5, total=2.0)
    _, gradient = evaluate(prediction, part.truth, part.points, config)
    step = 1e-6
    moved = [jax.tree.map(lambda a, b, s=s: a + s * b, prediction, direction) for s in (step, -step)]
    ahead, behind = (evaluate(p, part.truth, part.points, config)[0]["total"] for p in moved)
    slope = sum(np.sum(np.asarray(a) * b) for a, b in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-5)


def test_pooled_types_are_judged_by_instance(part, tolerance):
    logits = np.random.default_rng(6).normal(size=(6, 4)).astype(np.float32)
    prediction = part.slots._replace(segment_type_logits=logits)
    truth = part.truth._replace(instance_mask=np.arange(6) < 5)  # instance 4 has no point
    found = jax.jit(objective.type_loss)(prediction, truth)
    expected = np.mean([-np.log(softmax(logits)[k, truth.kind[k]]) for k in range(4)])
    np.testing.assert_allclose(found, expected, atol=tolerance["float32"])
    with pytest.raises(ValueError, match="8 rows for 6 true instances"):
        wrong = prediction._replace(segment_type_logits=np.zeros((8, 4), np.float32))
        jax.eval_shape(functools.partial(losses, config=LossConfig()), wrong, part.truth, part.points)


def test_balanced_types_count_instances_beside_points(part, make_part, tolerance):
    prediction = make_part.noise(part, np.random.default_rng(2))["slots"]
    log_share, truth = np.log(softmax(prediction.type_logits)), part.truth
    points = [n for n in range(len(truth.labels)) if truth.mask[n] and truth.labels[n] >= 0]
    surprise = {n: -log_share[n, truth.kind[truth.labels[n]]] for n in points}
    of_instance = [
        np.mean([surprise[n] for n in points if truth.labels[n] == k])
        for k in np.unique([truth.labels[n] for n in points])
        if truth.instance_mask[k]
    ]
    expected = 0.25 * np.mean(list(surprise.values())) + 0.75 * np.mean(of_instance)
    found = jax.jit(functools.partial(objective.type_loss, balance=0.75))(prediction, truth)
    np.testing.assert_allclose(found, expected, atol=tolerance["float32"])


def test_a_weight_of_zero_leaves_the_work_out(part):
    config = LossConfig(miou=0.0, parameter=0.0, residue=0.0, type=0.0, prototype=0.0)
    for head, names in (("slots", {"normal"}), ("prototype", {"normal", "spread"})):
        trace = jax.make_jaxpr(losses, static_argnums=3)(getattr(part, head), part.truth, part.points, config)
        terms = jax.eval_shape(functools.partial(losses, config=config), getattr(part, head), part.truth, part.points)
        assert set(terms) == names | {"total"}
        assert not any(word in str(trace) for word in ("while", "eigh", "cholesky"))


def test_what_cannot_be_computed_is_said(part):
    for wrong in ({"miou": -1.0}, {"sharpness": 0.0}, {"fit_points": -5}, {"type_balance": 1.5}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} of the losses is"):
            LossConfig(**wrong)
    without = part.slots._replace(membership_logits=None)
    with pytest.raises(ValueError, match="neither membership_logits nor an embedding"):
        jax.eval_shape(functools.partial(losses, config=LossConfig()), without, part.truth, part.points)
    truth = part.truth._replace(samples=np.zeros((6, 0, 3), np.float32))
    with pytest.raises(ValueError, match="truth.samples holds no points"):
        jax.eval_shape(functools.partial(losses, config=LossConfig()), part.slots, truth, part.points)
