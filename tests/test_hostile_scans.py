"""Whatever is given to fit, it answers with a scene that keeps its contract, or refuses in one sentence."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jprimfit.pipeline import fit
from jprimfit.primitives.table import KINDS

COUNTS = (1, 3, 7, 60, 200)  # few shapes: every other one compiles
ODD = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e-8, 1e8, 1e101, 1e308, np.inf, -np.inf, np.nan)


@st.composite
def scans(draw, count):
    """Points of a scan, of any scale and position: noise, surfaces, grids, copies, lines; odd values strewn in."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    flat, ball = rng.uniform(-1, 1, (count, 3)), rng.normal(size=(count, 3))
    points = {
        "noise": ball,
        "plane": flat * [1, 1, 0],
        "sphere": ball / np.linalg.norm(ball, axis=1, keepdims=True),
        "cylinder": np.stack([np.cos(3 * flat[:, 0]), np.sin(3 * flat[:, 0]), flat[:, 1]], axis=1),
        "grid": rng.integers(-3, 4, (count, 3)).astype(float),
        "copies": flat[rng.integers(0, min(5, count), count)],
        "line": flat[:, :1] * np.ones(3),
        "two far apart": flat + 1e6 * rng.integers(0, 2, (count, 1)),
    }[draw(st.sampled_from(["noise", "plane", "sphere", "cylinder", "grid", "copies", "line", "two far apart"]))]
    points = points * 10.0 ** draw(st.sampled_from([0, 0, 0, -9, -200, 7, 90]))
    points = points + draw(st.sampled_from([0.0, 0.0, 1e6]))
    if draw(st.sampled_from([False, False, True])):
        points.flat[rng.integers(0, points.size, 3)] = draw(st.sampled_from(ODD))
    with np.errstate(over="ignore"):
        return points.astype(draw(st.sampled_from([np.float64, np.float64, np.float32])))


@st.composite
def calls(draw):
    """Arguments of fit, most of them of shapes that fit together."""
    count = draw(st.sampled_from(COUNTS))
    other = draw(st.sampled_from([count, count, count, count, 5]))
    words = {"model": draw(st.sampled_from([None, None, "default"]))}
    if draw(st.sampled_from([False, False, True])):
        words["normals"] = draw(scans(other))
    if draw(st.sampled_from([False, False, False, True])):
        words["labels"] = np.random.default_rng(other).integers(-1, draw(st.sampled_from([1, 3, 2**31])), other)
    if draw(st.sampled_from([False, False, False, True])):
        words["kinds"] = tuple(draw(st.lists(st.sampled_from([*KINDS, "torus"]), max_size=4)))
    if draw(st.sampled_from([False, False, False, True])):
        words["tolerance"] = draw(st.sampled_from([0.0, 1e-9, 0.1, 10.0, -1.0, np.nan]))
    if draw(st.sampled_from([False, False, False, True])):
        words["min_points"] = draw(st.sampled_from([0, 1, 50, 10**9]))
    words["filter"] = draw(st.sampled_from(["auto", "on", "off"]))
    words["smooth"] = draw(st.sampled_from([False, False, True]))
    return draw(scans(count)), words


def answered(call):
    points, words = call
    try:
        scene = fit(points, **words)
    except ValueError as error:
        assert str(error).endswith(".") and "\n" not in str(error)
        return
    num = len(scene.primitives)
    assert scene.labels.shape == scene.distances.shape == (len(points),) and scene.normals.shape == points.shape
    assert scene.labels.min() >= -1 and scene.labels.max() < num and len(scene.surface_of) == num
    assert all(np.all(np.isfinite(field)) for primitive in scene.primitives for field in primitive)
    assert np.array_equal(np.isfinite(scene.distances), scene.labels >= 0)
    assert np.isfinite(scene.noise) and scene.noise >= 0
    assert len(scene.features) == num


@settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(calls())
def test_hostile_scans_are_answered_or_refused(call):
    answered(call)


@pytest.mark.slow
@settings(max_examples=500, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(calls())
def test_five_hundred_hostile_scans(call):
    answered(call)
