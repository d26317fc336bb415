"""The table of parameters: bounds against closed forms, patches even by area, rows that say what was drawn."""

import numpy as np
import pytest

from jprimfit.evaluation import bounds, parameters, patches


@pytest.mark.parametrize("patch", patches.WHOLE + patches.PARTIAL + patches.QUARTERS, ids=lambda patch: patch.name)
def test_points_lie_on_the_surface_and_inside_the_patch(patch):
    points = patch.draw(np.random.default_rng(0), 2000)
    a0, a1, b0, b1 = patch.edges
    if patch.truth.kind == "plane":
        np.testing.assert_allclose(points[:, 0], 1.0)
        height, turn = points[:, 1], points[:, 2]
    else:
        radius = np.hypot(points[:, 0], points[:, 1])
        reach = {"sphere": np.linalg.norm(points, axis=1) / 6, "cylinder": radius / 6, "cone": radius / points[:, 2]}
        np.testing.assert_allclose(reach[patch.truth.kind], 1.0, rtol=1e-9)
        height = points[:, 2] / (6.0 if patch.truth.kind == "sphere" else 1.0)
        turn = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    assert height.min() >= a0 - 1e-9 and height.max() <= a1 + 1e-9
    assert turn.min() >= b0 - 1e-9 and turn.max() <= b1 + 1e-9


def test_the_conditional_bound_of_a_plane_and_a_sphere_is_the_closed_form():
    # Plane of half-extent 1: variances sigma^2 / n of the offset, 3 sigma^2 / n of each tilt. Sphere: sigma^2 / n of
    # the radius, 3 sigma^2 / n of each coordinate of the center.
    sigma, count = 0.1, 1000
    plane = np.diag(bounds.conditional(patches.WHOLE[0], sigma, count)) / (sigma**2 / count)
    np.testing.assert_allclose(plane, [3, 3, 1], rtol=0.05)
    sphere = np.diag(bounds.conditional(patches.WHOLE[1], sigma, count)) / (sigma**2 / count)
    np.testing.assert_allclose(sphere, [3, 3, 3, 1], rtol=0.05)
    expected = np.sqrt(2 / np.pi) * sigma / np.sqrt(count) * (3 * np.sqrt(3) + 1)
    covariance = bounds.conditional(patches.WHOLE[1], sigma, count)
    assert bounds.mean_absolute_error(patches.WHOLE[1], covariance) == pytest.approx(expected, rel=0.05)


def test_a_known_density_tells_little_of_a_plane_and_much_of_a_cone():
    plane = [bound(patches.WHOLE[0], 0.1, 1000)[2, 2] for bound in (bounds.conditional, bounds.full_density)]
    assert plane[1] == pytest.approx(plane[0], rel=0.1)
    cone = patches.WHOLE[3]
    known, unknown = bounds.full_density(cone, 0.9, 1000), bounds.conditional(cone, 0.9, 1000)
    assert bounds.mean_absolute_error(cone, known) < 0.85 * bounds.mean_absolute_error(cone, unknown)
    assert bounds.full_density(cone, 0.01, 1000) is None


def test_cells_are_run_and_told():
    chosen = [
        parameters.Cell("whole", patches.WHOLE[0], 0.0, 300),
        parameters.Cell("few points", patches.WHOLE[1], 0.05, 300),
        parameters.Cell("few points", patches.WHOLE[1], 0.05, 300, 0.05),
    ]
    finished = []
    rows = parameters.run(chosen, 12, workers=1, progress=finished.append)
    assert sum(finished) == 10 + 12 + 12
    assert [row["num_datasets"] for row in rows] == [10, 12, 12] and all(row["ok"] == 1 for row in rows)
    assert rows[0]["mean"] < 1e-9
    assert 0.4 < rows[1]["ratio"] < 2 and rows[1]["sigma_found"] == pytest.approx(1, abs=0.1)
    table = parameters.text(rows)
    assert "whole surfaces" in table and "300 + 5 %" in table and "coverage" not in table


def test_every_block_has_its_cells():
    blocks = [cell.block for cell in parameters.cells()]
    assert {block: blocks.count(block) for block in parameters.TITLES} == {
        "whole": 16,
        "part": 12,
        "few points": 16,
        "coverage": 32,
    }
