"""Tables for people: aligned text, angles in degrees.

Lengths are shown with the digits that the size of the scan makes meaningful, in the unit of the scan.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jprimfit.types import Primitive

# Digits of a length, counted from the longest side of the scan: a 123.456 mm part is shown to the micrometre.
NUM_DIGITS = 6


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns two blanks apart, numbers to the right, words to the left, a rule under the header."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    to_right = [all(cell[:1] in "0123456789-+.(" or not cell for cell in column[1:]) for column in columns]
    lines = []
    for row in (header, ["-" * width for width in widths], *rows):
        cells = zip(row, widths, to_right, strict=True)
        lines.append("  ".join(c.rjust(w) if right else c.ljust(w) for c, w, right in cells).rstrip())
    return "\n".join(lines)


def length_formatter(extent: float) -> Callable[[Any], str]:
    """Writes lengths of a scan whose longest side is `extent`; a scan below 1e-4 units gets exponents."""
    if not 0 < extent < np.inf:
        return lambda value: f"{float(value):.6g}"
    decimals = NUM_DIGITS - 1 - int(np.floor(np.log10(extent)))
    if decimals > 9:
        return lambda value: f"{float(value):.{NUM_DIGITS - 1}e}"
    return lambda value: _unsigned_zero(f"{float(value):.{max(decimals, 0)}f}")


def _unsigned_zero(number: str) -> str:
    """The number without the sign of a zero that it was rounded to."""
    return number if number.strip("-0.") else number.lstrip("-")


def describe(primitive: Primitive, length: Callable[[Any], str]) -> tuple[str, str, str]:
    """Size, direction and position of a primitive in words and numbers."""

    def vector(value: Any) -> str:
        return "(" + ", ".join(length(x) for x in np.asarray(value)) + ")"

    def direction(value: Any) -> str:
        return "(" + ", ".join(_unsigned_zero(f"{float(x):.4f}") for x in np.asarray(value)) + ")"

    p: Any = primitive
    if p.kind == "plane":
        return "", direction(p.normal), f"offset {length(p.offset)}"
    if p.kind == "cone":
        return f"half-angle {np.degrees(float(p.half_angle)):.3f} deg", direction(p.axis), f"apex {vector(p.apex)}"
    size = f"r = {length(p.radius)}, d = {length(2 * p.radius)}"
    return size, direction(p.axis) if p.kind == "cylinder" else "", f"center {vector(p.center)}"


def primitives_table(
    primitives: Sequence[Primitive],
    counts: Int[np.ndarray, "p"],
    rms_distances: Float[np.ndarray, "p"],
    surface_of: Int[np.ndarray, "p"],
    *,
    extent: float,
    max_rows: int | None = None,
) -> str:
    """One line per primitive, at most for the `max_rows` largest; a column 'surface' where some share one."""
    length = length_formatter(extent)
    shared = len(set(surface_of.tolist())) < len(primitives)
    header = ["#", "kind", "points", "size", "axis or normal", "position", "rms"]
    rows = []
    largest = np.sort(np.argsort(-counts, kind="stable")[:max_rows])
    for i in map(int, largest):
        primitive = primitives[i]
        measured = length(rms_distances[i]) if np.isfinite(rms_distances[i]) else "-"
        row = [str(i), primitive.kind, f"{counts[i]:,}", *describe(primitive, length), measured]
        rows.append([*row[:2], str(surface_of[i]), *row[2:]] if shared else row)
    if shared:
        header.insert(2, "surface")
    if not rows:
        return "no primitives found"
    left_out = len(primitives) - len(rows)
    return text_table(header, rows) + (f"\nand {left_out} smaller ones" if left_out else "")
