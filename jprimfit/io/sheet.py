"""A contact sheet (PNG) of labelled triangulations: each part twice, coloured by instance and by kind.

Drawn as the report is, by jprimfit.io.raster without a display; parts arrive as plain arrays, so that this file knows
no data set. All parts are seen from the same direction, z up. Letters: v vertices, f faces.
"""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont

from jprimfit.io import palette, raster
from jprimfit.io.files import replacing

PANEL = 150  # pixels, rows and columns
COLUMNS = 5  # parts in a row of the sheet
GAP, CAPTION, TOP = 12, 20, 44
FACTOR = 2  # pixels per side that are averaged into one
BACK, UP = np.array([0.62, -1.0, 0.72]), np.array([0.0, 0.0, 1.0])
INK, FAINT, PAPER = (32, 36, 42), (112, 118, 126), (255, 255, 255)
PANEL_COLOR = np.array([244, 246, 248]) / 255


class Cell(NamedTuple):
    """A part of the sheet."""

    caption: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    labels: Int[np.ndarray, "f"]  # instance of each face, -1 for none
    kinds: Int[np.ndarray, "i"]  # position of each instance's kind in the names given to write_sheet


def write_sheet(path: str | os.PathLike[str], cells: Sequence[Cell], *, kinds: Sequence[str], title: str) -> None:
    """Writes the sheet, whole or not at all: instances in the left picture of a part, kinds in the right one.

    ValueError where there is no cell.
    """
    if not cells:
        raise ValueError(f"{path} was not written: there is no part to show.")
    columns = min(COLUMNS, len(cells))
    width, height = 2 * PANEL + GAP, PANEL + CAPTION + GAP
    rows = -(-len(cells) // columns)
    page = Image.new("RGB", (GAP + columns * width, TOP + rows * height), PAPER)
    draw = ImageDraw.Draw(page)
    _write_head(draw, title, kinds, right=page.width - GAP)
    for place, cell in enumerate(cells):
        left, top = GAP + place % columns * width, TOP + place // columns * height
        for shift, picture in zip((0, PANEL), _pictures(cell, len(kinds)), strict=True):
            page.paste(Image.fromarray(picture), (left + shift, top + CAPTION))
        draw.text((left, top + 2), cell.caption, INK, ImageFont.load_default(size=13))
    with replacing(path) as file:
        page.save(file, "PNG", optimize=True)


def _pictures(cell: Cell, num_kinds: int) -> list[np.ndarray]:
    """The part by instance and by kind, with one rasterisation for both."""
    vertices = np.asarray(cell.vertices, np.float64)
    view = raster.camera(vertices, back=BACK, up=UP, shape=(PANEL * FACTOR, PANEL * FACTOR))
    seen = raster.rasterize(view, raster.project(view, vertices), cell.faces)
    shown = seen.item[seen.item >= 0]
    corners = vertices[cell.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lit = raster.light(view, seen, normals[shown])
    kind = np.append(cell.kinds, -1)[cell.labels]  # label -1 takes the last
    table = np.concatenate([palette.colors(num_kinds), np.array([palette.GREY], np.uint8)])
    by_instance = palette.colors_of_labels(cell.labels)[shown] / 255
    return [
        raster.paint(seen, lit, colors, PANEL_COLOR, factor=FACTOR)
        for colors in (by_instance, table[kind][shown] / 255)
    ]


def _write_head(draw: ImageDraw.ImageDraw, title: str, kinds: Sequence[str], *, right: int) -> None:
    """The title on the left, the colours of the kinds on the right."""
    draw.text((GAP, 12), title, INK, ImageFont.load_default(size=18))
    font = ImageFont.load_default(size=14)
    names = [*kinds, "other"]
    table = [*(tuple(color) for color in palette.colors(len(kinds)).tolist()), palette.GREY]
    for name, color in reversed(list(zip(names, table, strict=True))):
        right -= int(draw.textlength(name, font)) + 26
        draw.rounded_rectangle((right, 15, right + 14, 29), 3, color)
        draw.text((right + 18, 14), name, FAINT, font)
