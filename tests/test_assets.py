"""The shipped scan agrees with the truth that is shipped beside it."""

import json
from pathlib import Path

import numpy as np
import pytest

ASSETS = Path(__file__).resolve().parent.parent / "jprimfit" / "assets"
TRUTH = json.loads((ASSETS / "demo_truth.json").read_text(encoding="utf-8"))


def read_points():
    header, body = (ASSETS / "demo.ply").read_bytes().split(b"end_header\n", 1)
    assert b"format binary_little_endian 1.0" in header
    return np.frombuffer(body, "<f4").reshape(-1, 3).astype(float)


def signed_distance(surface, points):
    if surface["kind"] == "plane":
        return points @ np.array(surface["normal"]) - surface["offset"]
    if surface["kind"] == "sphere":
        return np.linalg.norm(points - surface["center"], axis=1) - surface["radius"]
    rays = points - surface["center" if surface["kind"] == "cylinder" else "apex"]
    height = rays @ np.array(surface["axis"])
    radius = np.linalg.norm(rays - height[:, None] * np.array(surface["axis"]), axis=1)
    if surface["kind"] == "cylinder":
        return radius - surface["radius"]
    return radius * np.cos(surface["half_angle"]) - height * np.sin(surface["half_angle"])


@pytest.fixture(scope="module")
def nearest():
    """The nearest true surface of each point, and the signed distance to it."""
    points = read_points()
    distances = np.stack([signed_distance(surface, points) for surface in TRUTH["primitives"]], axis=1)
    labels = np.abs(distances).argmin(axis=1)
    return labels, distances[np.arange(len(points)), labels]


def test_scan_is_small_enough_to_ship():
    assert (ASSETS / "demo.ply").stat().st_size <= 400_000
    assert 20_000 <= len(read_points()) <= 25_000


def test_every_kind_is_there_and_large_enough_to_be_seen():
    assert {surface["kind"] for surface in TRUTH["primitives"]} == {"plane", "sphere", "cylinder", "cone"}
    assert min(surface["num_points"] for surface in TRUTH["primitives"]) >= 150


def test_points_lie_on_the_true_surfaces_but_for_the_noise(nearest):
    labels, distances = nearest
    # Where two surfaces meet the nearer one is taken, hence slightly less than the noise.
    assert 0.95 * TRUTH["noise"] < np.sqrt(np.mean(distances**2)) < 1.01 * TRUTH["noise"]
    for index, surface in enumerate(TRUTH["primitives"]):
        own = distances[labels == index]
        assert abs(len(own) - surface["num_points"]) < 0.06 * surface["num_points"] + 5
        assert abs(own.mean()) < 5 * TRUTH["noise"] / np.sqrt(len(own))


def test_directions_are_unit_and_in_the_gauge():
    for surface in TRUTH["primitives"]:
        for name in {"normal", "axis"} & set(surface):
            direction = np.array(surface[name])
            assert abs(np.linalg.norm(direction) - 1) < 1e-8
            assert surface["kind"] == "cone" or direction[np.abs(direction).argmax()] > 0
