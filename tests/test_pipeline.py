"""jprimfit's answer as users meet it: the contract of the scene, and what must not matter about the input."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jprimfit import pipeline
from jprimfit.networks import weights
from jprimfit.pipeline import fit

ROOT = Path(__file__).resolve().parent.parent
STEP = 0.08
SIGMA = 0.02 * STEP
GOLDEN = np.pi * (1 + np.sqrt(5))
TRUE_KINDS = ("plane", "cylinder", "cone", "sphere")


def pencil():
    """A round plate, a cylinder on it, a cone on that, a ball beside them: points, unit normals and surface of each."""

    def turned(low_radius, high_radius, low, high, num, normal):
        """A frustum around the z axis: num points between two radii and heights, evenly by area."""
        row = (np.arange(num) + 0.5) / num
        radius = np.sqrt(low_radius**2 + (high_radius**2 - low_radius**2) * row)
        share = row if low_radius == high_radius else (radius - low_radius) / (high_radius - low_radius)
        angle = GOLDEN * np.arange(num)
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros(num)], axis=1)
        axis = np.array([[0.0, 0, 1]])
        points = radius[:, None] * around + (low + (high - low) * share)[:, None] * axis
        return points, np.cos(normal) * around + np.sin(normal) * axis

    height, angle = 1 - 2 * (np.arange(360) + 0.5) / 360, GOLDEN * np.arange(360)
    width = np.sqrt(1 - height**2)
    directions = np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)
    pieces = [
        turned(0.5, 1.2, 0.0, 0.0, 560, np.pi / 2),
        turned(0.5, 0.5, 0.0, 1.0, 480, 0.0),
        turned(0.5, 0.1, 1.0, 1.8, 260, np.arctan2(0.4, 0.8)),
        (0.5 * directions + [[2.0, 0, 0.8]], directions),
    ]
    points, normals = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    return points, normals, np.repeat(np.arange(4), [len(piece[0]) for piece in pieces])


POINTS, NORMALS, TRUTH = pencil()
NOISY = POINTS + SIGMA * np.random.default_rng(0).normal(size=(len(POINTS), 1)) * NORMALS


@pytest.fixture(scope="module")
def clean():
    return fit(POINTS)


@pytest.fixture(scope="module")
def noisy():
    return fit(NOISY)


def by_kind(scene):
    """The primitive of each kind; fails where there is not exactly one of each."""
    assert sorted(p.kind for p in scene.primitives) == sorted(TRUE_KINDS)
    return {primitive.kind: primitive for primitive in scene.primitives}


def surfaces(scene):
    """The row of TRUE_KINDS of every point, -1 = none; kinds are unique in this part."""
    number = np.array([TRUE_KINDS.index(p.kind) for p in scene.primitives] + [-1])
    return number[scene.labels]


def numpy_distance(primitive, points):
    if primitive.kind == "plane":
        return np.abs(points @ primitive.normal - primitive.offset)
    if primitive.kind == "sphere":
        return np.abs(np.linalg.norm(points - primitive.center[None], axis=1) - primitive.radius)
    offset = points - (primitive.center if primitive.kind == "cylinder" else primitive.apex)[None]
    along, across = offset @ primitive.axis, np.linalg.norm(np.cross(offset, primitive.axis[None]), axis=1)
    if primitive.kind == "cylinder":
        return np.abs(across - primitive.radius)
    return np.abs(across * np.cos(primitive.half_angle) - along * np.sin(primitive.half_angle))


def check_contract(scene, num_points, atol):
    """What the public contract says of every scene, distances recomputed in NumPy to within atol."""
    assert scene.labels.shape == scene.distances.shape == (num_points,) and scene.normals.shape == (num_points, 3)
    assert scene.labels.dtype == scene.surface_of.dtype == np.int32
    assert scene.labels.min() >= -1 and set(range(len(scene.primitives))) == set(scene.labels.tolist()) - {-1}
    assert len(scene.surface_of) == len(scene.primitives)
    np.testing.assert_array_equal(np.isnan(scene.distances), scene.labels < 0)
    for number, primitive in enumerate(scene.primitives):
        rows = scene.labels == number
        np.testing.assert_allclose(scene.distances[rows], numpy_distance(primitive, scene.points[rows]), atol=atol)
        direction = {"plane": "normal", "sphere": None}.get(primitive.kind, "axis")
        if direction:
            assert np.linalg.norm(getattr(primitive, direction)) == pytest.approx(1, abs=1e-12)
    finite = np.isfinite(scene.normals).all(axis=1)
    np.testing.assert_allclose(np.linalg.norm(scene.normals[finite], axis=1), 1, atol=1e-9)
    assert finite[scene.labels >= 0].all()


def check_parameters(scene, tolerance, scale=1.0, shift=0.0):
    """The pencil's parameters, in the unit and frame that it was given in."""
    found, shift = by_kind(scene), np.zeros(3) + shift

    def near(value, true):
        np.testing.assert_allclose(value, true, rtol=0, atol=tolerance * scale)

    def upright(direction, sign=1.0):
        np.testing.assert_allclose(direction, [0, 0, sign], rtol=0, atol=tolerance)

    upright(found["plane"].normal)
    near(found["plane"].offset - found["plane"].normal @ shift, 0)
    near(found["sphere"].center - shift, np.array([2, 0, 0.8]) * scale)
    near(found["sphere"].radius, 0.5 * scale)
    upright(found["cylinder"].axis)
    near((found["cylinder"].center - shift)[:2], 0)
    near(found["cylinder"].radius, 0.5 * scale)
    upright(found["cone"].axis, -1.0)  # from the apex down into the nappe that is there
    near(found["cone"].apex - shift, np.array([0, 0, 2]) * scale)
    assert found["cone"].half_angle == pytest.approx(np.arctan(0.5), abs=tolerance)


