"""The prototypes' softmax and losses against loops, finite differences and invariances."""

import jax
import jax.numpy as jnp
import numpy as np

from jprimfit.objectives import prototypes

NUM_POINTS, NUM_INSTANCES, NUM_CHANNELS = 24, 4, 3
MASK = np.arange(NUM_POINTS) < 22
LABELS = np.array([0, 1, 1, -1, 3, 0] * 4)  # instance 2 has no point
OWN = np.eye(5)[LABELS][:, :4] * MASK[:, None]


@jax.jit
def similarity(embedding, own):
    return prototypes.similarity(embedding, own, num_seeds=NUM_POINTS // 2)


@jax.jit
def everything(embedding, own):
    found = prototypes.prototypes(embedding, own)
    return (
        prototypes.cross_entropy(found, own),
        prototypes.spread(found, own),
        prototypes.membership_of(found, own),
    )


def loops(embedding):
    """Cross-entropy, spread and membership by the definition."""
    present = [k for k in range(NUM_INSTANCES) if OWN[:, k].any()]
    centers = {k: embedding[OWN[:, k] > 0].mean(axis=0) for k in present}
    surprise, sq_distance = {k: [] for k in present}, {k: [] for k in present}
    membership = np.zeros((NUM_POINTS, NUM_INSTANCES))
    for n in range(NUM_POINTS):
        weight = {k: np.exp(-2 * np.sum((embedding[n] - centers[k]) ** 2)) for k in present}
        if OWN[n].any():
            membership[n, present] = [weight[k] / sum(weight.values()) for k in present]
        if OWN[n].any():
            k = int(OWN[n].argmax())
            surprise[k].append(-np.log(weight[k] / sum(weight.values())))
            sq_distance[k].append(np.sum((embedding[n] - centers[k]) ** 2))
    return balanced(surprise), balanced(sq_distance), membership


def balanced(by_instance):
    """Half the mean over points, half that over instances of their means."""
    points = np.mean([value for values in by_instance.values() for value in values])
    return (points + np.mean([np.mean(values) for values in by_instance.values() if values])) / 2


def test_losses_and_membership_are_the_definition(tolerance):
    embedding = np.random.default_rng(0).normal(size=(NUM_POINTS, NUM_CHANNELS))
    for found, expected in zip(everything(np.float32(embedding), np.float32(OWN)), loops(embedding), strict=True):
        np.testing.assert_allclose(found, expected, atol=tolerance["float32"])


def test_a_common_shift_changes_nothing(tolerance):
    embedding = np.float32(np.random.default_rng(1).normal(size=(NUM_POINTS, NUM_CHANNELS)))
    here, there = everything(embedding, np.float32(OWN)), everything(embedding + 100, np.float32(OWN))
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one, other, atol=50 * tolerance["float32"])


def test_gradients_agree_with_finite_differences(x64):
    generator = np.random.default_rng(2)
    embedding, direction = generator.normal(size=(2, NUM_POINTS, NUM_CHANNELS))

    def value(x):
        cross_entropy, spread, _ = everything(x, OWN)
        return cross_entropy + 0.1 * spread

    slope = np.sum(np.asarray(jax.grad(value)(jnp.asarray(embedding))) * direction)
    step = 1e-6
    expected = (value(embedding + step * direction) - value(embedding - step * direction)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-7)


def test_far_apart_equal_and_missing_embeddings_are_finite():
    for embedding in (1e4 * OWN[:, :3], np.zeros((NUM_POINTS, NUM_CHANNELS)), np.full((NUM_POINTS, 3), 1e6)):
        for own in (OWN, 0 * OWN):
            gradient = jax.grad(lambda x, own=own: sum(jnp.sum(y) for y in everything(x, np.float32(own))))
            assert np.isfinite(gradient(jnp.float32(embedding))).all()
            assert all(np.isfinite(x).all() for x in everything(np.float32(embedding), np.float32(own)))
    cross_entropy, spread, membership = everything(np.float32(OWN[:, :3]), np.float32(0 * OWN))
    assert cross_entropy == spread == 0
    assert not np.asarray(membership).any()


def test_similarity_is_its_definition(tolerance):
    embedding = np.random.default_rng(2).normal(size=(NUM_POINTS, NUM_CHANNELS))
    num_seeds, labelled = NUM_POINTS // 2, OWN.any(axis=1)
    surprise = {k: [] for k in range(NUM_INSTANCES)}
    for seed in np.arange(num_seeds) * NUM_POINTS // num_seeds:
        if not labelled[seed]:
            continue
        same = {k: [] for k in range(NUM_INSTANCES)}
        for n in np.flatnonzero(labelled):
            similar = np.exp(-2 * max(np.sum((embedding[n] - embedding[seed]) ** 2), 5e-4))
            near = -2 * np.sum((embedding[n] - embedding[seed]) ** 2)
            k = int(OWN[n].argmax())
            same[k].append(-near if OWN[seed, k] else -np.log(1 - similar))
        surprise[int(OWN[seed].argmax())].append(sum(np.mean(values) for values in same.values() if values))
    expected = balanced({k: values for k, values in surprise.items() if values})
    found = similarity(np.float32(embedding), np.float32(OWN))
    np.testing.assert_allclose(found, expected, rtol=10 * tolerance["float32"])


def test_similarity_is_low_for_tight_clusters_far_apart_and_finite_where_all_are_one():
    tight = similarity(jnp.float32(10 * OWN), np.float32(OWN))
    one = similarity(jnp.zeros((NUM_POINTS, 3)), np.float32(OWN))
    assert tight < 1e-3 < one and np.isfinite(one)
    for own in (OWN, 0 * OWN):
        slope = jax.grad(lambda x, own=own: similarity(x, np.float32(own)))(jnp.zeros((NUM_POINTS, 3)))
        assert np.isfinite(slope).all()
