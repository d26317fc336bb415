"""Draws docs/images/segmentation.png: the steps of the segmentation without a network, on the bundled scan.

python scripts/segmentation_figure.py [--out docs/images/segmentation.png]
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jprimfit.fitting import growing, local, merging, refinement
from jprimfit.geometry import host
from jprimfit.io import palette, raster, viewpoint
from jprimfit.io.clouds import read_cloud

SCAN = Path(__file__).resolve().parent.parent / "jprimfit" / "assets" / "demo.ply"
PANEL = (360, 440)  # rows, columns
TOP = 34
PAPER, INK = (255, 255, 255), (32, 36, 42)
SMOOTH, EDGE = np.array([176, 186, 198]), np.array([200, 40, 40])


def draw(points: np.ndarray, normals: np.ndarray, panels: list[tuple[str, np.ndarray]]) -> Image.Image:
    """One column per (title, colours (n, 3) of 0-255), all from one viewpoint."""
    sample = slice(None, None, 2)
    direction = viewpoint.choose(points[sample], np.full(len(points[sample]), -1))
    shape = (2 * PANEL[0], 2 * PANEL[1])
    view = raster.camera(points, back=direction.back, up=direction.up, shape=shape)
    spread = float(np.median(np.sqrt(host.knn(points, points, k=4).sq_distance[:, 3])))
    seen = raster.splat(view, raster.project(view, points), radius=6.0, cover=3.0 * spread)
    item = seen.item[seen.item >= 0]
    facing = normals[item] * np.where(normals[item] @ view.rotation[2] < 0, -1.0, 1.0)[:, None]
    lit = raster.light(view, seen, raster.smooth_normals(seen, facing, sigma=3.0))
    page = Image.new("RGB", (len(panels) * PANEL[1], TOP + PANEL[0]), PAPER)
    write = ImageDraw.Draw(page)
    for column, (title, colors) in enumerate(panels):
        image = raster.paint(seen, lit, colors[item] / 255, np.ones(3), factor=2)
        page.paste(Image.fromarray(image), (column * PANEL[1], TOP))
        write.text((column * PANEL[1] + 12, 8), title, INK, ImageFont.load_default(size=17))
    return page


def main() -> None:
    """Runs the steps one after another and draws what each says of every point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/segmentation.png"))
    out = parser.parse_args().out
    points = host.normalize(read_cloud(SCAN).points)[0].astype(np.float64)
    described = local.describe(points)
    regions = growing.grow_regions(points, described)
    surfaces = merging.merge_regions(points, described.normal, regions, tolerance=growing.tolerance(described))
    labels = np.full(len(points), -1, np.int32)
    for number, surface in enumerate(surfaces):
        labels[surface.rows] = number
    found = refinement.refine(points, surfaces, labels)
    claims = np.bincount(np.concatenate([region.rows for region in regions]), minlength=len(points))
    in_one = np.where(claims == 1, labels, -1)
    core = described.core
    panels = [
        (f"smooth points; beside edges, red: {100 * np.mean(~core):.0f} %", np.where(core[:, None], SMOOTH, EDGE)),
        (f"{len(regions)} regions; grey: claimed by several or none", palette.colors_of_labels(in_one)),
        (f"{len(found.primitives)} faces on {len(surfaces)} surfaces", palette.colors_of_labels(found.labels)),
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(points, described.normal, panels).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