def test_a_clean_scan_is_explained_exactly(clean):
    check_contract(clean, len(POINTS), atol=1e-6)
    check_parameters(clean, 1e-3)
    assert (surfaces(clean) == TRUTH).mean() > 0.99
    assert clean.noise < 0.005 * STEP
    np.testing.assert_array_equal(clean.points, POINTS)
    assert len(set(clean.surface_of.tolist())) == 4


def test_a_noisy_scan_keeps_kinds_and_nearly_its_parameters(noisy):
    check_contract(noisy, len(POINTS), atol=1e-5)
    check_parameters(noisy, 0.01)
    assert (surfaces(noisy) == TRUTH).mean() > 0.97
    assert noisy.noise == pytest.approx(SIGMA, rel=0.2)
    used = noisy.labels >= 0
    assert np.sqrt(np.mean(noisy.distances[used] ** 2)) == pytest.approx(SIGMA, rel=0.15)


@pytest.mark.parametrize("share", [0.05, 0.1])
def test_more_noise_may_add_specks_but_loses_no_surface(share):
    scan = POINTS + share * STEP * np.random.default_rng(2).normal(size=(len(POINTS), 1)) * NORMALS
    scene = fit(scan)
    check_contract(scene, len(POINTS), atol=1e-5)
    matched = [int(np.bincount(scene.labels[TRUTH == i] + 1).argmax()) - 1 for i in range(4)]
    assert [scene.primitives[label].kind for label in matched] == list(TRUE_KINDS)
    assert (scene.labels == np.array(matched)[TRUTH]).mean() > 0.95
    assert scene.noise == pytest.approx(share * STEP, rel=0.2)


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 1e6), (1e-6, 0.0), (1e3, [0, -3e5, 2e4])])
def test_unit_and_position_do_not_matter(clean, scale, shift):
    moved = POINTS * scale + np.asarray(shift)
    scene = fit(moved)
    rounding = 1e-9 * np.abs(shift).max() / scale
    check_parameters(scene, 1e-3 + rounding, scale, shift)
    check_contract(scene, len(POINTS), atol=(1e-6 + rounding) * scale)
    np.testing.assert_array_equal(surfaces(scene), surfaces(clean))
    assert scene.noise < 0.005 * STEP * scale


def test_order_of_the_points_does_not_matter(clean):
    order = np.random.default_rng(1).permutation(len(POINTS))
    scene = fit(POINTS[order])
    np.testing.assert_array_equal(surfaces(scene), surfaces(clean)[order])
    check_parameters(scene, 1e-3)


def test_the_same_twice_is_the_same_to_the_bit(noisy):
    again = fit(NOISY, seed=3)
    np.testing.assert_array_equal(again.labels, noisy.labels)
    np.testing.assert_array_equal(again.distances, noisy.distances)
    np.testing.assert_array_equal(again.normals, noisy.normals)
    assert again.primitives and again.noise == noisy.noise
    for one, other in zip(again.primitives, noisy.primitives, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_rows_that_are_no_points_are_labelled_none(clean):
    rows = [0, 7, len(POINTS) + 2]
    bad = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, np.nan]]
    scan = np.insert(POINTS, [0, 6, len(POINTS)], bad, axis=0)
    scene = fit(scan)
    others = np.setdiff1d(np.arange(len(scan)), rows)
    assert (scene.labels[rows] == -1).all() and np.isnan(scene.distances[rows]).all()
    assert np.isnan(scene.normals[rows]).all()
    np.testing.assert_array_equal(surfaces(scene)[others], surfaces(clean))
    np.testing.assert_array_equal(scene.points, scan)
    assert scene.report["num_unusable"] == 3 and scene.report["num_points"] == len(scan)


