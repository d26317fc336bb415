"""The picture of an answer (report.png): the scan, its segments, the fitted surfaces, and a list of the primitives.

Drawn without a display or GPU: jprimfit.io.raster for the scene, pillow for text. The three panels share one camera.
Surfaces arrive as plain arrays (vertices, faces, normals), so that this file knows no CAD. Letters: n points, p
primitives.
"""

import io
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage
from scipy.spatial import KDTree

from jprimfit.geometry import host
from jprimfit.io import palette, raster, viewpoint
from jprimfit.io.files import replacing

WIDTH = 1800
PANEL = (520, 580)  # rows, columns
GAP = (WIDTH - 3 * PANEL[1]) // 4
TOP = 118
FACTOR = 2  # pixels per side that are averaged into one
MAX_ROWS, COLUMNS, ROW_HEIGHT = 20, 5, 27
MAX_BYTES = 1_000_000
MAX_NUMBERS = 12
MIN_DEPTH = 9  # pixels around the middle of a number that its surface must fill
NUM_SHADED = 20_000  # points whose normals are estimated; the others take the nearest one's
INK, FAINT, PAPER = (32, 36, 42), (112, 118, 126), (255, 255, 255)
PANEL_COLOR = np.array([244, 246, 248]) / 255
SCAN_COLOR = np.array([176, 186, 198]) / 255


