"""The six metrics over a data set: clouds and noise, perfect answers, a network's answers, and rows of scores."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.data.native import Dataset
from jprimfit.evaluation import six, tables
from jprimfit.networks import inference
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.scene import Scene

POINTS = 256


def drawn(path, *, noise=None, network=None, num_points=POINTS, most=None):
    with Dataset(path) as dataset:
        numbers = six.parts_of(dataset, "test", most=most)
        return list(six.cases(dataset, numbers, network=network, num_points=num_points, noise=noise))


def truth_as_scene(case):
    """The scene that says what is true: its primitives are fitted to the clean samples."""
    example, truth = case.example, case.example.truth
    primitives = []
    for row in np.flatnonzero(truth.instance_mask):
        kind = KINDS[truth.kind[row]]
        near = np.argmin(
            np.sum((truth.samples[row][:, None] - example.points[truth.labels == row][None]) ** 2, axis=-1), axis=1
        )
        normals = truth.normals[truth.labels == row][near]
        fit = MODULES[kind].fit(*map(jnp.asarray, (truth.samples[row], np.ones(len(normals), np.float32), normals)))
        primitives.append(jax.tree.map(np.asarray, fit.primitive))
    num = len(example.points)
    return Scene(
        points=example.points.astype(np.float64),
        labels=truth.labels,
        primitives=tuple(primitives),
        surface_of=np.arange(len(primitives), dtype=np.int32),
        normals=truth.normals.astype(np.float64),
        distances=np.zeros(num),
    )


def test_clouds_are_the_same_in_every_run_and_for_every_network(parts_file, tiny_model):
    one, other = drawn(parts_file), drawn(parts_file, network=tiny_model().config)
    assert [case.name for case in one] == [f"test {seed}" for seed in range(5)]
    for first, second in zip(one, other, strict=True):
        np.testing.assert_array_equal(first.example.points, second.example.points)
        np.testing.assert_array_equal(first.example.truth.labels, second.example.truth.labels)
        assert first.example.truth.samples.shape[1:] == (six.NUM_SAMPLES, 3)
    assert not np.array_equal(one[0].example.points, one[1].example.points)
    np.testing.assert_allclose(one[0].shares, np.array([4.0, 1.1, 1.0, 0.2]) / 6.3)


def test_clouds_are_normalised_and_as_noisy_as_asked_for(parts_file):
    clean, table_1, gaussian = (drawn(parts_file, noise=noise) for noise in (0.0, None, 2.0))
    for case in (*clean, *table_1, *gaussian):
        assert np.ptp(case.example.points, axis=0).max() == pytest.approx(2, abs=1e-5)
        np.testing.assert_allclose(case.example.points.mean(axis=0), 0, atol=1e-5)

    def heights(cases):  # over the floor, whose normal is (0, 0, 1)
        found = []
        for case in cases:
            floor = case.example.truth.labels == 0
            found.append(case.example.points[floor, 2] - case.example.truth.samples[0, 0, 2])
        return np.concatenate(found)

    assert np.abs(heights(clean)).max() < 1e-5
    assert 0.009 < np.abs(heights(table_1)).max() < 0.0101
    # The box of a part is about 2 x 2 x 1, its diagonal in the normalised frame 3: two per cent are 0.06.
    assert np.std(heights(gaussian)) == pytest.approx(0.06, rel=0.15)


def test_the_truth_scores_perfectly(parts_file):
    for case in drawn(parts_file, noise=0.0):
        row = six.score_row(case, six.score_scene(case, truth_as_scene(case)), 0.0)
        for name in ("miou", "type_accuracy", "p_coverage", "p_coverage_02", "s_coverage", "s_coverage_02"):
            assert row[name] == pytest.approx(1, abs=1e-6), name
        assert row["normal_deg"] < 0.1 and row["axis_deg"] < 0.1 and row["residual"] < 5e-4
        assert row["num_segments"] == row["num_instances"] == 4 and row["unassigned"] == 0
        assert [part["kind"] for part in row["instances"]] == list(KINDS)
        assert all(part["iou"] == pytest.approx(1) and part["type_right"] == 1 for part in row["instances"])
        assert np.isnan(row["instances"][1]["axis_deg"])  # a sphere has none


def test_what_is_wrong_costs_where_it_is_wrong(parts_file):
    (case,) = drawn(parts_file, noise=0.0, most=1)
    scene = truth_as_scene(case)
    labels = np.where(scene.labels == 2, -1, scene.labels)  # the column is not found
    primitives = (*scene.primitives[:3], scene.primitives[0])  # and a plane stands for the cone
    tilted = np.where((scene.labels == 0)[:, None], [0.0, np.sin(0.1), np.cos(0.1)], scene.normals)
    scene = replace(scene, labels=labels.astype(np.int32), primitives=primitives, normals=tilted)
    row = six.score_row(case, six.score_scene(case, scene), 0.0)
    share = {name: float(np.mean(case.example.truth.labels == number)) for number, name in enumerate(KINDS)}
    plane, sphere, cylinder, cone = row["instances"]
    assert row["miou"] == pytest.approx(3 / 4) and row["type_accuracy"] == pytest.approx(2 / 3)
    assert row["unassigned"] == pytest.approx(share["cylinder"])
    assert cylinder["iou"] == 0 and np.isnan(cylinder["type_right"]) and np.isnan(cylinder["residual"])
    assert cone["iou"] == 1 and cone["type_right"] == 0 and np.isnan(cone["axis_deg"]) and cone["residual"] > 0.1
    assert plane["normal_deg"] == pytest.approx(np.degrees(0.1), rel=1e-3) and sphere["normal_deg"] < 0.1
    assert row["normal_deg"] == pytest.approx(np.degrees(0.1) * share["plane"], rel=1e-2)


@pytest.mark.parametrize(
    ("head", "fields"), [("slots", {}), ("prototype", {}), ("slots", {"types": "pooled"})], ids=str
)
def test_the_score_of_a_cloud_does_not_depend_on_its_batch(parts_file, tiny_model, head, fields):
    model = tiny_model(head, **fields)
    found = drawn(parts_file, network=model.config)
    together = list(six.network_scores(model, iter(found), batch_size=2))
    backwards = list(six.network_scores(model, iter(found[::-1]), batch_size=2))
    assert [row["name"] for row in together] == [case.name for case in found]
    for a, b in zip(together, backwards[::-1], strict=True):
        for name in tables.METRICS:
            np.testing.assert_allclose(a[name], b[name], rtol=1e-3, atol=1e-4, err_msg=name)
    assert np.isnan(together[0]["seconds"]) and together[-1]["seconds"] > 0
    assert 0 <= together[0]["miou"] <= 1 and 0 < together[0]["normal_deg"] < 90


def test_a_network_is_measured_on_what_fit_would_give_it(parts_file, tiny_model):
    config = tiny_model().config
    for case in drawn(parts_file, network=config, num_points=400, most=2):
        points = case.example.points[case.example.mask]
        rows, cloud = inference.sample(config, points)
        assert len(rows) == 256 < len(points)
        jax.tree.map(np.testing.assert_array_equal, case.seen.cloud, cloud)
        np.testing.assert_array_equal(case.seen.nearest[rows], np.arange(len(rows)))


def test_a_split_that_is_not_there_is_named(parts_file):
    with Dataset(parts_file) as dataset:
        with pytest.raises(ValueError, match="no split 'train'; it has test, val"):
            six.parts_of(dataset, "train")
        assert six.parts_of(dataset, "test", every=2).tolist() == [0, 2, 4]
        assert six.parts_of(dataset, "test", every=2, most=2).tolist() == [0, 2]