@pytest.mark.parametrize("filter", ["auto", "on", "off"])
def test_outliers_are_labelled_none(filter):
    far = np.random.default_rng(2).uniform(-3, 3, (60, 3))
    nearest = np.array([np.linalg.norm(POINTS - point[None], axis=1).min() for point in far])
    outliers = far[nearest > 0.6][:12]
    assert len(outliers) == 12
    scene = fit(np.concatenate([NOISY, outliers]), filter=filter)
    assert (scene.labels[-12:] == -1).all()
    removed = scene.report["preprocessing"]["num_removed"]
    assert removed == 0 if filter == "off" else removed >= 12
    assert (surfaces(scene)[:-12] == TRUTH).mean() > 0.9
    check_contract(scene, len(NOISY) + 12, atol=1e-5)


def test_normals_of_any_length_and_sign_are_used():
    given = NORMALS * np.random.default_rng(4).uniform(0.5, 3, (len(POINTS), 1))
    given[::3] *= -1
    scene = fit(NOISY, given)
    assert np.mean(np.abs(np.sum(scene.normals * NORMALS, axis=1)) > 0.99) > 0.97  # the rest lies beside edges
    check_parameters(scene, 0.01)
    check_contract(scene, len(POINTS), atol=1e-5)


def test_smoothing_feeds_the_segmentation_only():
    scene = fit(POINTS, smooth=True)
    check_contract(scene, len(POINTS), atol=1e-6)
    assert scene.report["preprocessing"]["smoothed"] and scene.report["settings"]["smooth"]
    # Distances and parameters are those of the raw points; smoothing would pull the rim of the plate inwards.
    np.testing.assert_array_equal(scene.points, POINTS)
    plate = scene.primitives[np.bincount(scene.labels[TRUTH == 0]).argmax()]
    assert plate.kind == "plane" and plate.offset == pytest.approx(0, abs=1e-6)


def test_a_large_scan_is_thinned_for_the_segmentation_and_labelled_whole(clean, monkeypatch):
    monkeypatch.setattr("jprimfit.pipeline.MAX_POINTS", 1500)
    monkeypatch.setattr("jprimfit.pipeline.NUM_POINTS", 1200)
    scene = fit(POINTS)
    assert scene.report["preprocessing"]["num_output"] == 1200
    check_contract(scene, len(POINTS), atol=1e-6)
    check_parameters(scene, 1e-3)
    assert (surfaces(scene) == TRUTH).mean() > 0.98


def test_an_answer_given_back_as_labels_is_the_same_answer(noisy):
    again = fit(NOISY, labels=noisy.labels)
    np.testing.assert_array_equal(again.labels, noisy.labels)
    assert [p.kind for p in again.primitives] == [p.kind for p in noisy.primitives]
    check_contract(again, len(POINTS), 2e-6)
    check_parameters(again, 0.01)
    assert again.report["settings"]["labels"] is True and again.report["network"] is None


def test_labels_of_copies_and_of_rows_that_are_no_points():
    points = np.concatenate([POINTS, POINTS[:50], np.full((2, 3), np.nan)])
    labels = np.concatenate([TRUTH, TRUTH[:50], [0, -7]])
    scene = fit(points, labels=labels)
    np.testing.assert_array_equal(scene.labels[:-2], labels[:-2])
    assert scene.labels[-2:].tolist() == [-1, -1] and [p.kind for p in scene.primitives] == list(TRUE_KINDS)


def test_only_the_kinds_that_are_asked_for(clean):
    scene = fit(POINTS, model=None, kinds=["cylinder", "plane"])
    assert {p.kind for p in scene.primitives} == {"plane", "cylinder"}
    one = by_kind(clean)["cylinder"].radius
    assert min(abs(p.radius - one) for p in scene.primitives if p.kind == "cylinder") < 1e-4