def write_report(
    path: str | os.PathLike[str],
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, "n"],
    kinds: Sequence[str],
    patches: Sequence[Any],
    *,
    title: str | None = None,
) -> None:
    """Writes the picture as PNG, 1800 pixels wide, at most 1 MB, whole or not at all.

    Args:
        path: of the file.
        points: of the scan; rows with non-finite coordinates are left out.
        labels: index into kinds, or -1 = explained by none.
        kinds: of the p primitives.
        patches: of the p primitives: (vertices (v, 3), faces (f, 3), normals (v, 3)), possibly empty.
        title: headline; default "Fitted primitives".

    Raises:
        ValueError: no finite point, or numbers of points, labels, kinds and patches that do not fit together.
    """
    points, labels = _checked(points, labels, kinds, patches)
    sample = slice(None, None, -(-len(points) // viewpoint.MAX_POINTS))
    direction = viewpoint.choose(points[sample], labels[sample])
    shape = (PANEL[0] * FACTOR, PANEL[1] * FACTOR)
    view = raster.camera(_framed(points, patches), back=direction.back, up=direction.up, shape=shape)
    scan, segments = _point_panels(view, points, labels)
    surfaces, shown = _surface_panel(view, patches)
    counts = np.bincount(labels[labels >= 0], minlength=len(kinds))
    listed = _listed(counts)
    num_rows = -(-(len(listed) + 2) // COLUMNS)
    page = Image.new("RGB", (WIDTH, TOP + PANEL[0] + 34 + num_rows * ROW_HEIGHT + 18), PAPER)
    draw = ImageDraw.Draw(page)
    draw.text((GAP, 22), title or "Fitted primitives", INK, _font(34))
    captions = (f"Scan: {_number(len(points), 'point')}", f"Segments: {_number(len(kinds), 'primitive')}")
    for i, (panel, caption) in enumerate(zip((scan, segments, surfaces), (*captions, "Fitted surfaces"), strict=True)):
        left = GAP + i * (PANEL[1] + GAP)
        page.paste(Image.fromarray(panel), (left, TOP))
        draw.text((left, TOP - 34), caption, INK, _font(22))
    _write_numbers(draw, shown, listed, left=WIDTH - GAP - PANEL[1])
    _write_legend(draw, kinds, counts, listed, num_points=len(points), top=TOP + PANEL[0] + 22)
    content = _png(page)
    with replacing(path) as file:
        file.write(content)


def _checked(
    points: np.ndarray, labels: np.ndarray, kinds: Sequence[str], patches: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Points in float64 about the middle of their box, and labels, without non-finite rows."""
    points, labels = np.asarray(points, np.float64), np.asarray(labels, np.int64)
    if len(labels) != len(points) or len(kinds) != len(patches) or labels.max(initial=-1) >= len(kinds):
        raise ValueError(
            f"The report got {len(points)} points with {len(labels)} labels up to {labels.max(initial=-1)} and "
            f"{len(kinds)} kinds with {len(patches)} patches: give one label per point and one patch per primitive."
        )
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise ValueError("The report got no point with finite coordinates: give at least one.")
    return points[finite], np.maximum(labels[finite], -1)


def _framed(points: np.ndarray, patches: Sequence[Any]) -> np.ndarray:
    """What must be in the picture: the patches; and the points, less a stray few so that outliers do not shrink it."""
    step = -(-len(points) // 20_000)
    sample = points[::step]
    if len(sample) > 1_000:
        low, high = np.quantile(sample, (0.002, 0.998), axis=0)
        room = 0.05 * (high - low)
        sample = sample[((sample >= low - room) & (sample <= high + room)).all(axis=1)]
    return np.concatenate([sample, *(np.asarray(patch[0]).reshape(-1, 3) for patch in patches)])


def _scan_normals(points: np.ndarray) -> np.ndarray:
    """Normals of either sign from a thinned copy: coarse enough to look through the noise of a dense scan."""
    thin = points[:: -(-len(points) // NUM_SHADED)]
    normals = host.pca_normals(thin, k=min(24, len(thin))).normal
    return normals if len(thin) == len(points) else normals[KDTree(thin).query(points, workers=-1)[1]]


def _point_panels(view: raster.Camera, points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The scan in one colour, and the same points in the colours of their segments."""
    spread = _spread(points)
    pixels = view.zoom * spread / (raster.EYE_DISTANCE * view.radius)
    # Discs of that radius leave 1 % of a surface uncovered; a sparse scan is shown as dots.
    radius = float(np.clip(1.2 * pixels, 0.9 * FACTOR, 4.0 * FACTOR))
    seen = raster.splat(view, raster.project(view, points), radius=radius, cover=2.6 * spread)
    item = seen.item[seen.item >= 0]
    normals = _scan_normals(points)[item]
    facing = normals * np.where(normals @ view.rotation[2] < 0, -1.0, 1.0)[:, None]
    lit = raster.light(view, seen, raster.smooth_normals(seen, facing, sigma=1.5 * FACTOR))
    scan = raster.paint(seen, lit, np.broadcast_to(SCAN_COLOR, facing.shape), PANEL_COLOR, factor=FACTOR)
    colors = palette.colors_of_labels(labels)[item] / 255
    return scan, raster.paint(seen, lit, colors, PANEL_COLOR, factor=FACTOR)


def _spread(points: np.ndarray) -> float:
    """1 / sqrt(points per area) of the scanned surface, from the median distance to the 8th neighbour."""
    k = min(8, len(points) - 1)
    if k < 1:
        return 0.0
    found: Any = KDTree(points).query(points[:: -(-len(points) // 4_000)], k=k + 1)
    return float(np.median(found[0][:, k]) * np.sqrt(np.pi / (k - 1 / 3)))


def _surface_panel(view: raster.Camera, patches: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """All patches in their colours; and which of them each pixel of the finished panel shows, -1 for none."""
    arrays = [tuple(np.asarray(part).reshape(-1, 3) for part in patch[:3]) for patch in patches]
    offset = np.cumsum([0] + [len(vertices) for vertices, _, _ in arrays])
    vertices = np.concatenate([np.zeros((0, 3)), *(a[0] for a in arrays)])
    faces = np.concatenate(
        [np.zeros((0, 3), np.int64), *(a[1] + shift for a, shift in zip(arrays, offset, strict=False))]
    )
    normals = np.concatenate([np.zeros((0, 3)), *(a[2] for a in arrays)])
    owner = np.repeat(np.arange(len(arrays)), [len(a[1]) for a in arrays])
    screen = raster.project(view, vertices)
    seen = raster.rasterize(view, screen, faces)
    colors = palette.colors(len(arrays))[owner[seen.item[seen.item >= 0]]] / 255
    lit = raster.light(view, seen, raster.interpolate(screen, faces, normals, seen))
    middle = seen.item[FACTOR // 2 :: FACTOR, FACTOR // 2 :: FACTOR]
    shown = np.where(middle >= 0, owner[middle] if len(owner) else -1, -1)
    return raster.paint(seen, lit, colors, PANEL_COLOR, factor=FACTOR), shown


def _listed(counts: np.ndarray) -> list[int]:
    """The primitives of the legend in order of their numbers: all, or the 20 with the most points."""
    return sorted(np.argsort(-counts, kind="stable")[:MAX_ROWS].tolist())


def _write_numbers(draw: ImageDraw.ImageDraw, shown: np.ndarray, listed: list[int], *, left: int) -> None:
    """The number of each listed primitive on its surface, for the largest of those that are seen well enough."""
    font, places = _font(17), []
    for i in listed:
        # Where a surface is widest: the pixel farthest from everything else, found at half the resolution.
        depth: Any = ndimage.distance_transform_edt(np.pad(shown[::2, ::2] == i, 1))
        y, x = np.unravel_index(int(np.argmax(depth)), depth.shape)
        if depth[y, x] >= MIN_DEPTH / 2:
            places.append((np.count_nonzero(depth), i, (left + 2 * int(x - 1), TOP + 2 * int(y - 1))))
    for _, i, place in sorted(places, reverse=True)[:MAX_NUMBERS]:
        draw.text(place, str(i), INK, font, anchor="mm", stroke_width=3, stroke_fill=PAPER)


def _write_legend(
    draw: ImageDraw.ImageDraw, kinds: Sequence[str], counts: np.ndarray, listed: list[int], *, num_points: int, top: int
) -> None:
    """Swatch, number, kind and point count of each listed primitive; then what is not listed and not explained."""
    colors = palette.colors(len(kinds))
    entries = [(tuple(colors[i].tolist()), str(i), kinds[i], f"{counts[i]:,}") for i in listed]
    if len(kinds) > len(listed):
        rest = counts.sum() - counts[listed].sum()
        entries.append((PAPER, "", f"and {len(kinds) - len(listed)} more", f"{rest:,}"))
    entries.append((palette.GREY, "", "unassigned", f"{num_points - counts.sum():,}"))
    num_rows, width, font = -(-len(entries) // COLUMNS), (WIDTH - 2 * GAP) // COLUMNS, _font(18)
    for place, (color, number, kind, count) in enumerate(entries):
        x, y = GAP + place // num_rows * width, top + place % num_rows * ROW_HEIGHT
        draw.rounded_rectangle((x, y, x + 18, y + 18), 4, color)
        draw.text((x + 52, y + 9), number, FAINT, font, anchor="rm")
        draw.text((x + 64, y + 9), kind, INK, font, anchor="lm")
        draw.text((x + width - 70, y + 9), count, FAINT, font, anchor="rm")


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'s' if count != 1 else ''}"


def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def _png(page: Image.Image) -> bytes:
    """Compressed; with 256 colours where all of them would take more than a megabyte."""
    content = io.BytesIO()
    page.save(content, "PNG", compress_level=5)
    if content.tell() > MAX_BYTES:
        content = io.BytesIO()
        page.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(content, "PNG")
    return content.getvalue()
