"""One step of training: what it changes, what its random numbers depend on, and that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks import weights
from jprimfit.networks.segmenter import Segmenter
from jprimfit.training import parallel, state, step
from jprimfit.training.config import from_mapping


class Setting:
    """A toy network, its first state, and one compiled call of gradients."""

    def __init__(self, mapping, batch):
        self.config = from_mapping(mapping, source="test")
        cloud = jax.tree.map(lambda x: x[0], batch)
        variables = step.initial_variables(Segmenter(self.config.model), cloud, config=self.config)
        self.start = state.create(variables, config=self.config.optimizer)
        self.segmenter = Segmenter(self.config.model, axis_names=(step.CLOUD, parallel.AXIS))
        self.devices = parallel.parallelise(
            lambda s, b: (s, step.gradients(self.segmenter, s, b, config=self.config)), kind="pmap", num_devices=1
        )

    def gradients(self, batch, row, *, steps=0):
        start = self.devices.replicate(self.start._replace(step=np.int32(steps)))
        batch = step.Batch(batch, np.asarray(row, np.int32))
        return self.devices.first(self.devices.step(start, self.devices.shard(batch))[1])


@pytest.fixture
def setting(toy_mapping, toy_batch):
    return Setting(toy_mapping, toy_batch)


def largest_difference(first, second):
    return max(jax.tree.leaves(jax.tree.map(lambda a, b: np.max(np.abs(a - b)), first, second)))


def test_dropout_belongs_to_the_cloud_of_the_run_not_to_its_place(setting, toy_batch):
    rows = np.arange(8)
    slopes, statistics, terms = setting.gradients(toy_batch, rows)
    turned = np.roll(rows, 3)
    again = setting.gradients(jax.tree.map(lambda x: x[turned], toy_batch), turned)
    assert largest_difference((slopes, statistics, terms), again) < 1e-5
    # Clouds 8 to 15 of the run are step 0, rows 8 to 15, or step 1, rows 0 to 7: other masks, other gradients.
    later = setting.gradients(toy_batch, rows, steps=1)
    np.testing.assert_array_equal(later[2]["total"], setting.gradients(toy_batch, rows + 8)[2]["total"])
    assert largest_difference(slopes, later[0]) > 1e-3


def test_the_loss_is_the_mean_of_its_weighted_terms(setting, toy_batch):
    _, _, terms = setting.gradients(toy_batch, np.arange(8))
    weights = setting.config.loss
    names = ("miou", "normal", "type", "orthogonality")
    assert set(terms) == {*names, "total"}
    np.testing.assert_allclose(terms["total"], sum(getattr(weights, name) * terms[name] for name in names), rtol=1e-5)


def test_the_gradient_is_that_of_the_loss(toy_mapping, toy_batch, x64):
    toy_mapping["loss"] = {"miou": 0, "residue": 0, "parameter": 0}
    setting = Setting(toy_mapping, toy_batch)

    def double(tree):
        return jax.tree.map(lambda x: x.astype(np.float64) if np.asarray(x).dtype.kind == "f" else x, tree)

    generator = np.random.default_rng(0)
    start, batch = double(setting.start), double(toy_batch)
    # At the start biases are 0, and so is the offset of a centroid to itself: exactly in the kink of a ReLU.
    params = jax.tree.map(lambda x: x + 0.1 * generator.normal(size=x.shape), start.params)
    setting.start = start._replace(params=params)
    rows, size = np.arange(8), 1e-8  # small, for the other kinks
    slopes = setting.gradients(batch, rows)[0]
    direction = jax.tree.map(lambda x: generator.normal(size=x.shape), setting.start.params)
    totals = []
    for sign in (-1, 1):
        params = jax.tree.map(lambda x, d, s=sign: x + s * size * d, setting.start.params, direction)
        moved = setting.start._replace(params=params)
        setting.start, kept = moved, setting.start
        totals.append(setting.gradients(batch, rows)[2]["total"])
        setting.start = kept
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: np.sum(g * d), slopes, direction)))
    np.testing.assert_allclose((totals[1] - totals[0]) / (2 * size), along, rtol=1e-4)


@pytest.mark.parametrize("head", ["slots", "prototype"])
def test_it_learns_a_few_clouds_by_heart(toy_mapping, toy_batch, head):
    toy_mapping["model"] |= {"head": head, "embedding_size": 4, "dropout": 0.0}
    toy_mapping["optimizer"] = {"learning_rate": 1e-2, "ema": 0.5, "clip_norm": 10}
    setting = Setting(toy_mapping, toy_batch)
    devices = parallel.parallelise(
        step.train_step(setting.segmenter, config=setting.config, num_steps=60), kind="pmap", num_devices=1
    )
    placed, losses = devices.replicate(setting.start), []
    batch = devices.shard(step.Batch(toy_batch, np.arange(8, dtype=np.int32)))
    for _ in range(60):
        placed, metrics = devices.step(placed, batch)
        losses.append(float(devices.first(metrics)["total"]))
    assert losses[-1] < 0.4 * losses[0]
    end = devices.first(placed)
    assert end.step == 60 and devices.first(metrics)["finite"]
    averaged = state.variables(end)["params"]
    assert 0 < largest_difference(averaged, end.params) < largest_difference(averaged, setting.start.params)


def test_pooled_types_are_learned_from_the_true_segments(toy_mapping, toy_batch):
    toy_mapping["model"]["types"] = "pooled"
    slopes, _, terms = Setting(toy_mapping, toy_batch).gradients(toy_batch, np.arange(8))
    assert np.isfinite(terms["type"])
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(slopes["segment_types"]))


def test_losses_that_are_not_finite_are_told(setting, toy_batch):
    devices = parallel.parallelise(
        step.train_step(setting.segmenter, config=setting.config, num_steps=1), kind="pmap", num_devices=1
    )
    points = toy_batch.points.copy()
    points[0, 0] = np.nan
    batch = step.Batch(toy_batch._replace(points=points), np.arange(8, dtype=np.int32))
    _, metrics = devices.step(devices.replicate(setting.start), devices.shard(batch))
    assert not devices.first(metrics)["finite"]
    assert jnp.isnan(devices.first(metrics)["total"])


def test_a_step_that_is_not_finite_is_skipped_where_that_is_allowed(toy_mapping, toy_batch):
    toy_mapping["optimizer"] = {"skip_non_finite": 3, "ema": 0.9}
    setting = Setting(toy_mapping, toy_batch)
    devices = parallel.parallelise(
        step.train_step(setting.segmenter, config=setting.config, num_steps=1), kind="pmap", num_devices=1
    )
    points = toy_batch.points.copy()
    points[0, 0] = np.nan
    for given, is_kept in ((points, True), (toy_batch.points, False)):
        batch = step.Batch(toy_batch._replace(points=given), np.arange(8, dtype=np.int32))
        after = devices.first(devices.step(devices.replicate(setting.start), devices.shard(batch))[0])
        assert after.step == 1
        changed = largest_difference(after._replace(step=setting.start.step), setting.start)
        assert changed == 0 if is_kept else changed > 1e-4


def test_a_batch_in_parts_has_the_gradient_of_the_whole(toy_mapping, toy_batch):
    # Parts of the same clouds, so that BatchNorm finds the same statistics in each.
    batch = jax.tree.map(lambda x: np.concatenate([x[:4], x[:4]]), toy_batch)
    toy_mapping["model"]["dropout"] = 0.0
    whole = Setting(toy_mapping, batch).gradients(batch, np.arange(8))
    toy_mapping["train"]["accumulate"] = 2
    parts = Setting(toy_mapping, batch).gradients(batch, np.arange(8))
    largest = max(np.max(np.abs(slopes)) for slopes in jax.tree.leaves(whole[0]))
    assert largest_difference(whole[0], parts[0]) < 1e-5 * largest
    assert largest_difference(whole[2], parts[2]) < 1e-5


def test_a_run_may_start_from_a_model_of_the_same_settings(setting, toy_mapping, tmp_path):
    assert step.start_model(setting.config) is None
    variables = jax.tree.map(lambda x: x + 1, state.variables(setting.start))
    weights.save(tmp_path / "weights", weights.Model(setting.config.model, variables, "before", {}))
    toy_mapping["train"]["start_from"] = str(tmp_path)
    found = step.start_model(from_mapping(toy_mapping, source="test"))
    jax.tree.map(np.testing.assert_array_equal, found.variables, variables)
    toy_mapping["model"]["shared"] = 8
    with pytest.raises(ValueError, match=r"other settings of model\.shared"):
        step.start_model(from_mapping(toy_mapping, source="test"))