def test_a_tolerance_and_a_least_number_of_points():
    ripples = POINTS + 0.02 * np.sin(40 * POINTS[:, :1]) * NORMALS
    scene = fit(10.0 * ripples, model=None, tolerance=0.4, min_points=200)
    assert scene.noise == pytest.approx(0.4 / 3) and scene.counts().min() >= 200
    assert scene.report["settings"]["tolerance"] == 0.4 and scene.report["settings"]["min_points"] == 200


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"kinds": ["torus"]}, "kinds is .*torus"),
        ({"kinds": []}, "kinds is"),
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"min_points": 0}, "min_points is 0"),
        ({"labels": [1, 2]}, "labels has shape"),
        ({"labels": np.full(len(POINTS), 0.5)}, "labels has shape"),
        ({"labels": np.full(len(POINTS), -1)}, "names no segment"),
        ({"labels": TRUTH, "kind_of": {9: "plane"}}, "label 9"),
        ({"labels": TRUTH, "kind_of": {0: "torus"}}, "'torus'"),
        ({"kind_of": {0: "plane"}}, "without labels"),
    ],
)
def test_wishes_that_mean_nothing_are_refused(words, message):
    with pytest.raises(ValueError, match=message):
        fit(POINTS, **words)


def test_progress_names_the_stages_in_order():
    calls = []
    fit(POINTS[TRUTH == 3], progress=lambda *call: calls.append(call))
    assert list(dict.fromkeys(stage for stage, _, _ in calls)) == ["preprocess", "network", "segment", "refine"]
    assert all(0 <= done <= total for _, done, total in calls)
    calls.clear()
    fit(POINTS[TRUTH == 3], model=None, progress=lambda *call: calls.append(call))
    assert list(dict.fromkeys(stage for stage, _, _ in calls)) == ["preprocess", "segment", "refine"]


def test_two_faces_of_one_plane_are_two_labels_and_one_surface():
    plate = POINTS[TRUTH == 0]
    scene = fit(np.concatenate([plate, plate + [[4.0, 1.0, 0.0]]]))
    assert [p.kind for p in scene.primitives] == ["plane", "plane"]
    assert scene.surface_of[0] == scene.surface_of[1]
    np.testing.assert_array_equal(np.bincount(scene.labels), [len(plate)] * 2)
    assert (scene.labels[: len(plate)] == scene.labels[0]).all() and scene.labels[0] != scene.labels[-1]


@pytest.mark.parametrize("num", [4, 6, 12])
def test_a_handful_of_points_is_answered(num):
    scene = fit(np.random.default_rng(num).normal(size=(num, 3)))
    check_contract(scene, num, atol=1e-5)


def test_what_is_no_scan_or_no_model_is_refused():
    with pytest.raises(ValueError, match="'best' is no model"):
        fit(POINTS, model="best")
    with pytest.raises(ValueError, match=r"points has shape \(5, 2\)"):
        fit(np.zeros((5, 2)))
    with pytest.raises(ValueError, match="normals has 3 rows"):
        fit(POINTS, NORMALS[:3])
    assert fit(POINTS[TRUTH == 0], model=None).primitives[0].kind == "plane"


def test_what_is_no_name_of_a_model_is_refused():
    """In a process without the type checks of the tests."""
    code = """
import jprimfit, numpy
for model in (3, True, ["default"], b"default", ""):
    try:
        jprimfit.fit(numpy.eye(5, 3), model=model)
    except ValueError as error:
        print(error)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    lines = found.stdout.splitlines()
    assert len(lines) == 5 and all("but a name or a path is expected: give default" in line for line in lines)


def test_a_model_that_is_written_anew_is_read_anew(tmp_path):
    shipped = weights.load("default")
    for name in ("before", "after"):
        weights.save(tmp_path / "weights", shipped._replace(name=name))
        assert fit(POINTS[TRUTH == 3][:40], model=tmp_path).report["network"] == name
    assert pipeline._load("default") is pipeline._load("default")


def test_copies_and_no_return_zeros_change_nothing():
    alone = fit(NOISY)
    doubled = fit(np.concatenate([NOISY, NOISY]))
    np.testing.assert_array_equal(doubled.labels, np.tile(alone.labels, 2))
    assert doubled.report["num_copies"] == len(NOISY)
    zeros = fit(np.concatenate([NOISY, np.zeros((500, 3))]))
    assert (surfaces(zeros)[: len(NOISY)] == TRUTH).mean() > 0.9


def test_many_copies_and_three_points_end():
    points = np.concatenate([np.zeros((300, 3)), np.eye(3)])
    assert fit(points).labels.shape == (303,)
