"""Draws docs/images/preprocessing.png: a synthetic scan after each step of preprocessing, like the paper's Figure 3.

python scripts/preprocessing_figure.py [--out docs/images/preprocessing.png]
"""

import argparse
import io
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from jprimfit.preprocessing.downsampling import downsample
from jprimfit.preprocessing.outliers import find_outliers
from jprimfit.preprocessing.smoothing import gaussian_smooth

NUM_POINTS = 24_000
NUM_OUTLIERS = 700
NOISE = 0.012  # standard deviation; the block is 2 long


def part(rng: np.random.Generator) -> np.ndarray:
    """Uniform points on a 2 x 1.4 x 0.4 block with a round boss on top, its dome a half sphere."""
    length, width, height, radius, rise = 2.0, 1.4, 0.4, 0.4, 0.3
    areas = np.array(
        [2 * length * width, 2 * length * height, 2 * width * height, 2 * np.pi * radius * rise, 2 * np.pi * radius**2]
    )
    counts = rng.multinomial(NUM_POINTS, areas / areas.sum())
    pieces = []
    for count, axis in zip(counts[:3], (2, 1, 0), strict=True):
        face = rng.uniform(-1, 1, (count, 3))
        face[:, axis] = np.sign(face[:, axis])
        pieces.append(face * [length / 2, width / 2, height / 2])
    block = np.concatenate(pieces)
    under_boss = (block[:, 2] == height / 2) & (np.hypot(block[:, 0], block[:, 1]) < radius)
    turn = rng.uniform(0, 2 * np.pi, counts[3])
    wall = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height / 2 + rng.uniform(0, rise, counts[3])])
    dome = rng.normal(size=(counts[4], 3))
    dome *= radius / np.sqrt((dome**2).sum(axis=1, keepdims=True))
    dome[:, 2] = np.abs(dome[:, 2]) + height / 2 + rise
    return np.concatenate([block[~under_boss], wall, dome])


def draw(stages: list[tuple[str, np.ndarray, np.ndarray]]) -> Image.Image:
    """One column per (title, points, is outlier): the cloud above, a thin section of it below."""
    figure = plt.figure(figsize=(12, 5.4), dpi=100)
    for column, (title, points, is_outlier) in enumerate(stages, start=1):
        color = np.where(is_outlier[:, None], [[0.85, 0.1, 0.1]], [[0.15, 0.35, 0.6]])
        size = np.where(is_outlier, 2.0, 1.2 if len(points) < 10_000 else 0.35)
        view = figure.add_subplot(2, len(stages), column, projection="3d", computed_zorder=False)
        view.scatter(*points.T, s=size, c=color, linewidths=0, depthshade=False)
        view.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.5, 1.0), box_aspect=(1.8, 1.8, 1.5))
        view.view_init(28, -60)
        view.set_axis_off()
        view.set_title(title, fontsize=10)
        thin = np.abs(points[:, 1]) < 0.03
        section = figure.add_subplot(2, len(stages), len(stages) + column)
        section.scatter(points[thin, 0], points[thin, 2], s=5 * size[thin] ** 0.5, c=color[thin], linewidths=0)
        section.set(xlim=(-1.15, 1.15), ylim=(-0.4, 1.05), aspect="equal")
        section.set_axis_off()
    figure.text(0.5, 0.03, "below: the section |y| < 0.03", ha="center", fontsize=9)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.05, top=0.93, wspace=0.02, hspace=0.0)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    return Image.open(buffer).convert("RGB").quantize(64)


def main() -> None:
    """Makes the scan, runs the steps one after another and draws what each leaves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/preprocessing.png"))
    out = parser.parse_args().out
    rng = np.random.default_rng(0)
    clean = part(rng)
    stray = rng.uniform(clean.min(axis=0) - 0.1, clean.max(axis=0) + 0.1, (NUM_OUTLIERS, 3))
    scan = np.concatenate([clean + NOISE * rng.normal(size=clean.shape), stray])
    is_outlier = np.arange(len(scan)) >= len(clean)
    keep = find_outliers(scan).keep
    smooth = gaussian_smooth(scan[keep])
    rows = downsample(smooth.astype(np.float32))
    stages = [
        (f"scan: {len(scan):,} points, {NUM_OUTLIERS} outliers (red)", scan, is_outlier),
        (f"filtered: {keep.sum():,} points", scan[keep], is_outlier[keep]),
        ("smoothed", smooth, is_outlier[keep]),
        (f"down-sampled: {len(rows):,} points", smooth[rows], is_outlier[keep][rows]),
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(stages).save(out, optimize=True)
    removed = ~keep
    print(f"{out}: {out.stat().st_size // 1024} kB")
    print(f"outliers removed: {removed[is_outlier].sum()} of {NUM_OUTLIERS}; others: {removed[~is_outlier].sum()}")


if __name__ == "__main__":
    main()
