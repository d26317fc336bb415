import numpy as np
import pytest
from PIL import Image, ImageDraw

from jprimfit.io import palette, report

NOTHING = (np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))


@pytest.fixture(autouse=True)
def coarse(request, monkeypatch):
    """A quarter of the pixels, but for the test of the real picture."""
    if "panels" not in request.node.name:
        monkeypatch.setattr(report, "FACTOR", 1)


def sphere(center, n=2_000, seed=0):
    """Points, and a patch of their hull's triangles."""
    from scipy.spatial import ConvexHull

    normals = np.random.default_rng(seed).normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + center, (normals + center, ConvexHull(normals).simplices.astype(np.int32), normals)


def scene(num=3):
    parts = [sphere(np.array([2.5 * i, 0.0, 0.0]), seed=i) for i in range(num)]
    points = np.concatenate([points for points, _ in parts])
    return points, np.repeat(np.arange(num), 2_000), ["sphere"] * num, [patch for _, patch in parts]


def panels(path):
    with Image.open(path) as file:
        page = np.asarray(file.convert("RGB")).astype(int)
    rows, columns = report.PANEL
    lefts = [report.GAP + i * (columns + report.GAP) for i in range(3)]
    return page, [page[report.TOP : report.TOP + rows, left : left + columns] for left in lefts]


def share_of_hue(panel, color):
    """How many pixels have the hue of a colour, whatever the light."""
    color, pixels = color - color.mean(), panel - panel.mean(axis=2, keepdims=True)
    size = np.linalg.norm(pixels, axis=2)
    return np.mean((pixels @ color > 0.97 * size * np.linalg.norm(color)) & (size > 25))


def test_the_panels_show_the_scan_the_segments_and_the_surfaces(tmp_path):
    points, labels, kinds, patches = scene()
    path = tmp_path / "report.png"
    report.write_report(path, points, labels, kinds, patches, title="three balls")
    assert path.stat().st_size < report.MAX_BYTES
    assert [file.name for file in tmp_path.iterdir()] == ["report.png"]
    page, (scan, segments, surfaces) = panels(path)
    assert page.shape[1] == report.WIDTH and page.shape[0] > report.TOP + report.PANEL[0]
    for color in palette.colors(3).astype(float):
        assert share_of_hue(scan, color) < 0.001
        assert share_of_hue(segments, color) > 0.02
        assert share_of_hue(surfaces, color) > 0.02
    covered = [
        np.abs(panel - np.round(255 * report.PANEL_COLOR)).max(axis=2) > 3 for panel in (scan, segments, surfaces)
    ]
    # The three panels share one camera: points cover most of the surfaces and nothing else.
    assert np.mean(covered[0] != covered[1]) < 0.01
    assert np.mean(covered[0] & ~covered[2]) < 0.02 and covered[0].sum() > 0.5 * covered[2].sum()
    assert covered[0].any(axis=0).mean() > 0.85


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    arguments = scene(2)
    for name in ("a.png", "b.png"):
        report.write_report(tmp_path / name, *arguments)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_unassigned_points_are_grey_and_a_patch_may_be_empty(tmp_path):
    points, labels, kinds, patches = scene(2)
    report.write_report(tmp_path / "a.png", points, np.where(labels == 1, -1, 0), kinds, [patches[0], NOTHING])
    _, (_, segments, surfaces) = panels(tmp_path / "a.png")
    first, second = palette.colors(2).astype(float)
    assert share_of_hue(segments, first) > 0.05 and share_of_hue(segments, second) < 0.001
    assert share_of_hue(surfaces, first) > 0.05 and share_of_hue(surfaces, second) < 0.001


@pytest.mark.parametrize("num_points", [1, 2, 12])
def test_tiny_and_degenerate_clouds_give_a_picture(tmp_path, num_points):
    for points in (np.zeros((num_points, 3)), np.arange(num_points)[:, None] * np.array([[1e6, 1.0, 0.0]])):
        points = np.concatenate([points, [[np.nan, 0, 0]]])
        report.write_report(tmp_path / "a.png", points, np.full(num_points + 1, -1), [], [])
        page, _ = panels(tmp_path / "a.png")
        assert page.shape[1] == report.WIDTH


def test_many_primitives_are_listed_up_to_twenty():
    counts = np.arange(30)
    assert report._listed(counts) == list(range(10, 30))
    assert report._listed(np.array([5, 0, 7])) == [0, 1, 2]
    assert report._listed(np.zeros(0, int)) == []


def test_many_primitives_fit_on_the_page(tmp_path):
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 45, 3_000)
    kinds = ["plane", "cylinder", "cone"] * 15
    report.write_report(tmp_path / "a.png", rng.normal(size=(3_000, 3)), labels, kinds, [NOTHING] * 45)
    page, _ = panels(tmp_path / "a.png")
    assert page.shape[0] < 900
    # Nothing is cut off: the last rows and columns are paper.
    assert np.all(page[-6:] == 255) and np.all(page[:, -6:] == 255)


def test_what_does_not_fit_together_is_refused_and_nothing_is_written(tmp_path):
    points, labels, kinds, patches = scene(2)
    wrong = [
        ((points, labels, kinds[:1], patches[:1]), "one label per point"),
        ((points, labels, kinds, patches[:1]), "one patch per primitive"),
        ((points * np.nan, labels, kinds, patches), "finite"),
        ((points[:0], labels[:0], kinds, patches), "at least one"),
    ]
    for arguments, message in wrong:
        with pytest.raises(ValueError, match=message):
            report.write_report(tmp_path / "a.png", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_at_most_twelve_numbers_are_drawn_those_of_the_largest_surfaces(monkeypatch):
    shown = np.repeat(np.arange(15)[None], 60, axis=0).repeat(20 + 2 * np.arange(15), axis=1)
    draw, drawn = ImageDraw.Draw(Image.new("RGB", (8, 8))), []
    monkeypatch.setattr(draw, "text", lambda place, text, *_, **__: drawn.append((int(text), place)))
    report._write_numbers(draw, shown, list(range(15)), left=0)
    assert sorted(number for number, _ in drawn) == list(range(3, 15))
    assert all(shown[y - report.TOP, x] == number for number, (x, y) in drawn)
