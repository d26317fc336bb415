"""One cloud of a pool: in the normalised frame after noise, its truth moved with it, padding marked."""

import numpy as np
import pytest

from jprimfit.data.clouds import LoaderConfig, draw_example, random_rotation, usable_parts
from jprimfit.data.native import Dataset
from jprimfit.geometry import host
from jprimfit.geometry.hierarchy import HierarchySpec

SPEC = HierarchySpec((32, 8), (8, 8), (4, 4), (8, 8), (0.5, 1.0), (0.25, 0.5), (np.inf, np.inf))
CONFIG = LoaderConfig(num_points=256, num_query=0, num_samples=20, max_instances=9, thin_share=0.0)


def draw(part, number=0, **settings):
    config = LoaderConfig(**{**vars(CONFIG), **settings})
    return draw_example(part, config=config, spec=SPEC, neighborhoods=(8, 16), number=number)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_frame_truth_and_noise(drilled_block, noise):
    example = draw(drilled_block(0.4, 0.5), uniform_noise=(noise, noise))
    truth = example.truth
    np.testing.assert_allclose(example.points.mean(axis=0), 0.0, atol=1e-6)
    assert np.ptp(example.points, axis=0).max() == pytest.approx(2.0, abs=1e-6)
    assert truth.instance_mask.tolist() == [True] * 7 + [False] * 2
    assert truth.kind.tolist() == [0] * 6 + [2, 0, 0] and truth.samples.shape == (9, 20, 3)
    assert not truth.axis[7:].any() and not truth.samples[7:].any()
    # On a plane, points stand off the samples by no more than the noise, along the true normal, which is the axis.
    for instance in range(6):
        normal = truth.axis[instance]
        offset = truth.samples[instance].astype(np.float64) @ normal
        assert np.ptp(offset) < 1e-5
        own = truth.labels == instance
        height = example.points[own] @ normal - offset.mean()
        assert np.abs(height).max() < noise * 1.05 + 1e-5 and np.abs(height).max() >= noise * 0.5
        np.testing.assert_allclose(np.abs(truth.normals[own] @ normal), 1.0, atol=1e-6)
    radial = truth.normals[truth.labels == 6]
    np.testing.assert_allclose(radial @ truth.axis[6], 0.0, atol=1e-6)


def test_clouds_are_turned_only_where_asked(drilled_block):
    turned, still = (draw(drilled_block(), rotate=rotate) for rotate in (True, False))
    np.testing.assert_allclose(still.truth.axis[:6], np.tile(np.eye(3)[[2, 0, 1]], (2, 1))[[0, 0, 1, 2, 1, 2]], atol=0)
    assert np.abs(turned.truth.axis).max() < 0.999


def test_thinned_clouds_have_padding_behind(drilled_block):
    counts = []
    for number in range(12):
        example = draw(drilled_block(), number, thin_share=0.7, min_points=40)
        count = int(example.mask.sum())
        assert example.mask[:count].all() and (example.truth.mask == example.mask).all()
        np.testing.assert_array_equal(example.points[count:], np.repeat(example.points[:1], 256 - count, axis=0))
        assert (example.truth.labels[count:] == -1).all()
        assert np.ptp(example.points[:count], axis=0).max() == pytest.approx(2.0, abs=1e-6)
        counts.append(count)
    assert 40 <= min(counts) < 150 and counts.count(256) in range(1, 9)


def test_gaussian_noise_in_the_share_asked_for(drilled_block):
    flat = drilled_block(0.4, 0.5)
    settings = {"uniform_noise": (0.0, 0.0), "gaussian_noise": (0.05, 0.05), "gaussian_share": 0.5}
    spread = []
    for number in range(10):
        example = draw(flat, number, rotate=False, **settings)
        top = example.truth.labels == 0
        spread.append(np.std(example.points[top, 2]))
    assert all(value < 1e-6 or 0.02 < value < 0.08 for value in spread)
    assert 1 <= sum(value < 1e-6 for value in spread) <= 9


def test_stored_noise_is_used(make_part, drilled_block):
    part = make_part(0, forms=("cloud",), points=60)
    example = draw(part, noise="stored", rotate=False)
    expected = host.normalize(part.cloud.noisy_points)[0]
    assert example.mask.sum() == 60
    order = np.lexsort(expected.T), np.lexsort(example.points[:60].T)
    np.testing.assert_allclose(example.points[order[1]], expected[order[0]], atol=1e-5)
    with pytest.raises(ValueError, match="no noisy points"):
        draw(drilled_block(), noise="stored")


def test_a_rotation_preserves_lengths_and_hands():
    rotations = np.stack([random_rotation(np.random.default_rng(seed)) for seed in range(2000)])
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.broadcast_to(np.eye(3), (2000, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)
    np.testing.assert_allclose(rotations.mean(axis=0), 0.0, atol=0.06)


def test_parts_that_cannot_be_used_are_counted(blocks):
    with Dataset(blocks) as dataset:
        parts, left_out = usable_parts(dataset, CONFIG)
        assert parts.tolist() == [0, 1, 2, 3, 4] and left_out == 0
        assert usable_parts(dataset, LoaderConfig(split="val"))[0].tolist() == [5, 6]
        with pytest.raises(ValueError, match="no split 'test'; it has train, val"):
            usable_parts(dataset, LoaderConfig(split="test"))
        with pytest.raises(ValueError, match="no part with 1 to 6 instances"):
            usable_parts(dataset, LoaderConfig(max_instances=6))


@pytest.mark.parametrize(
    "settings",
    [
        {"num_points": 0},
        {"num_query": 9000},
        {"thin_share": 1.5},
        {"min_points": 9000, "thin_share": 0.1},
        {"uniform_noise": (0.2, 0.1)},
        {"max_instances": 40_000},
    ],
)
def test_settings_that_make_no_sense_are_named(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        LoaderConfig(**settings)
